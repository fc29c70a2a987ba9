"""Unmodified EPICS clients that use a motor record: `python -m tests.edges.epics_clients CLIENT RECORD`.

Each prints nothing and exits with 0, or raises. A process for each: libca reads its environment once.
"""

import argparse
import asyncio
import math
import sys
import time
from collections.abc import Callable
from itertools import product

import pytest

from tests.support.bluesky_engine import Documents
from tests.support.epics_records import SCREENS

LONGEST_S = 60.0


def until(holds: Callable[[], bool]) -> None:
    """Wait for something to become true, however busy the machine is."""
    until_s = time.monotonic() + LONGEST_S
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.05)


def caget(record: str) -> None:
    """The calls of the command line tools, over libca itself."""
    import epics

    seen = []
    epics.camonitor(f"{record}.RBV", callback=lambda value, **_: seen.append(value))
    assert epics.caget(f"{record}.RTYP") == "motor"
    assert epics.caget(f"{record}.SEVR", as_string=True) == "NO_ALARM"
    assert epics.caput(record, 2.0, wait=True, timeout=LONGEST_S) == 1
    assert abs(epics.caget(f"{record}.RBV") - 2.0) < 0.02
    assert epics.caget(f"{record}.DMOV") == 1
    epics.caput(record, 1000.0, wait=True, timeout=LONGEST_S)
    assert abs(epics.caget(f"{record}.RBV") - 2.0) < 0.02
    message = epics.caget(f"{record}:message", as_string=True)
    assert "100" in message
    assert len(message) > 40
    assert epics.PV(f"{record}:message").get(as_string=True, timeout=LONGEST_S) == message
    assert epics.caget(f"{record}.NAME$", as_string=True) == record == epics.caget(f"{record}.NAME")
    assert epics.caget(f"{record}.STAT", as_string=True) == "STATE"  # the motion that was put last was refused
    assert epics.PV(f"{record}.VELO").get_with_metadata(timeout=LONGEST_S)["severity"] == 1
    assert epics.caput(record, 2.0, wait=True, timeout=LONGEST_S) == 1
    assert epics.caget(f"{record}.STAT", as_string=True) == "NO_ALARM"
    assert epics.PV(f"{record}.VELO").get_with_metadata(timeout=LONGEST_S)["severity"] == 0
    assert epics.caget(f"{record}_able.VAL") == 0
    assert [epics.caget(f"{record}-Err"), epics.caget(f"{record}-MsgTxt", as_string=True)] == [0, ""]
    assert len(seen) > 3
    epics.camonitor_clear(f"{record}.RBV")


def screens(record: str) -> None:
    """Every channel of the motor record's own screens connects, but those for scans, which the page names."""
    import epics

    fields = {field for screen in ("motorx_all", "motor8x") for field in SCREENS[screen].split()}
    here = {f"{record}.{field}" for field in fields} | {
        f"{record}_able.VAL",
        f"{record.rpartition(':')[0]}:allstop.VAL",
    }
    scans = {f"{record}:scanParms.{field}" for field in ("GO", "LOAD")}
    channels = {name: epics.PV(name) for name in here | scans}
    until(lambda: all(channels[name].connected for name in here))
    assert {name for name in here if channels[name].get(timeout=LONGEST_S) is None} == set()
    assert not any(channels[name].connected for name in scans)


def aioca_calls(record: str) -> None:
    """caget, caput and camonitor of aioca, over the libca of EPICS Base."""
    from aioca import caget, camonitor, caput, purge_channel_caches

    async def use() -> None:
        seen: list[float] = []
        subscription = camonitor(f"{record}.RBV", lambda value: seen.append(float(value)))
        began = float(await caget(f"{record}.RBV", timeout=LONGEST_S))
        await caput(record, began + 1.0, wait=True, timeout=LONGEST_S)
        assert abs(float(await caget(f"{record}.RBV", timeout=LONGEST_S)) - began - 1.0) < 0.02
        assert await caget(f"{record}.DMOV", timeout=LONGEST_S) == 1
        async with asyncio.timeout(LONGEST_S):
            while not (seen and abs(seen[-1] - began - 1.0) < 0.02):
                await asyncio.sleep(0.05)
        subscription.close()
        purge_channel_caches()

    asyncio.run(use())


def pyepics_motor(record: str) -> None:
    """`epics.Motor`: moves, limits, stop, tweak."""
    import epics

    motor = epics.Motor(record)
    assert (motor.units, motor.precision) == ("mm", 3)
    assert motor.move(1.0, wait=True, timeout=LONGEST_S) == 0
    assert abs(motor.get_position(readback=True) - 1.0) < 0.02
    assert motor.within_limits(0.0)
    motor.tweak(direction="forward", wait=True, timeout=LONGEST_S)
    until(lambda: abs(motor.get_position(readback=True) - 2.0) < 0.02)
    motor.put("VELO", 1.0)
    motor.move(50.0, wait=False)
    until(lambda: motor.moving == 1 and motor.get_position(readback=True) > 2.1)
    motor.stop()
    until(lambda: motor.done_moving == 1)
    stands = motor.get_position(readback=True)
    assert stands < 49
    motor.put("VELO", 20.0)
    assert motor.move(1.0, relative=True, wait=True, timeout=LONGEST_S) == 0
    assert abs(motor.get_position(readback=True) - stands - 1.0) < 0.1
    motor.move(0.0, wait=True, timeout=LONGEST_S)
    motor.put("TWV", 0.1)
    for _ in range(50):
        motor.put("TWF", 1)
    until(lambda: motor.done_moving == 1 and abs(motor.get_position(readback=True) - 5.0) < 0.02)
    assert abs(motor.get_position() - 5.0) < 1e-6
    assert epics.caput(f"{record}.JOGR", 1, wait=True, timeout=LONGEST_S) == 1
    time.sleep(0.3)
    assert epics.caput(f"{record}.JOGR", 0, wait=True, timeout=LONGEST_S) == 1
    until(lambda: motor.done_moving == 1 and abs(motor.get_position() - motor.get_position(readback=True)) < 0.1)


def ophyd_motor(record: str) -> None:
    """`ophyd.EpicsMotor` in a scan."""
    from bluesky import RunEngine
    from bluesky.plans import scan
    from ophyd import EpicsMotor
    from ophyd.utils import LimitError

    motor = EpicsMotor(record, name="motor")
    motor.wait_for_connection(timeout=LONGEST_S)
    documents = Documents()
    engine = RunEngine({})
    engine.subscribe(documents.take)
    engine(scan([], motor, 0, 3, 4))
    assert documents.exit_status == "success"
    recorded = documents.data("motor")
    assert len(recorded) == 4
    assert all(abs(at - wanted) < 0.02 for wanted, at in enumerate(recorded)), recorded
    with pytest.raises(LimitError):
        motor.set(1000)


def ophyd_async_motor(record: str) -> None:
    """`ophyd_async.epics.motor.Motor`: a scan and a fly scan."""
    import bluesky.plan_stubs as bps
    from bluesky import RunEngine
    from bluesky.plans import scan
    from ophyd_async.core import FlyMotorInfo, init_devices
    from ophyd_async.epics.motor import Motor

    engine = RunEngine({})
    documents = Documents()
    engine.subscribe(documents.take)
    with init_devices():
        motor = Motor(f"ca://{record}", name="motor")
    engine(scan([], motor, 0, 3, 4))
    assert documents.exit_status == "success"
    recorded = documents.data("motor")
    assert all(abs(at - wanted) < 0.02 for wanted, at in enumerate(recorded)), recorded

    def flight():
        yield from bps.open_run()
        yield from bps.prepare(motor, FlyMotorInfo(start_position=0, end_position=5, time_for_move=2.5), wait=True)
        yield from bps.kickoff(motor, wait=True)
        yield from bps.complete(motor, wait=True)
        yield from bps.close_run()

    engine(flight())
    assert documents.exit_status == "success"
    assert abs(asyncio.run_coroutine_threadsafe(motor.user_readback.get_value(), engine.loop).result(5) - 5) < 0.5


def caproto_tools(record: str) -> None:
    """`caproto-get`, `caproto-put` and `caproto-monitor`: another implementation of the protocol."""
    import subprocess
    from pathlib import Path

    tools = Path(sys.executable).parent

    def run(tool: str, *arguments: str) -> str:
        return subprocess.run(
            [tools / tool, *arguments], check=True, capture_output=True, text=True, timeout=120
        ).stdout

    assert "motor" in run("caproto-get", "--no-repeater", f"{record}.RTYP")
    watched = [tools / "caproto-monitor", "--no-repeater", "--maximum", "3", f"{record}.VAL"]
    with subprocess.Popen(watched, stdout=subprocess.PIPE, text=True) as monitor:
        assert monitor.stdout
        assert "0" in monitor.stdout.readline()
        for target in ("1.5", "2.5"):
            run("caproto-put", "--no-repeater", "--notify", "--timeout", "60", record, target)
        assert ["1.5" in monitor.stdout.readline(), "2.5" in monitor.stdout.readline()] == [True, True]
    assert "2.5" in run("caproto-get", "--no-repeater", f"{record}.VAL")


def p4p_calls(record: str) -> None:
    """get, put and monitor over PV Access, with what belongs to a value."""
    from p4p.client.thread import Context, RemoteError

    with Context("pva") as there:
        seen = []
        subscription = there.monitor(f"{record}.RBV", seen.append)
        began = there.get(f"{record}.RBV", timeout=LONGEST_S)
        assert (began.raw.display.units, began.raw.display.precision, began.severity) == ("mm", 3, 0)
        assert abs(began.timestamp - time.time()) < 60
        there.put(record, float(began) + 2.0, wait=True, timeout=LONGEST_S)
        assert there.get(f"{record}.DMOV", timeout=LONGEST_S) == 1
        assert abs(there.get(f"{record}.RBV", timeout=LONGEST_S) - began - 2.0) < 0.02
        with pytest.raises(RemoteError, match="limit"):
            there.put(record, 1000.0, wait=True, timeout=LONGEST_S)
        there.put(f"{record}.VELO", 2.0, timeout=LONGEST_S)
        there.put(record, float(began) + 40.0, wait=False, timeout=LONGEST_S)
        assert there.get(f"{record}.DMOV", timeout=LONGEST_S) == 0  # a put that does not wait returns at once
        there.put(f"{record}.SPMG", "Stop", wait=True, timeout=LONGEST_S)
        until(lambda: there.get(f"{record}.DMOV", timeout=LONGEST_S) == 1)
        assert there.get(f"{record}.SPMG", timeout=LONGEST_S).choice == "Stop"
        assert "SPMG" not in there.get(f"{record}:message", timeout=LONGEST_S)
        assert len(seen) > 3
        subscription.close()
        assert there.get(f"{record}.DESC$", timeout=LONGEST_S) == there.get(f"{record}.DESC", timeout=LONGEST_S) != ""
        with pytest.raises(RemoteError, match=r"^nan is not a finite number"):
            there.put(record, math.nan, wait=True, timeout=LONGEST_S)
        for name in (record, f"{record}.RBV"):
            limits = there.get(name, timeout=LONGEST_S).raw.control
            assert (limits.limitLow, limits.limitHigh) == (-100, 100)
        there.put(f"{record}.SPMG", "Go", wait=True, timeout=LONGEST_S)
        stands = there.get(f"{record}.RBV", timeout=LONGEST_S)
        assert abs(stands) > 1
        for disables, fields in ((0, ("VAL", "RLV", "CNEN")), (1, ("DISP",))):
            there.put(f"{record}.DISP", disables, wait=True, timeout=LONGEST_S)
            for field, given in product(fields, ({}, {"alarm.severity": 1}, {"timeStamp.userTag": 3})):
                with pytest.raises(RemoteError, match="names no value"):
                    there.put(f"{record}.{field}", given, process="true", get=False, timeout=LONGEST_S)
        assert there.get(f"{record}.DISP", timeout=LONGEST_S) == 1
        there.put(f"{record}.DISP", 0, wait=True, timeout=LONGEST_S)
        assert there.get(f"{record}.CNEN", timeout=LONGEST_S).choice == "Enable"
        assert abs(there.get(f"{record}.RBV", timeout=LONGEST_S) - stands) < 0.05
        there.put(f"{record}.SET", "Set", wait=True, timeout=LONGEST_S)
        for target in (1.0, 3.0) * 3:
            there.put(record, target, wait=True, timeout=LONGEST_S)
            assert abs(there.get(f"{record}.RBV", timeout=LONGEST_S) - target) < 0.02


CLIENTS = {
    client.__name__: client
    for client in (caget, screens, aioca_calls, pyepics_motor, ophyd_motor, ophyd_async_motor, caproto_tools, p4p_calls)
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("client", choices=CLIENTS)
    parser.add_argument("record")
    options = parser.parse_args()
    CLIENTS[options.client](options.record)
