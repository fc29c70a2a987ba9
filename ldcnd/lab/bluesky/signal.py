"""An item of an axis's telemetry as a Bluesky device that is read and monitored."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import TYPE_CHECKING

from ldcnd.client.axis import Axis as ClientAxis
from ldcnd.client.loop_thread import LoopThread
from ldcnd.client.rig import Rig
from ldcnd.contract.condition import SILENT_S, Alarm, assess
from ldcnd.contract.errors import SessionError
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import (
    AdcSample,
    FaultSample,
    MonitorSample,
    PositionSample,
    Quality,
    Sample,
    StateSample,
    TelemetryItem,
    VelocitySample,
)
from ldcnd.contract.troubles import DAEMON_SILENT
from ldcnd.lab.bluesky.followers import NO_NUMBER, NO_TEXT, Followers, News, ValueCallback, with_quiet
from ldcnd.lab.bluesky.status import Status
from ldcnd.lab.bluesky.values import (
    PATIENCE_S,
    condition_of,
    instant,
    not_known,
    number_key,
    number_keys,
    number_reading,
    quality_now,
    reading,
    refuse_other_unit,
    text_key,
    within,
)

if TYPE_CHECKING:
    from bluesky.protocols import Callback, Hints, Reading
    from event_model.documents import DataKey

TEXTS = frozenset({"state", "fault"})


class Signal:
    """One item of one axis; made by `Devices.signal`. Faults are their codes with commas between, empty for none.

    Attributes:
        name: of the device, and of its reading in documents.
        parent: None; it is part of no other device.
    """

    parent = None

    def __init__(self, name: str, rig: Rig, info: AxisInfo, item: str, loop: LoopThread) -> None:
        self.name = name
        self._rig = rig
        self._axis = info.axis
        self._item = item
        self._source = f"ldcnd://{rig.name}/{info.axis}/{item}"
        self._loop = loop
        self._triggered: Sample | None = None
        self._unit: str | None = None  # as described last
        self._followers: Followers[float | str] = Followers(
            name, loop, self._readings, self._last_news, NO_TEXT if item in TEXTS else NO_NUMBER
        )

    @property
    def hints(self) -> "Hints":
        """Plot the value if it is a number."""
        return {"fields": [] if self._item in TEXTS else [self.name]}

    def trigger(self) -> Status:
        """Wait for a value that was measured from now on, for the next reading; fails when none comes within 10 s."""
        return Status(f"trigger of {self.name}", self._loop.start(self._take_next()))

    async def _take_next(self) -> None:
        self._triggered = None
        problem = f"axis {self._axis}: no {self._item} was measured within {PATIENCE_S:g} s after the trigger"
        async with (
            within(PATIENCE_S, problem, f"raise the rate of {self._item} in the daemon's configuration"),
            self._rig.samples(self._axis, self._item) as samples,
        ):
            not_before_ns = await instant(self._rig)
            async for _, sample in samples:
                if sample.t > not_before_ns and sample.quality is not Quality.BAD:
                    self._triggered = sample
                    return

    async def read(self) -> "dict[str, Reading[float | str]]":
        """Return the value of the last trigger, once, or else the last value, with the time at which it was true.

        Raises:
            SessionError: there is none yet, or the daemon does not answer.
        """
        sample, self._triggered = self._triggered, None
        return (await (self._judged(sample) if sample else self._last_news())).reading

    async def describe(self) -> "dict[str, DataKey]":
        """Return what the value is."""
        if self._item in TEXTS:
            return {self.name: text_key(self._source)}
        _, self._unit = _value(await self._latest())
        return number_keys(self.name, number_key(self._source, self._unit))

    def subscribe(
        self,
        function: "Callback[float | str] | ValueCallback",
        event_type: str | None = None,  # noqa: ARG002 - there is one kind of events
        run: bool | None = None,  # noqa: FBT001 - ophyd's signature
    ) -> None:
        """Call `function` with every value that comes, on the devices' own thread.

        Args:
            function: what is called.
            event_type: accepted for those who name one, as suspenders do.
            run: call with `value` and `timestamp`, as a signal of ophyd does, and when true with the last value at
                once; suspenders need that. A value that is not known any more trips them.
        """
        self._followers.add(function, run)

    def clear_sub(self, function: "Callback[float | str] | ValueCallback") -> None:
        """End a subscription."""
        self._followers.remove(function)

    def get(self) -> float | str:
        """Return the value that subscribers were told last, and the last value where there is none, as ophyd does.

        Raises:
            AxisUnreachable: it is not known any more.
            SessionError: there is none yet, or the daemon does not answer.
        """
        return self._followers.value()

    @property
    def value(self) -> float | str:
        """The value, see `get`."""
        return self.get()

    async def _readings(self, last_first: bool) -> AsyncIterator[News[float | str]]:  # noqa: FBT001
        async with self._rig.watch(self._axis) as axis, self._rig.samples(self._axis, self._item) as samples:
            last = await self._rig.latest(self._axis, self._item) if last_first else None
            if last is not None:
                yield self._of(last, _state(axis), axis)
            async for came in with_quiet(samples):
                if came:
                    yield self._of(came[1], _state(axis), axis)
                elif why := await self._lost(axis):
                    yield News(None, not_known(self._axis, self._item, why))

    async def _lost(self, axis: ClientAxis) -> str:
        """Return why the last value, behind which nothing came, is not known any more; empty while it is."""
        if self._item == TelemetryItem.FAULT:  # what the daemon says itself, also of a drive that does not answer
            return "" if await self._speaks(axis) else DAEMON_SILENT
        condition = condition_of(axis)
        is_known = condition.alarm is not Alarm.INVALID if self._item == TelemetryItem.POSITION else condition.live
        return "" if is_known else condition.mark

    async def _speaks(self, axis: ClientAxis) -> bool:
        """Tell whether the daemon is there: states may be further apart than it may be silent."""
        with suppress(SessionError):
            return axis.state.age_s <= SILENT_S or bool(await self._rig.states())
        return False

    async def _last_news(self) -> News[float | str]:
        return await self._judged(await self._latest())

    async def _judged(self, sample: Sample) -> News[float | str]:
        """Return a sample with what is known of its axis now."""
        if not isinstance(sample, PositionSample):
            return self._of(sample, None)
        latest = self._rig.latest(self._axis, TelemetryItem.STATE)
        state = await asyncio.wrap_future(self._loop.start(latest))
        return self._of(sample, state if isinstance(state, StateSample) else None)

    async def _latest(self) -> Sample:
        sample = await asyncio.wrap_future(self._loop.start(self._rig.latest(self._axis, self._item)))
        if sample is None:
            raise SessionError(
                f"axis {self._axis}: there is no {self._item} yet", axis=self._axis, remedy="see `ldcnd top`"
            )
        return sample

    def _of(self, sample: Sample, state: StateSample | None, axis: ClientAxis | None = None) -> News[float | str]:
        """Return a sample as it is read; what its place is worth, the state of its axis tells.

        Args:
            sample: what was published.
            state: of its axis, the last one.
            axis: knows of newer positions; None where the sample is the last one.
        """
        value, unit = _value(sample)
        refuse_other_unit(self._axis, unit if self._unit is None else self._unit, unit)
        if isinstance(sample, PositionSample):
            condition = assess(state, position_quality=quality_now(sample, axis) if axis else sample.quality)
            problem = condition.mark if condition.alarm is Alarm.INVALID else ""
        else:  # faults are what the daemon says itself
            condition = None
            is_gone = sample.quality is Quality.BAD and not isinstance(sample, FaultSample)
            problem = "the drive does not answer" if is_gone else ""
        at_s = sample.t * 1e-9
        read = (
            {self.name: reading(value, at_s, sample.quality)}
            if self._item in TEXTS
            else number_reading(self.name, value, at_s, sample.quality, condition)
        )
        return News(read, not_known(self._axis, self._item, problem) if problem else None)

    def __repr__(self) -> str:
        return f"<signal {self.name}: {self._source}>"


def _state(axis: ClientAxis) -> StateSample | None:
    with suppress(SessionError):  # none has come yet
        return axis.state.sample
    return None


def _value(sample: Sample) -> tuple[float | str, str]:
    """Return the value of a sample, and its unit."""
    match sample:
        case PositionSample() | VelocitySample() | MonitorSample():
            return sample.value, sample.unit
        case AdcSample():
            return sample.volts, "V"
        case StateSample():
            return sample.state.value, ""
        case FaultSample():
            return ",".join(fault.code for fault in sample.active), ""
    raise TypeError(f"{type(sample).__name__} is no item of an axis")
