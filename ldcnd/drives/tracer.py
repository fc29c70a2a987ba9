"""The contract between the daemon and whatever records a trace: a drive's own recorder, or the host that polls it."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.contract.traces import (
    DriveTraceInfo,
    TakeTrace,
    TracePhase,
    TraceShape,
    TraceSource,
    TraceTrigger,
    TriggerKind,
)

SIGNAL_LEVEL = 0.5
"""Between the two values of a signal."""
Progress = Callable[[TracePhase, float | None], None]
"""Called with each new phase of a trace, and while its memory is read with the share that has been; does not wait."""


@dataclass(frozen=True, slots=True)
class Granted:
    """A trace that is about to begin: its shape, the names of its raw columns, and the phase in which it begins."""

    shape: TraceShape
    raw_columns: tuple[str, ...]
    phase: TracePhase


@dataclass(frozen=True, slots=True)
class Recorded:
    """A finished trace; columns are as long as `offsets_ns`.

    Attributes:
        offsets_ns: when each sample was true, relative to the zero instant: the trigger, or the first sample.
        zero_from_s: the zero instant is not earlier than this, in loop time, and not later than `zero_until_s`.
        values: a column for each channel.
        raw: a column for each raw column.
        trigger_index: the sample at which the trigger was detected; None without one.
        trigger_late_s: maximum time between the condition and its detection, seconds.
        missed: polls that brought no sample.
        drive: settings and assumptions of a drive's own recorder.
        problems: why the values are uncertain; empty when they are good.
    """

    offsets_ns: tuple[int, ...]
    zero_from_s: float
    zero_until_s: float
    values: tuple[tuple[float | None, ...], ...]
    raw: tuple[tuple[int | float | None, ...], ...]
    trigger_index: int | None = None
    trigger_late_s: float = 0.0
    missed: int = 0
    drive: DriveTraceInfo | None = None
    problems: tuple[str, ...] = ()


def level_of(trigger: TraceTrigger) -> float:
    """Return the level of a trigger on what is no signal.

    Raises:
        ValueOutOfRange: it has none.
    """
    if trigger.level is None:
        raise ValueOutOfRange(
            f"a trigger on {trigger.channel!r} needs a level, in the unit of the channel",
            value=trigger.channel,
            remedy="give one: only a signal, which is 0 or 1, needs none",
        )
    return trigger.level


class TriggerWatch:
    """Decides at which sample of the watched channel a trace by the host is triggered.

    Args:
        trigger: the condition.
        signal: the channel is 0 or 1.
        turn: length after which the level comes again, in the unit of the channel; None where it does not.
    """

    def __init__(self, trigger: TraceTrigger, *, signal: bool, turn: float | None = None) -> None:
        self._kind = trigger.kind
        self._turn = turn
        self._level = SIGNAL_LEVEL if signal else level_of(trigger)
        self._before: float | None = None  # of the last sample that had a value

    def fires(self, value: float | None, *, ready: bool) -> bool:
        """Take the next sample and tell whether the trigger fires on it.

        Args:
            value: of the channel; None where the drive did not say, which never fires.
            ready: enough samples precede it; what comes earlier is passed over.
        """
        if value is None:
            return False
        before, self._before = self._before, value
        passed = self._passed(value)
        rose = before is not None and self._passed(before) < passed
        fell = before is not None and passed < self._passed(before)
        above = value % self._turn >= self._level % self._turn if self._turn else bool(passed)
        match self._kind:
            case TriggerKind.RISING:
                met = rose
            case TriggerKind.FALLING:
                met = fell
            case TriggerKind.EITHER:
                met = rose or fell
            case TriggerKind.CHANGE:
                met = before is not None and value != before
            case TriggerKind.ABOVE:
                met = above
            case TriggerKind.BELOW:
                met = not above
        return ready and met

    def _passed(self, value: float) -> int:
        """Return how many levels lie at a value or below it, counted from any of them."""
        return math.floor((value - self._level) / self._turn) if self._turn else int(value >= self._level)


class ArmedTrace(ABC):
    """A trace that has begun or waits for its trigger.

    Attributes:
        granted: what it will be.
    """

    granted: Granted

    @abstractmethod
    async def record(self, progress: Progress) -> Recorded:
        """Wait for the end of the trace and return it; called once. When cancelled it leaves nothing armed.

        Raises:
            TraceTimedOut: it did not end in time; nothing is left armed.
            DriveFault: the drive declined, or has lost its settings.
            BusError: the line failed.
        """


class Tracer(ABC):
    """The interface to trace one axis, one trace at a time.

    Attributes:
        source: who takes the samples.
        channels: what can be recorded.
        full_scales: those whose full scale can be set.
    """

    source: TraceSource
    channels: tuple[str, ...]
    full_scales: frozenset[str] = frozenset()

    @abstractmethod
    async def arm(self, request: TakeTrace) -> ArmedTrace:
        """Begin a trace of such channels, or make it wait for its trigger; moves nothing.

        Raises:
            ValueOutOfRange: there is no such interval, or a number is out of range; nothing was set.
            NotSupported: the drive has no such trigger; nothing was set.
            WrongState: the drive is not ready for it; nothing was set.
            BusyTracing: the drive's recorder is in use.
            BusError: the line failed; nothing is left armed unless the line prevented it.
        """

    @abstractmethod
    async def disarm(self) -> bool:
        """End a trace that another host has left armed; return whether there was one.

        Raises:
            BusError: the line failed.
        """

    def disconnected(self) -> None:  # noqa: B027 - a drive's own recorder runs on without its line
        """The line, or the drive's power, is gone."""
