"""Scans of 200 points that something ends in the middle, and the page on Bluesky, typed as it stands."""

import asyncio
import contextlib
import json
import os
import re
import sys
import threading
import time

import bluesky.plans as bp
import pytest
from bluesky import RunEngine
from bluesky.utils import FailedStatus

import ldcnd.lab.bluesky
from ldcnd.contract.samples import AxisState, LinkState, Moving, PositionSample, TelemetryItem
from ldcnd.sim.ldcn.power import FaultCondition
from tests.support.bluesky_engine import Documents, Laboratory, laboratory
from tests.support.process import ROOT, START_TIME_S, answering, client, daemon, free_port, process, simulated_terminal

pytestmark = [pytest.mark.edges, pytest.mark.timeout(600)]

IN_POSITION = 0.02
HUNTING = 0.5
"""Counts in a servo cycle by which a closed loop moves at rest; a move has 10."""
POINTS = 200
MIDDLE = 100


def scan_until(lab: Laboratory, x, trouble) -> list[float]:
    """Scan 200 points, with trouble during the move to the one in the middle; returns where the motor was each time."""
    truth: list[float] = []
    beginning = threading.Event()

    def at_each(_, document):
        truth.append(lab.truth("x"))
        if document["seq_num"] == MIDDLE:
            beginning.set()

    async def while_moving():
        await lab.running.until("x", lambda state: state.moving is Moving.YES)
        await trouble()

    def begin(_, document):
        if document["seq_num"] == MIDDLE:
            lab.loop.start(while_moving())

    tokens = [lab.engine.subscribe(at_each, "event"), lab.engine.subscribe(begin, "event")]
    try:
        with contextlib.suppress(FailedStatus):
            lab.engine(bp.scan([], x, 0, 19.9, POINTS))
    finally:
        for token in tokens:
            lab.engine.unsubscribe(token)
    return truth


async def nothing() -> None:
    """Let the scan be."""


def test_two_hundred_points_are_where_the_motor_was():
    with laboratory() as lab, lab.powered("x") as (x,):
        truth = scan_until(lab, x, nothing)

        assert lab.documents.exit_status == "success"
        assert len(lab.documents.data("x")) == POINTS
        assert lab.documents.data("x") == pytest.approx(truth, abs=IN_POSITION)
        assert lab.documents.data("x") == pytest.approx([0.1 * at for at in range(POINTS)], abs=IN_POSITION)


def test_two_hundred_values_of_a_slow_signal_are_those_of_their_points():
    def at_each(_, document):
        truth.append(lab.potentiometer("x"))

    truth: list[float] = []
    with laboratory() as lab, lab.powered("x") as (x,):
        adc = lab.devices.signal("x", "adc")
        lab.engine.subscribe(at_each, "event")
        lab.engine(bp.scan([adc], x, 0, 99.5, POINTS))
        shown = lab.loop.run(lab.running.client.last("x", "adc"))
        volts_per_share = shown.volts * shown.full_scale / shown.counts

        assert lab.documents.exit_status == "success"
        assert lab.documents.data("x_adc") == pytest.approx([each * volts_per_share for each in truth], abs=0.02)
        assert len({*lab.documents.data("x_adc")}) > POINTS // 2


def test_a_stop_in_the_middle_fails_the_run_with_the_axis_at_rest():
    with laboratory() as lab, lab.powered("x") as (x,):
        truth = scan_until(lab, x, lab.running.client.stop)
        state = lab.loop.run(lab.running.client.state("x"))

        assert lab.documents.exit_status == "fail"
        assert len(lab.documents.data("x")) == MIDDLE
        assert lab.documents.data("x") == pytest.approx(truth, abs=IN_POSITION)
        assert (state.stop_latched, state.moving) == (True, Moving.NO)
        assert abs(lab.module("x").shaft.velocity_counts) < HUNTING


def test_a_move_that_is_refused_fails_the_run_with_the_axis_at_rest():
    with laboratory() as lab, lab.powered("x") as (x,):
        with pytest.raises(FailedStatus):
            lab.engine(bp.scan([], x, 90, 109.9, POINTS))
        state = lab.loop.run(lab.running.client.state("x"))

        assert lab.documents.exit_status == "fail"
        assert len(lab.documents.data("x")) == 101  # up to the limit
        assert state.moving is Moving.NO


def test_a_drive_fault_in_the_middle_fails_the_run_with_the_axis_at_rest():
    async def short():
        module = lab.module("x")
        module.set_condition(FaultCondition.MOTOR_SHORT, present=True, at_s=asyncio.get_running_loop().time())

    with laboratory() as lab, lab.powered("x") as (x,):
        truth = scan_until(lab, x, short)
        state = lab.loop.run(lab.running.until("x", lambda state: state.moving is Moving.NO))

        assert lab.documents.exit_status == "fail"
        assert len(lab.documents.data("x")) == MIDDLE
        assert lab.documents.data("x") == pytest.approx(truth, abs=IN_POSITION)
        assert (state.state, state.moving) == (AxisState.ERROR_STOP, Moving.NO)
        assert abs(lab.module("x").shaft.velocity_counts) < HUNTING


def test_a_drive_that_loses_its_power_fails_the_run():
    async def unplug():
        lab.module("x").power(on=False, at_s=asyncio.get_running_loop().time())

    with contextlib.suppress(ldcnd.LdcndError), laboratory() as lab, lab.powered("x") as (x,):
        scan_until(lab, x, unplug)

        assert lab.documents.exit_status == "fail"
        assert len(lab.documents.data("x")) == MIDDLE


@pytest.mark.real_time
async def test_a_killed_daemon_fails_the_run_and_the_drive_ends_its_move(tmp_path):
    link, config = tmp_path / "line0", tmp_path / "adopt.toml"
    simulated = (ROOT / "config" / "simulated.toml").read_text()
    simulated = simulated[: simulated.index("[[sim]]")].replace('"sim:line0"', f'"{link}"')
    config.write_text(simulated.replace("baud = 115200", 'baud = 115200\nstart = "adopt"\nadopt_fallback = "reset"'))
    endpoint = f"tcp/127.0.0.1:{free_port()}"

    def run(kill) -> tuple[Documents, float]:
        documents = Documents()
        engine = RunEngine({}, context_managers=[])
        engine.subscribe(documents.take)
        began_s = 0.0

        def at_each(_, document):
            nonlocal began_s
            if document["seq_num"] == MIDDLE:
                began_s = time.monotonic()
                kill()

        engine.subscribe(at_each, "event")
        with contextlib.suppress(ldcnd.LdcndError), ldcnd.lab.bluesky.connect(endpoint) as rig:
            with rig.control("x", client="scan") as x:
                x.power(on=True).wait(20)
                with pytest.raises(FailedStatus):
                    engine(bp.scan([], x, 0, 99.5, POINTS))
        return documents, time.monotonic() - began_s

    async with simulated_terminal(link, "ls182ap", "ls182ap", "picservo-v4", "picservo-v4"):
        async with process("run", "--config", str(config), "--listen", endpoint) as running:
            await answering(running, endpoint)
            documents, took_s = await asyncio.to_thread(run, running.kill)
            await running.wait()
        async with (
            process("run", "--config", str(config), "--listen", endpoint) as again,
            client_of(again, endpoint) as rig,
        ):
            async with asyncio.timeout(START_TIME_S):
                while (
                    (state := await rig.state("x")) is None
                    or state.link is not LinkState.UP
                    or state.moving is not Moving.NO
                ):
                    await asyncio.sleep(0.2)
            async with rig.samples("x", TelemetryItem.POSITION) as positions, asyncio.timeout(5):
                _, position = await anext(positions)

    assert documents.exit_status == "fail"
    assert MIDDLE <= len(documents.data("x")) <= MIDDLE + 2
    assert took_s < 40
    assert isinstance(position, PositionSample)
    assert 49_000 < position.counts < 51_500  # where the last move led, not beyond


@contextlib.asynccontextmanager
async def client_of(running, endpoint):
    await answering(running, endpoint)
    async with client(endpoint) as rig:
        yield rig


CHECKED = """
import bluesky
from tests.support.bluesky_engine import Documents

class Engine(bluesky.RunEngine):
    def __init__(self):
        super().__init__()
        self.documents = Documents()
        self.subscribe(self.documents.take)

bluesky.RunEngine = Engine
"""
"""Makes each engine of a program check its documents against event-model's schemas."""
TOLD = """
import json

print()
print(json.dumps({name: len(RE.documents.of(name)) for name, _ in RE.documents.taken}))
print(json.dumps([document["exit_status"] for document in RE.documents.of("stop")]))
"""


@pytest.mark.real_time
async def test_the_page_on_bluesky_runs_and_its_documents_are_valid():
    (program,) = re.findall(r"(?ms)^```python\n(.*?)^```", (ROOT / "docs" / "how-to" / "use-bluesky.md").read_text())
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        typed = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", CHECKED + program + TOLD),
            stdout=-1,
            cwd=ROOT,
            env={**os.environ, "LDCND_CONNECT": endpoint},
        )
        printed, _ = await typed.communicate()

    text = printed.decode()
    assert typed.returncode == 0, text
    assert "x_trace_position" in text
    documents, ends = map(json.loads, text.splitlines()[-2:])
    assert (documents["start"], documents["stop"]) == (4, 4)
    assert documents["event"] >= 3 + 4 + 2
    assert documents["event_page"] >= 1
    assert ends == ["success"] * 4
