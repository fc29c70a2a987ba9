"""Traces by the host: for drives without a recorder of their own, polled as fast as their line allows.

A poller samples one axis with whatever time of the line no other poll wants; a trigger decides when samples count.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from typing_extensions import override

from ldcnd.axis.scale import AxisScale
from ldcnd.contract.errors import BusDown, BusError, TraceTimedOut, ValueOutOfRange
from ldcnd.contract.samples import TelemetryItem
from ldcnd.contract.traces import TakeTrace, TraceChannel, TracePhase, TraceShape, TraceSource, TraceTrigger
from ldcnd.drives.driver import AxisReading, Readable
from ldcnd.drives.tracer import (
    ArmedTrace,
    Granted,
    Progress,
    Recorded,
    Tracer,
    TriggerWatch,
)
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import NO_DEADLINE_S, Exchange, Poller, Priority, Timing, next_on_grid

GRACE_S = 10.0
SLACK = 10.0
"""Maximum factor by which a busy line may stretch a trace before it is given up."""


Raw = tuple[int | float | None, ...]
Values = tuple[float | None, ...]


@dataclass(frozen=True, slots=True)
class HostSample:
    """The values of each channel in one poll, and the loop-clock instants between which they were true."""

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
    """The samples to keep.

    Attributes:
        measure: returns the raw and the scaled values of a reading.
        fires: takes the values of each sample and whether enough precede it, returns whether it is the trigger; None
            where the first sample counts.
        samples: how many.
        pre_trigger: number of them before the trigger.
    """

    measure: Callable[[AxisReading], tuple[Raw, Values]]
    fires: Callable[[Values, bool], bool] | None
    samples: int
    pre_trigger: int


class HostCapture(Poller[AxisReading]):
    """Polls until there are enough samples.

    Attributes:
        samples: the samples kept; empty before the trigger.
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

    @override
    def missed(self, error: BusError) -> None:
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


@dataclass(frozen=True, slots=True)
class HostChannel:
    """How a channel is read.

    Attributes:
        channel: as clients see it.
        raw: what the reading says.
        value: the raw value in the channel's unit.
        item: the item to poll; None for what every reading contains.
        signal: 0 or 1.
        turn: length of a turn that its values count through, in its unit; None where they count through none.
    """

    channel: TraceChannel
    raw: Callable[[AxisReading], int | float | None]
    value: Callable[[float], float] = float
    item: TelemetryItem | None = None
    signal: bool = False
    turn: float | None = None


def host_channels(driver: Readable, scale_of: Callable[[], AxisScale]) -> tuple[HostChannel, ...]:
    """Return what can be sampled of a drive.

    Args:
        driver: the drive.
        scale_of: returns the coordinates of the axis as they are when a sample is taken.
    """
    unit, counts_per_unit = scale_of().unit, scale_of().counts_per_unit
    factor = 1.0 / counts_per_unit

    def position(counts: float) -> float:
        return scale_of().position(counts)

    def to_units(counts: float) -> float:
        return counts / counts_per_unit

    def named(name: str, of_unit: str, times: float | None) -> TraceChannel:
        return TraceChannel(name=name, unit=of_unit, scale=times)

    channels = [
        HostChannel(
            named("position", unit, None), lambda reading: reading.position_counts, position, turn=scale_of().modulo
        ),
        HostChannel(named("velocity", f"{unit}/s", factor), lambda reading: reading.velocity_counts_per_s, to_units),
        HostChannel(
            named("following_error", unit, factor),
            lambda reading: reading.following_error_counts,
            to_units,
            TelemetryItem.POSITION,
        ),
    ]
    if driver.adc_full_scale:
        adc = named("adc", "count", 1.0)
        channels.append(HostChannel(adc, lambda reading: reading.adc_counts, item=TelemetryItem.ADC))
    signals: dict[str, Callable[[AxisReading], bool | None]] = {
        "enabled": lambda reading: reading.enabled,
        "profile_done": lambda reading: reading.profile_done,
        "homing": lambda reading: reading.homing,
        "reverse_limit": lambda reading: reading.reverse_limit,
        "forward_limit": lambda reading: reading.forward_limit,
    }
    channels += [HostChannel(named(name, "", 1.0), _as_number(level), signal=True) for name, level in signals.items()]
    return tuple(channels)


class HostTracer(Tracer):
    """See `Tracer`."""

    source = TraceSource.HOST

    def __init__(
        self, bus: Bus, driver: Readable, channels: tuple[HostChannel, ...], require_reachable: Callable[[], None]
    ) -> None:
        self.channels = tuple(each.channel.name for each in channels)
        self._bus = bus
        self._driver = driver
        self._known = {each.channel.name: each for each in channels}
        self._require_reachable = require_reachable
        self._capture: HostCapture | None = None

    @override
    async def arm(self, request: TakeTrace) -> ArmedTrace:
        axis = self._driver.spec.name
        chosen = tuple(self._known[name] for name in request.channels)
        pre_trigger = request.pre_trigger if request.trigger else 0
        if pre_trigger >= request.samples:
            raise ValueOutOfRange(
                f"axis {axis}: {pre_trigger} samples before the trigger leave none of {request.samples} for it",
                axis=axis,
                value=pre_trigger,
                limit=request.samples - 1,
            )
        exchange = self._driver.reading(frozenset(each.item for each in chosen if each.item))
        shortest_s = self._bus.longest_s(exchange)
        interval_s = 0.0 if request.interval_s == "fastest" else request.interval_s
        if 0.0 < interval_s < shortest_s:
            raise ValueOutOfRange(
                f"axis {axis}: a poll takes up to {shortest_s * 1e3:.2f} ms, more than {interval_s * 1e3:.2f} ms",
                axis=axis,
                value=interval_s,
                limit=shortest_s,
                nearest=shortest_s,
                remedy='ask for "fastest"; every sample has a time of its own',
            )
        self._require_reachable()
        wanted = Wanted(_measuring(chosen), _firing(chosen, request.trigger), request.samples, pre_trigger)
        now_s = asyncio.get_running_loop().time()
        capture = self._capture = HostCapture(self._driver.spec.address, exchange, now_s, interval_s, wanted)
        granted = Granted(
            shape=TraceShape(
                channels=tuple(
                    each.channel.model_copy(update={"raw_column": column}) for column, each in enumerate(chosen)
                ),
                interval_s=interval_s,
                samples=request.samples,
                pre_trigger=pre_trigger,
            ),
            raw_columns=tuple(f"{each.channel.name} of the drive" for each in chosen),
            phase=_first_phase(request.trigger, pre_trigger),
        )
        # armed from here on: what fires the trigger before anybody waits for it is kept
        self._bus.add_poller(capture)
        limit_s = GRACE_S + SLACK * request.samples * max(interval_s, shortest_s)
        return ArmedCapture(axis, self._bus, capture, granted, request.timeout_s, limit_s)

    async def disarm(self) -> bool:
        """See `Tracer`; a capture dies with the daemon that made it."""
        return False

    @override
    def disconnected(self) -> None:
        if self._capture:
            self._capture.fail(BusDown("the drive or its line was lost while it was traced"))


class ArmedCapture(ArmedTrace):
    """See `ArmedTrace`; the capture is polled already."""

    def __init__(
        self, axis: str, bus: Bus, capture: HostCapture, granted: Granted, wait_s: float, limit_s: float
    ) -> None:
        self.granted = granted
        self._axis = axis
        self._bus = bus
        self._capture = capture
        self._wait_s = wait_s
        self._limit_s = limit_s

    @override
    async def record(self, progress: Progress) -> Recorded:
        capture = self._capture
        try:
            async with self._limit(self._wait_s, "the trigger did not come"):
                await capture.filled.wait()
                if self.granted.phase is TracePhase.FILLING and not capture.triggered.is_set():
                    progress(TracePhase.WAITING, None)
                await capture.triggered.wait()
            if capture.trigger_index is not None:
                progress(TracePhase.RECORDING, None)
            async with self._limit(self._limit_s, "the line did not bring the samples"):
                await capture.done.wait()
        finally:
            self._bus.remove_poller(capture)
        if capture.failure:
            raise capture.failure
        return self._recorded(capture.samples)

    @asynccontextmanager
    async def _limit(self, limit_s: float, what: str) -> AsyncIterator[None]:
        try:
            async with asyncio.timeout(limit_s):
                yield
        except TimeoutError:
            raise TraceTimedOut(f"axis {self._axis}: {what} within {limit_s:g} s", axis=self._axis) from None

    def _recorded(self, samples: list[HostSample]) -> Recorded:
        zero_s = samples[self._capture.trigger_index or 0].at_s
        error_s = max(sample.error_s for sample in samples)
        return Recorded(
            offsets_ns=tuple(round((sample.at_s - zero_s) * 1e9) for sample in samples),
            zero_from_s=zero_s - error_s,
            zero_until_s=zero_s + error_s,
            values=tuple(zip(*(sample.values for sample in samples), strict=True)),
            raw=tuple(zip(*(sample.raw for sample in samples), strict=True)),
            trigger_index=self._capture.trigger_index,
            missed=self._capture.missed_polls,
        )


def _first_phase(trigger: TraceTrigger | None, pre_trigger: int) -> TracePhase:
    if trigger is None:
        return TracePhase.RECORDING
    return TracePhase.FILLING if pre_trigger else TracePhase.WAITING


def _as_number(level: Callable[[AxisReading], bool | None]) -> Callable[[AxisReading], int | None]:
    def number(reading: AxisReading) -> int | None:
        known = level(reading)
        return None if known is None else int(known)

    return number


def _measuring(chosen: tuple[HostChannel, ...]) -> Callable[[AxisReading], tuple[Raw, Values]]:
    def measure(reading: AxisReading) -> tuple[Raw, Values]:
        raw = tuple(each.raw(reading) for each in chosen)
        values = (None if said is None else each.value(said) for each, said in zip(chosen, raw, strict=True))
        return raw, tuple(values)

    return measure


def _firing(chosen: tuple[HostChannel, ...], trigger: TraceTrigger | None) -> Callable[[Values, bool], bool] | None:
    if trigger is None:
        return None
    column = next(place for place, each in enumerate(chosen) if each.channel.name == trigger.channel)
    watch = TriggerWatch(trigger, signal=chosen[column].signal, turn=chosen[column].turn)
    return lambda values, ready: watch.fires(values[column], ready=ready)
