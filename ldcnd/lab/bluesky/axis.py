"""An axis as a Bluesky device: read, moved, stopped and flown by a plan."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from ldcnd.client.axis import Axis as ClientAxis
from ldcnd.client.loop_thread import LoopThread
from ldcnd.client.motion import Motion, Position
from ldcnd.client.rig import Rig
from ldcnd.contract.condition import assess
from ldcnd.contract.errors import (
    AxisUnreachable,
    CommandAborted,
    DriveFault,
    LdcndError,
    OutcomeUnknown,
    RequestRefused,
    StopLatched,
    UnknownAxis,
    WrongState,
)
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import LinkState, Moving, PositionSample, Quality
from ldcnd.lab.bluesky.status import Status
from ldcnd.lab.bluesky.trace import TraceDetector
from ldcnd.lab.bluesky.values import SILENT_S, instant, number_key, reading, refuse_other_unit, text_key, within

if TYPE_CHECKING:
    from bluesky.protocols import Callback, Hints, Location, Reading
    from event_model.documents import DataKey
    from event_model.documents.event_page import PartialEventPage

FRESH_S = 1.0
"""A position that came longer ago is not read: a newer one is waited for, in seconds."""
PAGE_SAMPLES = 1000
"""Maximum number of positions on a page of a fly scan."""

ResultT = TypeVar("ResultT")


@dataclass(frozen=True, slots=True)
class Fly:
    """A motion during which positions are recorded; what `PlanAxis.prepare` takes.

    Attributes:
        start: where it begins, in axis units.
        end: where it ends, in axis units.
        velocity: of the motion, in units a second; the axis default when missing.
    """

    start: float
    end: float
    velocity: float | None = None


class ReadableAxis:
    """An axis that a plan reads; made by `Devices.watch`.

    Attributes:
        name: of the device, and of its reading in documents.
        parent: None; it is part of no other device.
    """

    parent = None

    def __init__(self, name: str, axis: ClientAxis, info: AxisInfo, rig: Rig, loop: LoopThread) -> None:
        self.name = name
        self._axis = axis
        self._info = info
        self._rig = rig
        self._source = f"ldcnd://{rig.name}/{info.axis}"
        self._loop = loop
        self._not_before_ns = 0
        self._followers: dict[Callback[float], Status] = {}

    @property
    def hints(self) -> "Hints":
        """Plot the position."""
        return {"fields": [self.name]}

    async def read(self) -> "dict[str, Reading[float]]":
        """Return the position, stamped with the time at which the drive was there.

        It was measured after the last motion of this device and after the last trigger.

        Raises:
            AxisUnreachable: the drive does not answer.
            LeaseExpired: control was lost.
            SessionError: no position came for 10 s.
        """
        return await self._there(self._reading())

    async def describe(self) -> "dict[str, DataKey]":
        """Return what the reading is, by the daemon that is there now."""
        self._info = await self._there(described(self._rig, self._info.axis))
        limits = self._info.limits
        return {
            self.name: number_key(
                f"{self._source}/position", self._info.unit, limits=(limits.position_min, limits.position_max)
            )
        }

    async def read_configuration(self) -> "dict[str, Reading[float | str]]":
        """Return what the axis is and, of one that can be moved, how fast it would move."""
        info, now_s = self._info, self._axis.position.sample.t * 1e-9
        said: dict[str, float | str] = {"unit": info.unit, "model": info.model}
        if info.counts_per_unit is not None:
            said["counts_per_unit"] = info.counts_per_unit
        return {f"{self.name}_{name}": reading(value, now_s) for name, value in said.items()}

    async def describe_configuration(self) -> "dict[str, DataKey]":
        """Return what the configuration is."""
        keys = {f"{self.name}_{name}": text_key(f"{self._source}/{name}") for name in ("unit", "model")}
        if self._info.counts_per_unit is not None:
            per_unit = f"count/{self._info.unit}"
            keys[f"{self.name}_counts_per_unit"] = number_key(f"{self._source}/counts_per_unit", per_unit)
        return keys

    def trigger(self) -> Status:
        """Have `read` return a position that was measured from now on, whichever axis has moved until now."""

        async def set_instant() -> None:
            self._not_before_ns = max(self._not_before_ns, await instant(self._rig))

        return self._start("trigger", set_instant())

    def subscribe(self, function: "Callback[float]") -> None:
        """Call `function` with the reading of every position that comes, on the devices' own thread."""

        async def follow() -> None:
            async for sample in self._axis.positions():
                function(self._of(sample))

        self._followers[function] = self._start("subscription", follow())

    def clear_sub(self, function: "Callback[float]") -> None:
        """End a subscription."""
        status = self._followers.pop(function, None)
        if status:
            status.cancel()

    def trace(
        self, *channels: str, samples: int = 500, interval_s: float | None = None, name: str | None = None
    ) -> TraceDetector:
        """Return a detector that takes a trace of this axis at each trigger.

        Args:
            channels: what to record; `meta/axes/<axis>` lists what the axis has.
            samples: how many.
            interval_s: time between two of them; as fast as the line allows when missing.
            name: of the device.
        """
        return TraceDetector(name or f"{self.name}_trace", self._axis, channels, samples, interval_s, self._loop)

    async def _reading(self) -> "dict[str, Reading[float]]":
        return self._of((await self._measured()).sample)

    def _of(self, sample: PositionSample) -> "dict[str, Reading[float]]":
        refuse_other_unit(self._info.axis, self._info.unit, sample.unit)
        condition = assess(self._axis.state.sample)
        return {self.name: reading(sample.value, sample.t * 1e-9, sample.quality, condition)}

    async def _measured(self) -> Position:
        """Return a position that is a measurement, not old, and newer than the end of the last motion."""
        async with within(SILENT_S, f"axis {self._info.axis}: no new position came for {SILENT_S:g} s"):
            while True:
                if self._axis.state.link is LinkState.DOWN:
                    raise AxisUnreachable(
                        f"axis {self._info.axis}: the drive does not answer",
                        axis=self._info.axis,
                        remedy="see `ldcnd top`",
                    )
                position = self._axis.position
                is_new = position.age_s <= FRESH_S and position.sample.t >= self._not_before_ns
                if is_new and position.quality is not Quality.BAD:
                    return position
                await self._axis.news(None)

    async def _there(self, work: Coroutine[object, object, ResultT]) -> ResultT:
        """Run something on the devices' own loop, and wait for it on the caller's."""
        return await asyncio.wrap_future(self._loop.start(work))

    def _start(self, name: str, work: Coroutine[object, object, None]) -> Status:
        return Status(f"{name} of {self.name}", self._loop.start(work))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name}: {self._axis!r}>"


class PlanAxis(ReadableAxis):
    """An axis that a plan moves, under a lease of its own; made by `Devices.control`.

    Attributes:
        velocity: of the moves, in units a second; None for the axis default.
        acceleration: of the moves, in units a second squared; None for the axis default.
    """

    def __init__(self, name: str, axis: ClientAxis, info: AxisInfo, rig: Rig, loop: LoopThread) -> None:
        super().__init__(name, axis, info, rig, loop)
        self.velocity: float | None = None
        self.acceleration: float | None = None
        self._under_way = 0
        self._stopped: bool | None = None
        self._fly: Fly | None = None
        self._flight: Status | None = None
        self._flown: list[PositionSample] = []

    # -- moving ------------------------------------------------------------------------------------------------------

    def set(self, value: float) -> Status:
        """Move to a position in axis units; the status is done when the axis stands there, or where it was stopped."""
        return self._begin(f"move to {value}", lambda: self._move(value, self.velocity))

    def home(self) -> Status:
        """Find the reference position, as the axis's configuration says."""
        return self._begin("home", lambda: self._end_of(self._axis.home()))

    def power(self, *, on: bool) -> Status:
        """Close or open the position loop; nothing moves."""
        return self._start("power", _discard(self._axis.power(on=on)))

    def reset(self) -> Status:
        """Clear the stop latch and the drive's faults; nothing moves."""
        return self._start("reset", _discard(self._axis.reset()))

    async def stop(self, success: bool = True) -> None:  # noqa: FBT001, FBT002 - the protocol's signature
        """Halt what this device has begun, if anything: a deceleration to standstill, never the latch.

        Args:
            success: whether the status of what was halted then is a success.

        Raises:
            LdcndError: the daemon refused it, or did not answer; the axis may go on.
        """
        await self._there(self._halt(success=success))

    async def locate(self) -> "Location[float]":
        """Return where the axis was sent last, or stands since anything else stopped or moved it, and where it is."""
        position = (await self._there(self._measured())).value
        return {"setpoint": self._axis.target, "readback": position}

    async def check_value(self, value: float) -> None:
        """Move nothing, and raise what a move to a position would be refused for now.

        Raises:
            RequestRefused: as the daemon would refuse it, with the nearest position that it would accept.
        """
        await self._there(self._check(value, self.velocity))

    async def read(self) -> "dict[str, Reading[float]]":
        """Return the position and the setpoint, as `locate` does.

        Raises:
            AxisUnreachable: the drive does not answer.
            LeaseExpired: control was lost.
            SessionError: no position came for 10 s.
        """
        read = await super().read()
        here = read[self.name]
        return {**read, f"{self.name}_setpoint": reading(self._axis.target, here["timestamp"])}

    async def describe(self) -> "dict[str, DataKey]":
        """Return what the readings are."""
        described = await super().describe()
        return {**described, f"{self.name}_setpoint": {**described[self.name], "source": f"{self._source}/setpoint"}}

    async def read_configuration(self) -> "dict[str, Reading[float | str]]":
        """Return what the axis is, and the velocity and acceleration of a move, as the drive's registers hold them."""
        read = await super().read_configuration()
        move = await self._there(self._axis.preview(distance=0, velocity=self.velocity, acceleration=self.acceleration))
        if move.refusal:
            raise RequestRefused(move.refusal.message, axis=self._info.axis)
        now_s = read[f"{self.name}_unit"]["timestamp"]
        for name, value in (("velocity", move.velocity), ("acceleration", move.acceleration)):
            if value is not None:
                read[f"{self.name}_{name}"] = reading(value, now_s)
        return read

    async def describe_configuration(self) -> "dict[str, DataKey]":
        """Return what the configuration is."""
        keys = await super().describe_configuration()
        for name, unit in (("velocity", f"{self._info.unit}/s"), ("acceleration", f"{self._info.unit}/s2")):
            keys[f"{self.name}_{name}"] = number_key(f"{self._source}/{name}", unit)
        return keys

    # -- fly scans ---------------------------------------------------------------------------------------------------

    def prepare(self, value: Fly) -> Status:
        """Move to the start of a fly scan, after a check of its end."""

        async def ready() -> None:
            await self._check(value.end, value.velocity)
            await self._move(value.start, self.velocity)
            self._fly = value

        return self._begin(f"preparation to fly to {value.end:g}", ready)

    def kickoff(self) -> Status:
        """Begin the motion that `prepare` was given; done when the drive has acknowledged it."""

        async def kick_off() -> None:
            fly, self._fly = self._fly, None
            if fly is None:
                raise WrongState(
                    f"axis {self._info.axis}: no fly scan is prepared", axis=self._info.axis, remedy="call prepare"
                )
            began = asyncio.get_running_loop().create_future()
            self._flight = self._begin(f"fly to {fly.end:g}", lambda: self._follow(fly, began))
            self._flight.add_callback(lambda flight: self._loop.call(_pass_on, flight, began))
            await began

        return self._start("kickoff", kick_off())

    def complete(self) -> Status:
        """Return the status of the motion of a fly scan."""
        if self._flight is None:
            raise WrongState(f"axis {self._info.axis}: no fly scan is under way", axis=self._info.axis)
        return self._flight

    async def describe_collect(self) -> "dict[str, dict[str, DataKey]]":
        """Return what the pages of a fly scan hold; their stream is called `<name>_fly`."""
        described = await super().describe()
        return {f"{self.name}_fly": {self.name: described[self.name]}}

    def collect_pages(self) -> "Iterator[PartialEventPage]":
        """Yield the positions of the last fly scan, with the times at which the drive was there."""
        samples, self._flown = self._flown, []
        for first in range(0, len(samples), PAGE_SAMPLES):
            page = samples[first : first + PAGE_SAMPLES]
            times = [sample.t * 1e-9 for sample in page]
            values = [sample.value for sample in page]
            yield {"time": times, "data": {self.name: values}, "timestamps": {self.name: list(times)}}

    async def _follow(self, fly: Fly, began: asyncio.Future[None]) -> None:
        """Move to the end of a fly scan and keep the positions on the way."""
        self._flown = []
        positions = self._axis.positions()

        async def keep() -> None:
            async for sample in positions:
                self._flown.append(sample)

        keeping = asyncio.create_task(keep(), name=f"positions of {self.name}")
        try:
            await self._end_of(
                self._axis.move_absolute(fly.end, velocity=fly.velocity, acceleration=self.acceleration), began
            )
            await self._measured()
        finally:
            keeping.cancel()
        if positions.dropped:
            raise OutcomeUnknown(
                f"axis {self._info.axis}: {positions.dropped} positions of the fly scan were lost: this program was too"
                " busy to take them",
                axis=self._info.axis,
            )

    # -- inside the loop ---------------------------------------------------------------------------------------------

    def _begin(self, name: str, work: Callable[[], Awaitable[None]]) -> Status:
        """Start a motion; from now on `stop` has something to halt."""
        self._under_way += 1
        self._stopped = None

        async def moving() -> None:
            try:
                await work()
            except (CommandAborted, DriveFault, RequestRefused) as error:
                with suppress(LdcndError):  # why it ended matters more than what its standstill took
                    await self._rest(is_news=isinstance(error, StopLatched))
                if not (self._stopped and isinstance(error, CommandAborted | RequestRefused)):
                    raise
            finally:
                self._not_before_ns = self._axis.state.sample.t
                self._under_way -= 1

        return self._start(name, moving())

    async def _move(self, target: float, velocity: float | None) -> None:
        await self._end_of(self._axis.move_absolute(target, velocity=velocity, acceleration=self.acceleration))

    async def _end_of(
        self,
        starting: Coroutine[object, object, Motion],
        began: asyncio.Future[None] | None = None,
    ) -> None:
        if self._is_stopped():
            starting.close()
            raise CommandAborted(
                f"axis {self._info.axis}: it was stopped before the motion began", axis=self._info.axis
            )
        motion = await starting
        if began and not began.done():
            began.set_result(None)
        if self._is_stopped():  # it overtook the motion on its way to the daemon
            await self._axis.halt()
        await motion.done()

    def _is_stopped(self) -> bool:
        return self._stopped is not None

    async def _halt(self, *, success: bool) -> None:
        if not self._under_way:
            return
        self._stopped = success
        with suppress(CommandAborted):  # by the halt of a motion that was on its way meanwhile
            await (await self._axis.halt()).done()
        await self._rest()

    async def _rest(self, *, is_news: bool = False) -> None:
        """Wait until the axis stands, as far as the daemon knows it; after a stop that is news, in a later state."""
        known = self._axis.state.sample
        async with within(SILENT_S, f"axis {self._info.axis}: it did not come to rest within {SILENT_S:g} s"):
            while is_news and self._axis.state.sample is known:
                await self._axis.news(None)
            while self._axis.state.moving is not Moving.NO and self._axis.state.link is not LinkState.DOWN:
                await self._axis.news(None)

    async def _check(self, target: float, velocity: float | None) -> None:
        reply = await self._axis.preview(position=target, velocity=velocity, acceleration=self.acceleration)
        if reply.refusal:
            refused = reply.refusal
            raise RequestRefused(
                refused.message, axis=refused.axis, value=refused.value, limit=refused.limit, nearest=refused.nearest
            )
        why = await self._axis.why()
        if why.causes:
            cause = why.causes[0]
            raise RequestRefused(cause.text, axis=why.axis, remedy=cause.remedy)


async def described(rig: Rig, axis: str) -> AxisInfo:
    """Return what an axis is, by the daemon that is there now.

    Raises:
        UnknownAxis: there is no such axis.
    """
    infos = {info.axis: info for info in await rig.describe()}
    if axis not in infos:
        raise UnknownAxis(f"rig {rig.name} has no axis {axis!r}; it has {', '.join(infos)}", axis=axis, value=axis)
    return infos[axis]


def _pass_on(flight: Status, began: asyncio.Future[None]) -> None:
    """Let a motion that ended before it began be the error of its beginning."""
    error = flight.exception()
    if not began.done():
        began.set_exception(error or CommandAborted("the motion was stopped before it began"))


async def _discard(work: Awaitable[object]) -> None:
    await work
