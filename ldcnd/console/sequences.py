"""Sequences and named positions of a rig, as pages show them, and the run of one that a page has begun.

The daemon publishes both with its configuration and does nothing with them: a run is a client in this process.
"""

import asyncio
import hashlib
import json
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from typing import Literal

from pydantic import Field

from ldcnd.client.rig_client import RigClient
from ldcnd.client.sequences import SequenceRun
from ldcnd.contract.catalogue import BY_VERB
from ldcnd.contract.codec import error_reply
from ldcnd.contract.commands import About, AxisCommand, ErrorReply, Verb
from ldcnd.contract.errors import LdcndError, WrongState
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import StopCount
from ldcnd.contract.sequences import NamedPosition, SequenceConfig, SequenceStep, StepReport, going_to

Kind = Literal["sequence", "position"]
MARK_BYTES = 8


class FirstCommand(Frozen):
    """A command with which a run begins: what forbids it forbids the run."""

    axis: str
    """The axis."""
    verb: str
    """The command."""
    waits: bool
    """A step before it waits for something, which may end what forbids it now."""


class Runnable(Frozen):
    """A sequence, or the way to a named position."""

    kind: Kind
    """Which of both."""
    name: str
    """As in the configuration."""
    steps: tuple[str, ...]
    """Its steps in words."""
    axes: tuple[str, ...]
    """The axes that a page must control to run it."""
    first: tuple[FirstCommand, ...]
    """The commands with which it begins."""
    mark: str
    """Differs when it would do something else, as after a reload of the configuration."""


class RunnablesReply(Frozen):
    """The sequences and positions of a rig."""

    runnables: tuple[Runnable, ...] = ()
    """In the order of the configuration, sequences first."""
    problem: str | None = None
    """Why they are not known, in words."""


class RunRequest(Frozen):
    """Run a sequence, or go to a position."""

    kind: Kind
    """Which of both."""
    name: str = Field(max_length=63)
    """As in the configuration."""
    mark: str
    """That of the one which the page shows: another one has other steps by now."""
    after_stops: dict[str, StopCount] = Field(default_factory=dict, max_length=256)
    """By axis, the `stops` of its state that the page has shown: nothing begins behind a stop that came since."""


class PauseRequest(Frozen):
    """Have the next step wait, or go on."""

    on: bool
    """True: it waits."""


class RunProgress(Frozen):
    """How far a run is; of the last one of a rig until the next begins."""

    kind: Kind
    """What runs."""
    name: str
    """Its name in the configuration."""
    client: str
    """The page that has begun it."""
    axes: tuple[str, ...]
    """The axes that it controls."""
    of: int
    """Number of steps."""
    step: int = 0
    """Number of the step, from 1; 0 before the first one."""
    title: str = ""
    """The step in words."""
    since: int | None = None
    """Instant at which the step began, or began to wait, UTC in ns since 1970."""
    waits: bool = False
    """The step waits to begin, as the run was paused."""
    paused: bool = False
    """The next step will wait, or this one does."""
    end: Literal["done", "failed", "stopped"] | None = None
    """How it has ended; null while it runs."""
    ended: int | None = None
    """Instant of its end."""
    error: ErrorReply | None = None
    """Why it has failed."""


class _Configured(Frozen):
    """What a client carries out, of the configuration that a daemon publishes; the rest is not read."""

    position: tuple[NamedPosition, ...] = ()
    sequence: tuple[SequenceConfig, ...] = ()


class Catalogue:
    """What can be run on a rig, as its daemon has told it.

    Attributes:
        positions: the named positions.
    """

    def __init__(self, told: _Configured, axes: Collection[AxisInfo]) -> None:
        self.positions: Mapping[str, NamedPosition] = {each.name: each for each in told.position}
        self._units = {info.axis: info for info in axes}
        self._known: dict[tuple[Kind, str], SequenceConfig] = {
            ("sequence", each.name): each for each in told.sequence
        } | {("position", each.name): going_to(each) for each in told.position}

    def reply(self) -> RunnablesReply:
        """Return it for pages."""
        return RunnablesReply(runnables=tuple(self._runnable(kind, name) for kind, name in self._known))

    def find(self, wanted: RunRequest) -> tuple[SequenceConfig, Runnable]:
        """Return what a page wants to run.

        Raises:
            WrongState: it is not any more what the page has shown.
        """
        config = self._known.get((wanted.kind, wanted.name))
        if config is None:
            raise WrongState(
                f"the configuration has no {wanted.kind} {wanted.name!r} any more; nothing has begun",
                value=wanted.name,
                remedy="choose another one",
            )
        found = self._runnable(wanted.kind, wanted.name)
        if found.mark != wanted.mark:
            raise WrongState(
                f"{wanted.kind} {wanted.name} is another one since the configuration was read again; nothing has begun",
                value=wanted.name,
                remedy="look at its steps, then press again",
            )
        return config, found

    def _runnable(self, kind: Kind, name: str) -> Runnable:
        config = self._known[kind, name]
        used = config.used(self.positions)
        means = {
            "steps": config.model_dump(mode="json"),
            "places": [self.positions[step.go].model_dump(mode="json") for step in config.step if step.go],
            "axes": [(info.axis, *info.meaning) for info in (self._units.get(axis) for axis in used) if info],
        }
        return Runnable(
            kind=kind,
            name=name,
            steps=tuple(step.title(self._units, self.positions) for step in config.step),
            axes=tuple(self._units) if config.writes else used,
            first=tuple(self._first(config)),
            mark=hashlib.sha256(json.dumps(means, sort_keys=True).encode()).hexdigest()[: 2 * MARK_BYTES],
        )

    def _first(self, config: SequenceConfig) -> list[FirstCommand]:
        """Return the commands of the first step that does something: what steps before it do to others is not known."""
        for number, step in enumerate(config.step):
            commands = [(axis, Verb.MOVE_ABSOLUTE) for axis in self.positions[step.go].axes] if step.go else []
            if step.do and step.axis and not _takes_energy_out(step):
                commands.append((step.axis, Verb(step.do)))
            if step.do or step.go or step.set:
                waits = number > 0 or bool(step.set)
                return [FirstCommand(axis=axis, verb=verb, waits=waits) for axis, verb in commands]
        return []


def _takes_energy_out(step: SequenceStep) -> bool:
    command = BY_VERB[About.AXIS][str(step.do)].model_validate(dict(step.arguments))
    return isinstance(command, AxisCommand) and command.takes_energy_out


async def read_catalogue(client: RigClient, axes: Collection[AxisInfo]) -> Catalogue:
    """Ask the daemon of a rig what can be run there; `axes` are its descriptions.

    Raises:
        LdcndError: it does not answer, or means something that this version does not know.
    """
    told = await client.read(client.keys.configuration, _Configured)
    return Catalogue(told[0] if told else _Configured(), axes)


class PageRun:
    """One run of a sequence for a page.

    Args:
        first: its progress before the first step.
        tell: gets its progress whenever that is another.
        now_ns: UTC in ns since 1970.

    Attributes:
        progress: how far it is.
    """

    def __init__(self, first: RunProgress, tell: Callable[[RunProgress], None], now_ns: Callable[[], int]) -> None:
        self.progress = first
        self._tell = tell
        self._now_ns = now_ns
        self._sequence: SequenceRun | None = None
        self._task: asyncio.Task[None] | None = None
        self._ending = False
        tell(first)

    @property
    def title(self) -> str:
        """What runs, in words."""
        return f"{self.progress.kind} {self.progress.name}"

    def begin(self, sequence: SequenceRun, task: asyncio.Task[None]) -> None:
        """Note what carries it out."""
        self._sequence, self._task = sequence, task
        task.add_done_callback(self._ended)

    def _ended(self, _task: asyncio.Task[None]) -> None:
        if self.progress.end is None:  # cancelled before it began
            self.over(None, stopped=True)

    def report(self, step: StepReport) -> None:
        """Take what happens to a step."""
        if step.event in {"begun", "paused"}:
            waits = step.event == "paused"
            self._show(step=step.step, title=step.title, since=step.t, waits=waits)

    def pause(self, *, on: bool) -> None:
        """Have the next step wait, or go on."""
        if self._sequence and self.progress.end is None:
            (self._sequence.going.clear if on else self._sequence.going.set)()
            self._show(paused=on)

    def ending(self) -> None:
        """Note that it ends: to be cancelled once more would break off what halts, and what takes control again."""
        self._ending = True

    def cancel(self) -> None:
        """Have it end; one that is over stays as it is."""
        if self._task and not self._ending:
            self.ending()
            self._task.cancel()

    async def stop(self) -> None:
        """End it, and return when what it moved is halted."""
        self.cancel()
        if self._task:
            await asyncio.wait([self._task])

    def over(self, error: LdcndError | None, *, stopped: bool = False) -> None:
        """Note its end."""
        end = "stopped" if stopped else "failed" if error else "done"
        why = error_reply(error) if error else None
        self._show(end=end, ended=self._now_ns(), error=why, waits=False, paused=False)

    def _show(self, **changed: object) -> None:
        self.progress = self.progress.model_copy(update=changed)
        self._tell(self.progress)


class Runs:
    """The run of each rig, the one that goes on or the last one; one at a time.

    Args:
        tell: gets the rig and the progress of its run.
        now_ns: UTC in ns since 1970.

    Attributes:
        stopped: number of requests to end the run of a rig, by rig; a run that was asked for before one does not begin.
    """

    def __init__(self, tell: Callable[[str, RunProgress], None], now_ns: Callable[[], int]) -> None:
        self.now_ns = now_ns
        self.stopped = Counter[str]()
        self._tell = tell
        self._last: dict[str, PageRun] = {}

    def going(self, rig: str) -> PageRun | None:
        """Return the run of a rig that goes on."""
        run = self._last.get(rig)
        return run if run and run.progress.end is None else None

    def refuse_second(self, rig: str) -> None:
        """Refuse to begin a run beside another one.

        Raises:
            WrongState: one goes on.
        """
        if run := self.going(rig):
            raise WrongState(
                f"{run.title} runs on rig {rig}, begun by {run.progress.client}; nothing has begun",
                value=run.progress.name,
                remedy="stop it, or wait for its end",
            )

    def new(self, rig: str, first: RunProgress) -> PageRun:
        """Note a run that begins now."""
        self._last[rig] = PageRun(first, lambda progress: self._tell(rig, progress), self.now_ns)
        return self._last[rig]

    def cancel(self, rig: str, axis: str | None = None) -> None:
        """Have the run of a rig end whose axis is stopped; none means all axes."""
        if (run := self.going(rig)) and (axis is None or axis in run.progress.axes):
            run.cancel()

    async def stop(self, rig: str) -> None:
        """End the run of a rig; without one nothing happens but that none begins that was asked for before."""
        self.stopped[rig] += 1
        if run := self.going(rig):
            await run.stop()
