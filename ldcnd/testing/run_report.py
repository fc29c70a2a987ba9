"""What a run has done to a rig: watched from outside, alike on a twin and on the rig itself, so that both compare."""

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import Field

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.codec import decode_received
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.events import CommandEvent, CommandStatus, ReadEvents
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.parameters import ReadParameter
from ldcnd.contract.samples import PositionSample, TelemetryItem
from ldcnd.net.session import Publication, SampleKind
from ldcnd.testing.blocking import run_file
from ldcnd.testing.rig import SimulatedRig

EVENT = "event"
STOPS = ("stop", "quick_stop", "halt")
ANY_PARAMETER = "Pn100"
"""Every SmartStep has it; with it the daemon tells how often the drive's EEPROM was written."""
DURATION_SHARE = 0.02
"""Difference of durations that is worth saying, as a share."""
PLACE_SHARE = 0.005
"""The same of a place where an axis was, as a share of the way between its lowest and its highest place."""
HUNTED_COUNTS = 20.0
MOST_ENDS = 5000
"""Most ends of motions that a report keeps for one axis."""
FOLLOWING_FACTOR = 2.0
"""The same of the worst following error, as a ratio: a twin has another mechanics."""
FOLLOWING_SHARE = 1e-4
"""What a closed loop hunts beside that, as a share of the travel."""


class AxisRun(Frozen):
    """One axis in a run, in its units."""

    unit: str
    """Unit of the values."""
    motions: int = Field(ge=0)
    """Motions that began."""
    way: float = Field(ge=0)
    """Way that it has gone, back and forth."""
    lowest: float | None
    """Lowest position that was seen; null when none was."""
    highest: float | None
    """Highest position that was seen; null when none was."""
    to_min: float | None
    """Closest approach to the lower software limit; null without one or when unknown, negative beyond it."""
    to_max: float | None
    """Closest approach to the upper software limit; null without one or when unknown, negative beyond it."""
    travel: float | None
    """From one software limit to the other; null where one is missing."""
    following_error: float | None = Field(ge=0)
    """Largest following error that was seen; null of a drive that reports none."""
    hunts: float = Field(default=0.0, ge=0)
    """What a closed loop hunts around its place."""
    ends: tuple[float, ...] = ()
    """Where its motions ended, in their order; the first 5000."""


class RunReport(Frozen):
    """What a run has done."""

    rig: str
    """The rig."""
    duration_s: float = Field(ge=0)
    """From the first command to the end of the last one, in seconds of the rig."""
    axes: dict[str, AxisRun]
    """The axes that have moved or were commanded, by name."""
    stops: int = Field(ge=0)
    """Stops, quick stops and halts."""
    refusals: tuple[str, ...]
    """Commands that were refused, in their order: axis, verb and code."""
    failures: tuple[str, ...]
    """Commands that failed or were aborted, in their order: axis, verb and code or reason."""
    eeprom_writes: int | None = Field(ge=0)
    """Writes to the EEPROMs of drives; null where the daemon keeps no count of them."""
    bus_use: dict[str, float]
    """Mean share of the time for which bytes were on the wire, by line."""

    def lines(self) -> Iterator[str]:
        """Yield the report as it is read, one line a fact."""
        writes = _told(self.eeprom_writes)
        yield f"rig {self.rig}: {self.duration_s:.2f} s, {self.stops} stops and halts, {writes} EEPROM writes"
        for name, axis in self.axes.items():
            near = [
                f"{distance:.6g} {axis.unit} from its {end} limit"
                for distance, end in ((axis.to_min, "lower"), (axis.to_max, "upper"))
                if distance is not None
            ]
            yield (
                f"axis {name}: {axis.motions} motions, {axis.way:.6g} {axis.unit} of way, from {_told(axis.lowest)}"
                f" to {_told(axis.highest)}, following error up to {_told(axis.following_error)}"
                + (f"; at the nearest {' and '.join(near)}" if near else "")
            )
        yield from (f"refused: {text}" for text in self.refusals)
        yield from (f"not done: {text}" for text in self.failures)
        for bus, share in self.bus_use.items():
            yield f"line {bus}: busy for {share:.0%} of the time"

    def differences(self, real: "RunReport") -> Iterator[str]:
        """Yield where another run differed from this one by more than a twin is good for."""
        if abs(real.duration_s - self.duration_s) > DURATION_SHARE * self.duration_s:
            yield f"duration: {self.duration_s:.2f} s rehearsed, {real.duration_s:.2f} s in the run"
        for what in ("refusals", "failures"):
            rehearsed, found = getattr(self, what), getattr(real, what)
            if rehearsed != found:
                yield f"{what}: {', '.join(rehearsed) or 'none'} rehearsed, {', '.join(found) or 'none'} in the run"
        if self.stops != real.stops:
            yield f"stops and halts: {self.stops} rehearsed, {real.stops} in the run"
        if None not in (self.eeprom_writes, real.eeprom_writes) and self.eeprom_writes != real.eeprom_writes:
            yield f"EEPROM writes: {self.eeprom_writes} rehearsed, {real.eeprom_writes} in the run"
        for name in [*self.axes, *(name for name in real.axes if name not in self.axes)]:
            if name not in self.axes or name not in real.axes:
                yield f"axis {name}: moved in one of the runs only"
            else:
                yield from _differing(name, self.axes[name], real.axes[name])


def _differing(name: str, rehearsed: AxisRun, real: AxisRun) -> Iterator[str]:
    if rehearsed.motions != real.motions:
        yield f"axis {name}: {rehearsed.motions} motions rehearsed, {real.motions} in the run"
    places = (rehearsed.lowest, rehearsed.highest, real.lowest, real.highest)
    known = [place for place in places if place is not None]
    late = rehearsed.following_error or 0.0, real.following_error or 0.0
    span = max(known) - min(known) if known else 0.0
    near = PLACE_SHARE * span + max(rehearsed.hunts, real.hunts)
    for number, (planned, found) in enumerate(zip(rehearsed.ends, real.ends, strict=False), 1):
        if abs(planned - found) > near:
            yield (
                f"axis {name}: motion {number} ended at {planned:.6g} {rehearsed.unit} rehearsed,"
                f" {found:.6g} in the run"
            )
            break
    passed = near + sum(late)  # an axis that is late overshoots
    for what, there, here in (
        ("lowest place", rehearsed.lowest, real.lowest),
        ("highest place", rehearsed.highest, real.highest),
        ("distance to the lower limit", rehearsed.to_min, real.to_min),
        ("distance to the upper limit", rehearsed.to_max, real.to_max),
    ):
        one_is_unknown = (there is None) is not (here is None)
        if one_is_unknown or (there is not None and here is not None and abs(there - here) > passed):
            yield (f"axis {name}: {what} {_told(there)} {rehearsed.unit} rehearsed, {_told(here)} in the run")
    less, more = sorted(late)
    if more > FOLLOWING_FACTOR * less + FOLLOWING_SHARE * span:
        yield (
            f"axis {name}: following error up to {_told(rehearsed.following_error)} {rehearsed.unit} rehearsed,"
            f" {_told(real.following_error)} in the run"
        )


def _told(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.6g}"


@dataclass(slots=True)
class _Seen:
    """What was seen of an axis so far."""

    way: float = 0.0
    lowest: float | None = None
    highest: float | None = None
    following_error: float | None = None
    before: float | None = None
    motions: set[str] = field(default_factory=set)
    ends: list[float] = field(default_factory=list)
    commanded: bool = False

    def take(self, position: PositionSample) -> None:
        value = position.value if position.turns is None else float(position.counts)
        if self.before is not None:
            self.way += abs(value - self.before)
        self.before = value
        self.lowest = value if self.lowest is None else min(self.lowest, value)
        self.highest = value if self.highest is None else max(self.highest, value)
        if self.commanded and position.following_error is not None:
            self.following_error = max(self.following_error or 0.0, abs(position.following_error))


class RunWatch:
    """Collects what a rig publishes during a run."""

    def __init__(self, rig: str, axes: list[AxisInfo]) -> None:
        self._rig = rig
        self._axes = {axis.axis: axis for axis in axes}
        self._seen = {axis.axis: _Seen() for axis in axes}
        self._first_ns: int | None = None
        self._last_ns = 0
        self._stops = 0
        self._refusals: list[str] = []
        self._failures: list[str] = []

    def begin(self, last: Sequence[Publication]) -> None:
        """Take where the axes stand at the beginning."""
        for sample in last:
            if sample.key.endswith(f"/{TelemetryItem.POSITION}"):
                self.take(sample)

    def take(self, sample: Publication) -> None:
        """Take what was published."""
        axis, _, item = sample.key.rpartition("/tele/")[2].partition("/")
        if axis not in self._seen or sample.kind is not SampleKind.PUT:
            return
        if item == TelemetryItem.POSITION:
            self._seen[axis].take(decode_received(PositionSample, sample.payload, sample.encoding))
        elif item == EVENT:
            self._take_event(decode_received(CommandEvent, sample.payload, sample.encoding))

    def _take_event(self, event: CommandEvent) -> None:
        if self._first_ns is None:
            self._first_ns = event.t
        self._last_ns = max(self._last_ns, event.t)
        seen = self._seen[event.axis]
        seen.commanded = True
        if event.status is CommandStatus.EXECUTING:
            seen.motions.add(event.command_id)
        if event.status is CommandStatus.DONE and event.command_id in seen.motions and event.position is not None:
            seen.ends.append(event.position)
        self._stops += event.verb in STOPS and event.status is CommandStatus.DONE
        said = f"{event.axis} {event.verb}: {event.code or event.reason}"
        if event.status is CommandStatus.REFUSED:
            self._refusals.append(said)
        elif event.status in (CommandStatus.FAILED, CommandStatus.ABORTED):
            self._failures.append(said)

    def report(self, bus_use: dict[str, float], eeprom_writes: int | None) -> RunReport:
        """Return what was seen."""
        return RunReport(
            rig=self._rig,
            duration_s=(self._last_ns - self._first_ns) / 1e9 if self._first_ns is not None else 0.0,
            axes={name: self._of_axis(name, seen) for name, seen in self._seen.items() if seen.commanded},
            stops=self._stops,
            refusals=tuple(self._refusals),
            failures=tuple(self._failures),
            eeprom_writes=eeprom_writes,
            bus_use=bus_use,
        )

    def _of_axis(self, name: str, seen: _Seen) -> AxisRun:
        info = self._axes[name]
        low, high = info.limits.position_min, info.limits.position_max
        lowest, highest = seen.lowest, seen.highest
        return AxisRun(
            unit=info.unit if info.modulo is None else "count",
            motions=len(seen.motions),
            way=seen.way,
            lowest=lowest,
            highest=highest,
            to_min=None if low is None or lowest is None else lowest - low,
            to_max=None if high is None or highest is None else high - highest,
            travel=None if low is None or high is None else high - low,
            following_error=seen.following_error,
            hunts=HUNTED_COUNTS / (info.counts_per_unit or math.inf),
            ends=tuple(seen.ends[:MOST_ENDS]),
        )


async def rehearse(rig: SimulatedRig, file: Path, arguments: Sequence[str]) -> tuple[RunReport, Exception | None]:
    """Run a Python program on a simulated rig at the pace of its clock; return the report and what the program raised.

    Args:
        rig: on the jumping clock.
        file: of the program, which finds the rig by `ldcnd.open` and `ldcnd.connect` without an endpoint.
        arguments: of its command line.
    """
    failure: Exception | None = None

    async def program() -> None:
        nonlocal failure
        try:
            await rig.run_blocking(run_file, file, arguments)
        except Exception as error:  # noqa: BLE001 - a program that fails has a report, too
            failure = error
        with contextlib.suppress(TimeoutError):  # it has left something running, and the report says how far it came
            await rig.at_rest()

    running = asyncio.create_task(program(), name="program")
    return await watch_run(rig.client.client, running), failure


async def watch_run(client: RigClient, ended: Awaitable[object]) -> RunReport:
    """Watch a rig until something has ended, and return the report of it."""
    axes, loop = await client.axes(), asyncio.get_running_loop()
    watch, written = RunWatch(client.rig, axes), await _eeprom_writes(client, axes)
    before, began_s = {bus.bus: bus.wire_busy_s for bus in await client.buses()}, loop.time()
    async with client.published(watch.take):
        watch.begin(await client.last_published())
        await ended
        await client.ask(ReadEvents(count=1))  # publishes at once what is published a few milliseconds late otherwise
    passed_s = max(loop.time() - began_s, 1e-9)
    busy_s = {bus.bus: max(0.0, bus.wire_busy_s - before.get(bus.bus, 0.0)) for bus in await client.buses()}
    now_written = await _eeprom_writes(client, axes)
    writes = None if written is None or now_written is None else max(0, now_written - written)
    return watch.report({name: busy / passed_s for name, busy in busy_s.items()}, writes)


async def _eeprom_writes(client: RigClient, axes: list[AxisInfo]) -> int | None:
    """Return how often the EEPROMs of all drives were written so far; None where that is not counted."""
    total = 0
    for axis in axes:
        if Verb.READ_PARAMETER in axis.capabilities:
            try:
                count = (await client.ask(ReadParameter(parameter=ANY_PARAMETER), axis.axis)).value.eeprom_total
            except LdcndError:
                return None
            if count is None:
                return None
            total += count
    return total
