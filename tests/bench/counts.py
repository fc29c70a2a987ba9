"""What a poll, a command, a stop and a sample cost in counts, beside another checkout of the daemon.

Counts hardly scatter where times do: calls, bytecodes and turns of the loop are the same at any hour. What a cost is
worth is decided by times; a ratio of counts shows where time may have gone. This file runs once in each checkout, on
its `tests.support`, and prints its counts as JSON; `rows` sets them side by side.
"""

import argparse
import asyncio
import gc
import json
import os
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import TYPE_CHECKING

import ldcnd
from ldcnd.config.rig import RigConfig
from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.commands import MoveRelative, Power
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import TelemetryItem
from ldcnd.net.session import Qos
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.rig import RunningRig, running_rig

if TYPE_CHECKING:
    from tests.bench.report import Row

PACKAGE = str(Path(ldcnd.__file__).parent)
OF_DRIVES = ("PacketReader.", "encode_status", "received_command", "_complete", "_decode", "_decode_network")
"""Codecs that only simulated drives use while a rig works."""
ITEMS = ("position", "velocity", "adc", "state")
GAINS = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "cl": 0, "el": 4000, "sr": 1, "deadband": 0}
LINES = ((1, "deadline"), (8, "deadline"), (31, "deadline"), (31, "phase"))
"""Axes, and the order of their polls."""
HZ = 1000.0
"""More than the line carries."""
POLLS_S, SETTLED_S = 1.0, 1.0
"""As long as what is published once a second takes to come round: a part of it would hold that or not, by chance."""
TIMES, BATCH = 20, 32
LEAST_COUNT = 1.0
"""Of less, a ratio says nothing."""
MOST_RATIO = 1.1
"""Of a count to that of the other checkout."""


@dataclass(slots=True)
class Count:
    """What was counted of the daemon's own code and its client's: what simulates the line is not."""

    calls: int = 0
    bytecodes: int = 0
    turns: int = 0


def rows(root: Path, before: Path | None) -> "list[Row]":
    """Return the counts of a checkout, and their ratios to those of another one."""
    from tests.bench.report import Row  # noqa: PLC0415 - the other checkout may have none

    now, then = _counts_of(root), _counts_of(before) if before else {}
    found = [Row(name, value, exact=True) for name, value in now.items()]
    return found + [
        Row(f"{name}, now / before", now[name] / value, "", MOST_RATIO, at_most=True, exact=True)
        for name, value in then.items()
        if value > LEAST_COUNT and name in now
    ]


def _counts_of(root: Path) -> dict[str, float]:
    own = root / "tests" / "bench" / "counts.py"  # it knows where that checkout has its modules
    done = subprocess.run(  # noqa: S603
        (sys.executable, "-P", str(own if own.exists() else __file__)),
        cwd=root, env=os.environ | {"PYTHONPATH": str(root)}, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    if done.returncode:
        print(f"costs of {root} not counted: {done.stderr[-500:]}", flush=True)
        return {}
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def _is_daemons(code: CodeType) -> bool:
    file = code.co_filename
    simulates = "/sim/" in file or "simulat" in file or code.co_qualname.startswith(OF_DRIVES)
    return file.startswith(PACKAGE) and not simulates


@contextmanager
def counted() -> Iterator[Count]:
    """Count calls, bytecodes and turns of the running loop; a hundred times slower than without."""
    count = Count()

    def within(_frame: FrameType, event: str, _argument: object) -> object:
        count.bytecodes += event == "opcode"
        return within

    def enter(frame: FrameType, _event: str, _argument: object) -> object:
        if not _is_daemons(frame.f_code):
            return None
        count.calls += 1
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        return within

    selector = asyncio.get_running_loop()._selector  # type: ignore[attr-defined]
    select = selector.select

    def turn(timeout: float | None = None) -> object:
        count.turns += 1
        return select(timeout)

    selector.select = turn
    before = sys.gettrace()
    sys.settrace(enter)  # type: ignore[arg-type] # typeshed knows no tracer that may leave a frame alone
    try:
        yield count
    finally:
        sys.settrace(before)
        del selector.select


async def _costs(what: str, work: Callable[[], Awaitable[float]]) -> dict[str, float]:
    """Return what each costs of what `work` does and counts; memory is looked at when it is done again."""
    with counted() as count:
        times = await work()
    gc.collect()
    blocks = sys.getallocatedblocks()
    again = await work()
    gc.collect()
    return {
        f"calls of a {what}": count.calls / times,
        f"bytecodes of a {what}": count.bytecodes / times,
        f"turns of the loop of a {what}": count.turns / times,
        f"blocks of memory kept of a {what}": (sys.getallocatedblocks() - blocks) / again,
    }


def config_of(*, axes: int, hz: float, order: str = "deadline") -> RigConfig:
    """Return a rig of one line with axes that are polled for all items at a rate; 0 for hardly."""
    rates = dict.fromkeys(ITEMS, hz) if hz else dict.fromkeys(ITEMS, 0.0) | {"state": 1.0}
    drive = {"model": "ls-182ap", "velocity": 1, "acceleration": 100, "gains": GAINS, "rates": rates}
    drives = [drive | {"name": f"a{n}", "address": n} for n in range(1, axes + 1)]
    bus = {"name": "line0", "port": "sim:line0", "baud": 115_200, "overload": "skip", "order": order, "axis": drives}
    sim = {"name": "line0", "module": [{"model": "ls182ap"}] * axes}
    return RigConfig.model_validate({"rig": "sim", "bus": [bus | {"stop_probe_hz": 0.0}], "sim": [sim]})


async def _polls(axes: int, order: str) -> dict[str, float]:
    async with running_rig(config_of(axes=axes, hz=HZ, order=order)) as rig:
        await asyncio.sleep(SETTLED_S)
        statistics = rig.daemon.rig.buses[0].bus.statistics

        async def polls() -> float:
            before = statistics.replies
            await asyncio.sleep(POLLS_S)
            return statistics.replies - before

        return await _costs(f"poll ({axes} axes, by {order})", polls)


@asynccontextmanager
async def _quiet_rig() -> AsyncIterator[RunningRig]:
    """One drive that is hardly polled, so that what is counted is the command's."""
    async with running_rig(config_of(axes=1, hz=0.0)) as rig:
        await rig.until("a1", lambda state: state.link == "up")
        await rig.client.command("a1", Power(on=True))
        await asyncio.sleep(SETTLED_S)
        yield rig


async def _commands() -> dict[str, float]:
    async with _quiet_rig() as rig:

        async def commands() -> float:
            for _ in range(TIMES):
                await rig.client.command("a1", MoveRelative(distance=0.001, buffer_mode="aborting"))
            return TIMES

        async def stops() -> float:
            for _ in range(TIMES):
                await rig.client.stop("a1")
            return TIMES

        return await _costs("move that aborts another", commands) | await _costs("stop", stops)


async def _samples() -> dict[str, float]:
    """From what a session delivers to what a program's loop over samples has in its hands."""
    async with _quiet_rig() as rig:
        key = Keys("sim").telemetry("a1", TelemetryItem.STATE)
        async with rig.client.samples("a1", "state") as samples, rig.broker.session() as sender:
            _, sample = await anext(samples)
            payload, encoding = encode(sample, Encoding.MSGPACK)

            async def taken() -> float:
                for _ in range(TIMES):
                    for _ in range(BATCH):
                        sender.publish(key, payload, encoding=encoding, qos=Qos.TELEMETRY)
                    for _ in range(BATCH):
                        await anext(samples)
                return TIMES * BATCH

            return await _costs("sample of a client", taken)


def _all() -> dict[str, float]:
    found: dict[str, float] = {}
    for case in (*(lambda each=each: _polls(*each) for each in LINES), _commands, _samples):
        with asyncio.Runner(loop_factory=JumpingLoop) as runner:
            found |= runner.run(case())
    return found


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    print(json.dumps(_all()))
