"""How the house looks to somebody who follows one thing through it: `python -m tests.house`.

It prints the files that a poll, a move, a move of the console's page, and a trace request of each family pass, with
how often each is entered. `--twins` prints pairs of classes that hold nearly the same fields, `--counts` how large the
house is, `--words` how long the documentation is.

The flows run on a whole daemon, on the jumping clock. A file is entered when one of its functions is called from
another file; a function that goes on after an await has not been entered again. The simulated line, the client and the
memory session stand in for the world outside: neither they nor what they call for themselves is on the way. They come
in through the `DOORS`. For a move of the console's page the client is inside.
"""

import argparse
import ast
import asyncio
import dis
import inspect
import logging
import sys
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from functools import cache
from itertools import combinations
from pathlib import Path
from types import CodeType, FrameType

import click
import structlog

import ldcnd
from ldcnd.cli.main import cli
from ldcnd.cli.sending import Derived
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import MoveAbsolute, Power, SetPosition
from ldcnd.contract.fault_pages import FOLDER
from ldcnd.contract.parameters import ReadAlarms
from ldcnd.contract.traces import TakeTrace
from ldcnd.sim.smartstep.variant import SimulatedVariant
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.console_rig import open_page, running_console
from tests.support.pages import ROOT, pages
from tests.support.rig import SIMULATED, RunningRig, running_rig
from tests.support.trace_rig import trace_config

PACKAGE = Path(ldcnd.__file__).parent
SESSION = "testing/memory_session.py"
OUTSIDE = ("sim/", "testing/", "log.py")
DOORS = ("data_received", "admit", "offer", "reply")
"""What the world outside calls: bytes of the line, and a query with its answer."""
AXIS = "x"
SETTLED_S = 0.1
TURN_S = 0.0005
QUIET_HZ = 0.01
"""Of all polls while a command is followed, so that none of them mixes with it."""
WINGS = ("sim", "console", "lab", "ops", "bench", "testing", "ports")
"""Folders that are no part of the core."""
LEAST_SHARED, SHARE = 4, 0.6
"""How many fields two twins have in common at least, and which share of the smaller one's these are."""


@dataclass(slots=True)
class Way:
    """The functions by which files were entered.

    Attributes:
        outside: what begins the names of files that are not on the way.
        calls: file and function of each entrance, in order.
        handed: the last function of the house that called a function of the session, by the name of the latter.
    """

    outside: tuple[str, ...] = (*OUTSIDE, "client/")
    calls: list[tuple[str, str]] = field(default_factory=list)
    handed: dict[str, str] = field(default_factory=dict)

    def step(self, frame: FrameType) -> None:
        """Take note of a call."""
        file, caller = self._room(frame), frame.f_back and self._room(frame.f_back)
        if file is None:
            if caller and _file(frame) == SESSION:
                self.handed[frame.f_code.co_name] = f"{caller} {frame.f_back.f_code.co_qualname}"  # type: ignore[union-attr]
            return
        if file != caller and not _goes_on(frame) and not self._is_outside(frame):
            self.calls.append((file, frame.f_code.co_qualname))

    @property
    def first(self) -> str:
        """The function by which the way began."""
        return " ".join(self.calls[0])

    @property
    def last(self) -> str:
        """The function by which it ended: what handed its answer or sample to the session, or answered the browser."""
        if self.outside == OUTSIDE:
            return " ".join(self.calls[-1])
        return self.handed.get("_answer") or self.handed["publish"]

    @property
    def times(self) -> Counter[str]:
        """How often each file was entered, in the order of their first entrance."""
        return Counter(file for file, _ in self.calls)

    def _room(self, frame: FrameType) -> str | None:
        file = _file(frame)
        return None if file is None or file.startswith(self.outside) else file

    def _is_outside(self, frame: FrameType) -> bool:
        """Tell whether a function runs for the world outside: called by it, but not through a door."""
        inner, caller = frame, frame.f_back
        while caller and _file(caller):
            if self._room(caller) is None:
                return inner.f_code.co_name not in DOORS
            inner, caller = caller, caller.f_back
        return False


def _file(frame: FrameType) -> str | None:
    """Return the file of the package that a frame runs in; None for everything else."""
    file = frame.f_code.co_filename
    return file[len(str(PACKAGE)) + 1 :] if file.startswith(str(PACKAGE)) else None


def _goes_on(frame: FrameType) -> bool:
    """Tell whether a coroutine or generator goes on behind an await or a yield, rather than begins."""
    can_wait = frame.f_code.co_flags & (inspect.CO_COROUTINE | inspect.CO_GENERATOR | inspect.CO_ASYNC_GENERATOR)
    return bool(can_wait) and frame.f_lasti > _beginning(frame.f_code)


@cache
def _beginning(code: CodeType) -> int:
    """Return where a coroutine is when it begins: its first RESUME, behind the making of cells."""
    return next(each.offset for each in dis.get_instructions(code) if each.opname == "RESUME")


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
    """Return the simulated rig, with one axis that is polled this often and others that are hardly polled."""
    document = load_config(SIMULATED).model_dump(mode="json", exclude_unset=True)
    bus = document["bus"][0]
    for axis in bus["axis"]:
        axis["rates"] = dict.fromkeys(
            ("position", "velocity", "adc", "state"), hz if axis["name"] == AXIS else QUIET_HZ
        )
    bus |= {"stop_probe_hz": 0, "coalesce_ms": 0}
    return RigConfig.model_validate(document)


async def poll() -> Way:
    """Follow one poll: from the bytes of its reply until the session has its samples, the next request included."""
    way = Way()
    async with running_rig(_config(50.0)) as rig:
        await asyncio.sleep(1.0)
        line = rig.daemon.rig.buses[0].bus
        before = line.statistics.replies
        with followed(way):
            while line.statistics.replies == before:
                way.calls.clear()
                way.handed.clear()
                await asyncio.sleep(TURN_S)
            while "publish" not in way.handed:
                await asyncio.sleep(TURN_S)
    return way


@asynccontextmanager
async def _ready() -> AsyncIterator[RunningRig]:
    async with running_rig(_config(QUIET_HZ)) as rig:
        await _make_ready(rig)
        yield rig


async def _make_ready(rig: RunningRig) -> None:
    await rig.until(AXIS, lambda state: state.link == "up")
    await rig.client.command(AXIS, Power(on=True))
    await rig.client.command(AXIS, SetPosition(position=0.0))
    await asyncio.sleep(SETTLED_S)  # the events of these are over


async def _command(send: Callable[[RunningRig], Awaitable[object]]) -> Way:
    way = Way()
    async with _ready() as rig:
        with followed(way):
            await send(rig)
    return way


async def move() -> Way:
    """Follow one move: from its query to the answer, which comes when the drive has acknowledged it."""
    command = MoveAbsolute(position=5.0)
    return await _command(lambda rig: rig.client.command(AXIS, command))


async def console_move() -> Way:
    """Follow a move of a page of the console: from its request to the response."""
    way = Way(outside=OUTSIDE)
    async with running_console(_config(QUIET_HZ)) as console:
        await _make_ready(console.rig)
        async with open_page(console.app, console.browser) as page:
            await page.take("sim", AXIS)
            await asyncio.sleep(SETTLED_S)
            with followed(way):
                answer = await page.post(f"/api/rigs/sim/axes/{AXIS}/move_absolute", {"position": 5.0})
            assert answer.status == 200, answer.document
    return way


async def trace() -> Way:
    """Follow one trace request: from its query to the answer that the trace is armed."""
    command = TakeTrace(channels=("position",), samples=10)
    return await _command(lambda rig: rig.client.command(AXIS, command))


async def smartstep_trace() -> Way:
    """Follow a request for a trace by a SmartStep's own recorder, to the answer that it is armed."""
    way = Way()
    config = trace_config(SimulatedVariant(), {}, loaded=False)
    async with running_rig(config.model_copy(update={"bus": config.bus[1:]})) as rig:
        await rig.until("feed", lambda state: state.link == "up")
        await rig.client.command("feed", ReadAlarms())  # the client knows the axis from now on
        await asyncio.sleep(SETTLED_S)
        command = TakeTrace(channels=("speed_feedback",), samples=10)
        with followed(way):
            await rig.client.command("feed", command)
    return way


FLOWS = {
    "poll": poll,
    "move": move,
    "move of the console": console_move,
    "trace": trace,
    "trace of a SmartStep": smartstep_trace,
}


def way_of(name: str) -> Way:
    """Run one flow on a loop of its own."""
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        return runner.run(FLOWS[name]())


def classes() -> dict[str, frozenset[str]]:
    """Return the fields of every class of the package, those that its body annotates, by file and name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                targets = (each.target for each in node.body if isinstance(each, ast.AnnAssign))
                fields = frozenset(each.id for each in targets if isinstance(each, ast.Name))
                found[f"{path.relative_to(PACKAGE)} {node.name}"] = fields
    return found


def twins() -> list[tuple[str, str, frozenset[str]]]:
    """Return pairs of classes with the fields that they share, most first."""
    pairs = []
    for (one, ours), (other, theirs) in combinations(classes().items(), 2):
        shared = ours & theirs
        if len(shared) >= LEAST_SHARED and len(shared) >= SHARE * min(len(ours), len(theirs)):
            pairs.append((one, other, shared))
    return sorted(pairs, key=lambda pair: -len(pair[2]))


def counts() -> dict[str, int]:
    """Return how large the house is."""
    files = sorted(PACKAGE.rglob("*.py"))
    lines = {file: len(file.read_text(encoding="utf-8").splitlines()) for file in files}
    return {
        "lines of Python": sum(lines.values()),
        "lines of the core": sum(count for file, count in lines.items() if not _is_wing(file)),
        "files": len(files),
        "classes": len(classes()),
        "twins": len(twins()),
        "CLI commands that are not derived": len(_commands(cli, click.Context(cli))),
    }


def _is_wing(file: Path) -> bool:
    parts = file.relative_to(PACKAGE).with_suffix("").parts
    return any(part in WINGS or part.startswith("metrics") for part in parts)


def _commands(command: click.Command, context: click.Context) -> set[click.Command]:
    """Return the commands below one that are written by hand; one that has two names counts once."""
    if isinstance(command, click.Group):
        found = (command.get_command(context, name) for name in command.list_commands(context))
        below = {each for inner in found if inner for each in _commands(inner, click.Context(inner, parent=context))}
        return below | ({command} if command.invoke_without_command else set())
    return set() if isinstance(command, Derived) else {command}


def words() -> dict[str, int]:
    """Return the words of every page by its path, as `wc -w` counts them; without copies that a build makes."""
    found = [page for page in pages() if not page.is_relative_to(ROOT / "deploy")]
    return {str(page.relative_to(ROOT)): len(_text(page).split()) for page in [*found, ROOT / "CHANGELOG.md"]}


def too_long(found: dict[str, int]) -> list[str]:
    """Return what of the documentation is longer than agreed."""
    decisions = {page: count for page, count in found.items() if page.startswith("docs/adr/")}
    of_map = found["docs/explanation/architecture.md"]
    limits = {
        "words of all pages": (sum(found.values()), 45_000),
        "words of docs/explanation/architecture.md": (of_map, 900),
        "lines of CHANGELOG.md": (len(_text(ROOT / "CHANGELOG.md").splitlines()), 60),
        "decisions": (len(decisions), 15),
        **{f"words of {page}": (count, 350) for page, count in decisions.items()},
    }
    return [f"{count} {what}, at most {most}" for what, (count, most) in limits.items() if count > most]


def _text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def _print_words() -> None:
    found = words()
    for page, count in sorted(found.items(), key=lambda item: -item[1]):
        print(f"{count:6} {page}")
    faults = sum(len(_text(page).split()) for page in FOLDER.glob("*.md"))
    print(f"{sum(found.values()):6} in all; {faults} more of fault pages")
    if exceeded := too_long(found):
        sys.exit("\n".join(exceeded))


def main() -> None:
    """Print the files of each flow, in order, with how often each is entered; or twins; or counts; or words."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--twins", action="store_true", help="print pairs of classes that hold nearly the same fields")
    parser.add_argument("--counts", action="store_true", help="print lines, files, classes, twins and commands")
    parser.add_argument("--words", action="store_true", help="print the words of the documentation; 1 if too many")
    options = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    if options.twins:
        for one, other, shared in twins():
            print(f"{len(shared):3} {one} / {other}: {', '.join(sorted(shared))}")
    if options.counts:
        for what, count in counts().items():
            print(f"{count:6} {what}")
    if options.words:
        _print_words()
    for name in () if options.twins or options.counts or options.words else FLOWS:
        way = way_of(name)
        print(f"{name}: {len(way.times)} files, {len(way.calls)} entrances, from {way.first} to {way.last}")
        for file, times in way.times.items():
            print(f"  {times:3} {file}")


if __name__ == "__main__":
    main()
