"""How many files one thing passes on its way through the house: `python -m tests.house` runs it and prints the way.

A poll, a move and a trace request run on a whole daemon, on the jumping clock. A file is entered when one of its
functions is called from another file; a function that goes on after an await has not been entered again. The simulated
line, the client and the memory session stand in for the world outside: neither they nor what they call for themselves
is on the way. They come in through the `DOORS`.
"""

import argparse
import asyncio
import inspect
import sys
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import ldcnd
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.model.commands import MoveAbsolute, Power, SetPosition
from ldcnd.model.traces import TakeTrace
from ldcnd.sim.jumping_loop import JumpingLoop
from tests.support.rig import SIMULATED, RunningRig, running_rig

PACKAGE = Path(ldcnd.__file__).parent
OUTSIDE = ("sim/", "client/", "messaging/memory_session.py", "log.py")
DOORS = ("data_received", "admit", "offer", "reply")
"""What the world outside calls: bytes of the line, and a query with its answer."""
PROLOGUE_BYTES = 4
"""Of byte code before the body of a coroutine: RETURN_GENERATOR, POP_TOP, and RESUME, where it is when it begins."""
AXIS = "x"
SETTLED_S = 0.1
QUIET_HZ = 0.01
"""Of all polls while a command is followed, so that none of them mixes with it."""


@dataclass(slots=True)
class Way:
    """The files that were entered.

    Attributes:
        entered: in order, without the repetitions that follow each other.
        times: how often each was entered.
    """

    entered: list[str] = field(default_factory=list)
    times: Counter[str] = field(default_factory=Counter)

    def step(self, frame: FrameType) -> None:
        """Take note of a call."""
        file = room(frame)
        if file is None or _goes_on(frame) or _outside(frame):
            return
        if frame.f_back and room(frame.f_back) == file:
            return
        self.times[file] += 1
        if not self.entered or self.entered[-1] != file:
            self.entered.append(file)

    @property
    def files(self) -> list[str]:
        """The files, in the order of their first entrance."""
        return list(dict.fromkeys(self.entered))


def room(frame: FrameType) -> str | None:
    """Return the file of the daemon that a frame runs in; None for everything else."""
    file = frame.f_code.co_filename
    if not file.startswith(str(PACKAGE)):
        return None
    name = file[len(str(PACKAGE)) + 1 :]
    return None if name.startswith(OUTSIDE) else name


def _outside(frame: FrameType) -> bool:
    """Tell whether a function runs for the world outside: called by it, but not through a door."""
    inner, caller = frame, frame.f_back
    while caller and caller.f_code.co_filename.startswith(str(PACKAGE)):
        if room(caller) is None:
            return inner.f_code.co_name not in DOORS
        inner, caller = caller, caller.f_back
    return False


def _goes_on(frame: FrameType) -> bool:
    """Tell whether a coroutine or generator goes on behind an await or a yield, rather than begins."""
    can_wait = frame.f_code.co_flags & (inspect.CO_COROUTINE | inspect.CO_GENERATOR | inspect.CO_ASYNC_GENERATOR)
    return bool(can_wait) and frame.f_lasti > PROLOGUE_BYTES


@contextmanager
def followed(way: Way) -> Iterator[None]:
    """Follow every call of the daemon for the time of the context."""

    def step(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call":
            way.step(frame)

    sys.setprofile(step)
    try:
        yield
    finally:
        sys.setprofile(None)


def _config(hz: float) -> RigConfig:
    """Return the simulated rig with nothing but one axis, polled this often."""
    document = load_config(SIMULATED).model_dump(mode="json", exclude_unset=True)
    bus = document["bus"][0]
    bus["axis"] = [
        axis | {"rates": dict.fromkeys(("position", "velocity", "adc", "state"), hz)} for axis in bus["axis"]
    ]
    bus["stop_probe_hz"] = 0
    return RigConfig.model_validate(document)


async def poll() -> Way:
    """Follow one poll: from the bytes of its reply to the samples on their way, the next request included."""
    way = Way()
    async with running_rig(_config(50.0)) as rig:
        await asyncio.sleep(1.0)
        line = rig.daemon.rig.buses[0].bus
        before = line.statistics.replies
        with followed(way):
            while line.statistics.replies == before:
                way.entered.clear()
                way.times.clear()
                await asyncio.sleep(0.0005)
    return way


@asynccontextmanager
async def _ready() -> AsyncIterator[RunningRig]:
    async with running_rig(_config(QUIET_HZ)) as rig:
        await rig.until(AXIS, lambda state: state.link == "up")
        await rig.client.command(AXIS, Power(on=True))
        await rig.client.command(AXIS, SetPosition(position=0.0))
        await asyncio.sleep(SETTLED_S)  # what these were told is over
        yield rig


async def _command(send: Callable[[RunningRig], Awaitable[object]]) -> Way:
    way = Way()
    async with _ready() as rig:
        with followed(way):
            await send(rig)
    return way


async def move() -> Way:
    """Follow one move: from its query to the answer, which comes when the drive has acknowledged it."""
    return await _command(lambda rig: rig.client.command(AXIS, MoveAbsolute(position=5.0)))


async def trace() -> Way:
    """Follow one trace request: from its query to the answer that the trace is armed."""
    return await _command(lambda rig: rig.client.command(AXIS, TakeTrace(channels=("position",), samples=10)))


FLOWS = {"poll": poll, "move": move, "trace": trace}


def way_of(name: str) -> Way:
    """Run one flow on a loop of its own."""
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        return runner.run(FLOWS[name]())


def main() -> None:
    """Print the files of each flow, in order, with how often each is entered."""
    for name in FLOWS:
        way = way_of(name)
        print(f"{name}: {len(way.files)} files, {sum(way.times.values())} entrances")
        for file in way.files:
            print(f"  {way.times[file]:3} {file}")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    main()
