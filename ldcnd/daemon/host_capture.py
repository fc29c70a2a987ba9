"""Sampling one axis from the host: a poller that takes whatever time of the line nobody else's poll wants.

Its polls have no deadline and a low priority, so of all polls that are due they go last: the telemetry of the line, the
traced axis's own included, keeps its turns, and waits for at most the one exchange that is on the wire.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ldcnd.bus.poller import NO_DEADLINE_S, Poller, Priority, next_on_grid
from ldcnd.drivers.driver import AxisReading
from ldcnd.errors import BusError
from ldcnd.exchange import Exchange, Timing

Raw = tuple[int | float | None, ...]
Values = tuple[float | None, ...]


@dataclass(frozen=True, slots=True)
class HostSample:
    """What one poll said of each channel, and between which instants of the loop's clock that was true."""

    raw: Raw
    values: Values
    from_s: float
    until_s: float

    @property
    def at_s(self) -> float:
        """The middle."""
        return (self.from_s + self.until_s) / 2

    @property
    def error_s(self) -> float:
        """How far the true instant can be from the middle."""
        return (self.until_s - self.from_s) / 2


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is to be kept.

    Attributes:
        measure: returns the raw and the scaled values of a reading.
        fires: told the values of each sample and whether enough precede it, tells whether it is the trigger; None
            where the first sample counts.
        samples: how many.
        pre_trigger: so many of them before the trigger.
    """

    measure: Callable[[AxisReading], tuple[Raw, Values]]
    fires: Callable[[Values, bool], bool] | None
    samples: int
    pre_trigger: int


class HostCapture(Poller[AxisReading]):
    """Polls until there are enough samples.

    Attributes:
        samples: what counts so far; empty before the trigger.
        trigger_index: which of them fired the trigger; None without one.
        filled: set once a trigger counts, or never will.
        triggered: set once samples count, or never will.
        done: set once there are enough, or never will be.
        missed_polls: how many brought nothing.
        failure: why there will never be enough.
    """

    def __init__(
        self, node: int, exchange: Exchange[AxisReading], start_at_s: float, period_s: float, wanted: Wanted
    ) -> None:
        self.node = node
        self.due_at_s = start_at_s
        self.deadline_at_s = NO_DEADLINE_S
        self.priority = Priority.LOW
        self.samples: list[HostSample] = []
        self.trigger_index: int | None = None
        self.filled = asyncio.Event()
        self.triggered = asyncio.Event()
        self.done = asyncio.Event()
        self.missed_polls = 0
        self.failure: BusError | None = None
        self._exchange = exchange
        self._period_s = period_s
        self._wanted = wanted
        self._before: deque[HostSample] = deque(maxlen=wanted.pre_trigger)
        if not wanted.pre_trigger:
            self.filled.set()
        if wanted.fires is None:
            self.triggered.set()

    def next_exchange(self, now_s: float) -> Exchange[AxisReading]:
        """See `Poller`; without a period the next turn is due at once, otherwise missed periods are skipped."""
        if self._period_s:
            self.due_at_s = next_on_grid(self.due_at_s, self._period_s, now_s)
        else:
            self.due_at_s = now_s
        return self._exchange

    def deliver(self, reply: AxisReading, timing: Timing) -> None:
        """See `Poller`; what comes after the end is not kept."""
        if self.done.is_set():
            return
        raw, values = self._wanted.measure(reply)
        sample = HostSample(raw, values, timing.true_from_s, timing.true_until_s)
        if self.triggered.is_set():
            self.samples.append(sample)
        elif self._fires(values):
            self.trigger_index = len(self._before)
            self.samples = [*self._before, sample]
            self.triggered.set()
        else:
            self._before.append(sample)
            if len(self._before) == self._wanted.pre_trigger:
                self.filled.set()
        if len(self.samples) >= self._wanted.samples:
            self.done.set()

    def missed(self, error: BusError) -> None:  # noqa: ARG002 - their number is enough
        """See `Poller`."""
        self.missed_polls += 1

    def fail(self, error: BusError) -> None:
        """There will be no more samples."""
        if not self.done.is_set():
            self.failure = error
            self.filled.set()
            self.triggered.set()
            self.done.set()

    def _fires(self, values: Values) -> bool:
        return self._wanted.fires is not None and self._wanted.fires(values, self.filled.is_set())
