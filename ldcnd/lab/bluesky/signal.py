"""An item of an axis's telemetry as a Bluesky device that is read and monitored."""

import asyncio
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING

from ldcnd.client.loop_thread import LoopThread
from ldcnd.client.rig import Rig
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
    VelocitySample,
)
from ldcnd.lab.bluesky.followers import Followers, ValueCallback
from ldcnd.lab.bluesky.status import Status
from ldcnd.lab.bluesky.values import (
    PATIENCE_S,
    instant,
    number_key,
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
        self._followers: Followers[float | str] = Followers(name, loop, self._readings, self._reading)

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
        return self._of(sample) if sample else await self._reading()

    async def describe(self) -> "dict[str, DataKey]":
        """Return what the value is."""
        if self._item in TEXTS:
            return {self.name: text_key(self._source)}
        _, self._unit = _value(await self._latest())
        return {self.name: number_key(self._source, self._unit)}

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
                once; suspenders need that.
        """
        self._followers.add(function, run)

    def clear_sub(self, function: "Callback[float | str] | ValueCallback") -> None:
        """End a subscription."""
        self._followers.remove(function)

    def get(self) -> float | str:
        """Return the value that subscribers were told last, and the last value where there is none, as ophyd does.

        Raises:
            SessionError: there is none yet, or the daemon does not answer.
        """
        return self._followers.value()

    @property
    def value(self) -> float | str:
        """The value, see `get`."""
        return self.get()

    async def _readings(self, last_first: bool) -> "AsyncIterator[dict[str, Reading[float | str]]]":  # noqa: FBT001
        async with self._rig.samples(self._axis, self._item) as samples:
            last = await self._rig.latest(self._axis, self._item) if last_first else None
            if last is not None:
                yield self._of(last)
            async for _, sample in samples:
                yield self._of(sample)

    async def _reading(self) -> "dict[str, Reading[float | str]]":
        return self._of(await self._latest())

    async def _latest(self) -> Sample:
        sample = await asyncio.wrap_future(self._loop.start(self._rig.latest(self._axis, self._item)))
        if sample is None:
            raise SessionError(
                f"axis {self._axis}: there is no {self._item} yet", axis=self._axis, remedy="see `ldcnd top`"
            )
        return sample

    def _of(self, sample: Sample) -> "dict[str, Reading[float | str]]":
        value, unit = _value(sample)
        refuse_other_unit(self._axis, unit if self._unit is None else self._unit, unit)
        return {self.name: reading(value, sample.t * 1e-9, sample.quality)}

    def __repr__(self) -> str:
        return f"<signal {self.name}: {self._source}>"


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
