"""An axis as a Bluesky device: read, moved, stopped and flown by a plan."""

import asyncio
import time
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, TypeVar

from ldcnd.client.axis import Axis as ClientAxis
from ldcnd.client.axis import Positions, at_rest
from ldcnd.client.loop_thread import LoopThread
from ldcnd.client.motion import Motion, Position
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import check_axes
from ldcnd.contract.commands import BufferMode, MoveAbsolute
from ldcnd.contract.condition import Alarm, assess
from ldcnd.contract.errors import (
    AxisUnreachable,
    CommandAborted,
    DriveFault,
    LdcndError,
    NotSupported,
    OutcomeUnknown,
    RequestRefused,
    SessionError,
    StopLatched,
)
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import LinkState, PositionSample, Quality
from ldcnd.lab.bluesky.flight import Flight, Fly
from ldcnd.lab.bluesky.followers import Followers, News, ValueCallback, with_quiet
from ldcnd.lab.bluesky.setting import Setting
from ldcnd.lab.bluesky.status import Status
from ldcnd.lab.bluesky.trace import TraceDetector
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
    from bluesky.protocols import Callback, Hints, Location, Reading
    from event_model.documents import DataKey
    from event_model.documents.event_page import PartialEventPage

FRESH_S = 1.0
"""A position that came longer ago is not read: a newer one is waited for, in seconds."""

ResultT = TypeVar("ResultT")


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
        self._followers: Followers[float | str] = Followers(name, loop, self._readings, self._last_news)

    @property
    def hints(self) -> "Hints":
        """Plot the position."""
        return {"fields": [self.name]}

    async def read(self) -> "dict[str, Reading[float | str]]":
        """Return the position and its quality, stamped with the time at which the drive was there.

        It was measured after the last motion of this device and after the last trigger.

        Raises:
            AxisUnreachable: the drive does not answer.
            LeaseExpired: control was lost.
            SessionError: no position came for 10 s.
        """
        return (await self._there(self._last_news())).reading

    async def describe(self) -> "dict[str, DataKey]":
        """Return what the reading is, by the daemon that is there now."""
        return number_keys(self.name, await self.describe_position())

    async def describe_position(self) -> "DataKey":
        """Return what the position is."""
        self._info = await self._there(described(self._rig, self._info.axis))
        limits = self._info.limits
        return number_key(
            f"{self._source}/position", self._info.unit, limits=(limits.position_min, limits.position_max)
        )

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
        """Wait for a position that is measured from now on, for the next readings."""

        async def measure() -> None:
            positions = self._axis.positions()
            not_before_ns = await instant(self._rig)
            async with within(PATIENCE_S, f"axis {self._info.axis}: no position was measured within {PATIENCE_S:g} s"):
                async for sample in positions:
                    if sample.t > not_before_ns and sample.quality is not Quality.BAD:
                        self._not_before_ns = max(self._not_before_ns, sample.t)
                        return

        return self._start("trigger", measure())

    def subscribe(
        self,
        function: "Callback[float | str] | ValueCallback",
        event_type: str | None = None,  # noqa: ARG002 - there is one kind of events
        run: bool | None = None,  # noqa: FBT001 - ophyd's signature
    ) -> None:
        """Call `function` with the reading of every position that comes, on the devices' own thread.

        Args:
            function: what is called.
            event_type: accepted for those who name one, as suspenders do.
            run: call with `value` and `timestamp`, as a signal of ophyd does, and when true with the last position at
                once; suspenders need that.
        """
        self._followers.add(function, run)

    def clear_sub(self, function: "Callback[float | str] | ValueCallback") -> None:
        """End a subscription."""
        self._followers.remove(function)

    def get(self) -> float:
        """Return the position that subscribers were told last, and else that of `read`, as a signal of ophyd does."""
        return float(self._followers.value())

    @property
    def value(self) -> float:
        """The position, see `get`."""
        return self.get()

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

    async def _readings(self, last_first: bool) -> AsyncIterator[News[float | str]]:  # noqa: FBT001
        positions = self._axis.positions()
        if last_first:
            yield self._known_now()
        async for sample in with_quiet(positions):
            if sample:
                yield self.news_of(sample)
            elif problem := self._known_now().problem:
                yield News(None, problem)

    def _known_now(self) -> News[float | str]:
        """Return the last position without waiting for one; where it is not known, that: it may be known again."""
        condition = condition_of(self._axis)
        if condition.alarm is Alarm.INVALID:
            return News(None, not_known(self._info.axis, "position", condition.mark))
        try:
            return self.news_of(self._axis.position.sample)
        except SessionError as error:  # none has come yet
            return News(None, error)

    async def _last_news(self) -> News[float | str]:
        return self.news_of((await self.measured()).sample)

    def news_of(self, sample: PositionSample) -> News[float | str]:
        """Return the readings that a position is, and what is to be said of it.

        Raises:
            WrongState: its unit is not the one that was described.
        """
        refuse_other_unit(self._info.axis, self._info.unit, sample.unit)
        condition = assess(self._axis.state.sample, position_quality=quality_now(sample, self._axis))
        read = number_reading(self.name, sample.value, sample.t * 1e-9, sample.quality, condition)
        is_known = condition.alarm is not Alarm.INVALID
        return News(read, None if is_known else not_known(self._info.axis, "position", condition.mark))

    async def measured(self) -> Position:
        """Return a position that is a measurement, not old, and newer than the end of the last motion."""
        async with within(PATIENCE_S, f"axis {self._info.axis}: no new position came for {PATIENCE_S:g} s"):
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
        return f"<{'axis' if isinstance(self, PlanAxis) else 'read-only axis'} {self.name}: {self._source}>"


class PlanAxis(ReadableAxis):
    """An axis that a plan moves, under a lease of its own; made by `Devices.control`.

    Attributes:
        velocity: of the moves, in units a second; a plan can move it, and None is the default of the axis.
        acceleration: of the moves, in units a second squared; likewise.
    """

    def __init__(self, name: str, axis: ClientAxis, info: AxisInfo, rig: Rig, loop: LoopThread) -> None:
        super().__init__(name, axis, info, rig, loop)
        self.velocity = Setting(self, "velocity", lambda: self._info.limits.velocity)
        self.acceleration = Setting(self, "acceleration", lambda: self._info.limits.acceleration)
        self._under_way = 0
        self._beginning = 0
        self._stopped: bool | None = None
        self._newest: asyncio.Task[object] | None = None  # of the moves that were set
        self._flights: weakref.WeakSet[Flight] = weakref.WeakSet()  # of which it is one
        self._flight = Flight(self.name, (self,), loop)

    # -- moving ------------------------------------------------------------------------------------------------------

    def set(self, value: float, *, timeout: float | None = None) -> Status:
        """Move to a position in axis units; the status is done when the axis stands there, or where it was stopped.

        While a move of this device is under way the axis is sent elsewhere; its status is done when that one is.

        Args:
            value: the position.
            timeout: halt the axis and fail after so long, in seconds.
        """
        return self._begin(f"move to {value:g}", lambda: self._move_or_halt(value, timeout))

    def home(self) -> Status:
        """Find the reference position, as the axis's configuration says."""
        return self._begin("home", lambda: self._end_of(self._axis.home()))

    def power(self, *, on: bool) -> Status:
        """Close or open the position loop; nothing moves."""
        return self._start("power", _discard(self._axis.power(on=on)))

    def reset(self) -> Status:
        """Clear the stop latch and the drive's faults; nothing moves."""
        return self._start("reset", _discard(self._axis.reset()))

    def stop(self, success: bool = True) -> Status:  # noqa: FBT001, FBT002 - the protocol's signature
        """Halt the axis: a deceleration to standstill, never the latch; of one that stands it changes nothing.

        It is sent at once, whether anybody waits for the status or not, and whatever this device knows of the axis:
        whether it stands, the daemon knows. The status fails if the daemon refused it or did not answer: the axis may
        go on then. Nothing is sent once control was lost and nothing of this device is under way: what moves is another
        program's.

        Args:
            success: whether the status of what was halted then is a success.
        """
        for flight in self._flights:
            flight.forget()
        return self._start("stop", self._halt(success=success))

    async def pause(self) -> None:
        """Halt the axis: nothing moves while a plan is paused; the plan begins anew what this device had begun.

        Raises:
            LdcndError: see `stop`.
        """
        await self.stop()

    async def resume(self) -> None:
        """Move nothing; see `Flight.resume`."""
        await self._flight.resume()

    async def locate(self) -> "Location[float]":
        """Return where the axis was sent last, or stands since anything else stopped or moved it, and where it is."""
        position = (await self._there(self.measured())).value
        return {"setpoint": self._axis.target, "readback": position}

    async def check_value(self, value: float) -> None:
        """Move nothing, and raise what a move to a position would be refused for now.

        Raises:
            RequestRefused: as the daemon would refuse it, with the nearest position that it would accept.
        """
        await self._there(self._check(value, self.velocity.value))

    async def read(self) -> "dict[str, Reading[float | str]]":
        """Return the position, its quality and the setpoint, as `locate` does.

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
        now_s = read[f"{self.name}_unit"]["timestamp"]
        for name, value in (await self.read_speeds()).items():
            if value is not None:
                read[f"{self.name}_{name}"] = reading(value, now_s)
        return read

    async def describe_configuration(self) -> "dict[str, DataKey]":
        """Return what the configuration is."""
        keys = await super().describe_configuration()
        return {**keys, **{f"{self.name}_{name}": key for name, key in (await self.describe_speeds()).items()}}

    def configure(self, settings: "Mapping[str, float | None]") -> "tuple[dict[str, Reading[float | None]], ...]":
        """Set `velocity` and `acceleration` of the moves that follow; return both as they were and as they are.

        Raises:
            ValueOutOfRange: above the limit; nothing is set then.
        """
        known: dict[str, Setting] = {"velocity": self.velocity, "acceleration": self.acceleration}
        chosen = {known[name.removeprefix(f"{self.name}_")]: value for name, value in settings.items()}
        before = {setting.name: reading(setting.value, time.time()) for setting in chosen}
        for setting, value in chosen.items():
            setting.check(value)
        for setting, value in chosen.items():
            setting.value = value
        return before, {setting.name: reading(setting.value, time.time()) for setting in chosen}

    # -- fly scans ---------------------------------------------------------------------------------------------------

    def prepare(self, value: Fly) -> Status:
        """Move to the start of a fly scan, after a check of its end."""
        return self._flight.prepare(value)

    def kickoff(self) -> Status:
        """Begin the motion that `prepare` was given; done when the drive has acknowledged it."""
        return self._flight.kickoff()

    def complete(self) -> Status:
        """Return the status of the motion of a fly scan."""
        return self._flight.complete()

    async def describe_collect(self) -> "dict[str, DataKey]":
        """Return what the events of a fly scan hold; the plan names the stream."""
        return await self._flight.describe_collect()

    def collect_pages(self) -> "AsyncIterator[PartialEventPage]":
        """Yield the positions since the last call or the beginning, with the times at which the drive was there."""
        return self._flight.collect_pages()

    def join(self, flight: Flight) -> None:
        """Be one of the axes of a flight: what stops the axis takes from the flight what is prepared."""
        self._flights.add(flight)

    async def stops_so_far(self) -> int | None:
        """Return how often the axis was stopped by anybody, as its daemon counts; None of an earlier version."""
        state = await self._rig.client.state(self._info.axis)
        return state.stops if state else None

    def prepare_flight(
        self, fly: Fly, check: Callable[[], Awaitable[int | None]], sent: Callable[[float | None], None]
    ) -> Status:
        """Move to the start of a flight.

        Args:
            fly: the flight.
            check: is awaited first, and returns the stops so far: behind others nothing begins.
            sent: is told the start as the drive's registers have it.
        """

        async def ready() -> None:
            motion = await self._move(fly.start, after_stops=await check())
            sent(motion.reply.position)

        return self._begin(f"preparation to fly to {fly.end:g}", ready)

    def was_stopped_since(self, stops: int | None) -> bool:
        """Tell whether the axis was stopped by anybody, as far as it is known here."""
        known = self._axis.state.sample.stops
        return stops is not None and known is not None and known > stops

    async def stands_where_sent(self, start: float | None) -> bool:
        """Tell whether the axis was sent nowhere since it was sent to a start, nor moved otherwise, nor its place set.

        Its daemon is asked: a state that has arrived here may be older than what somebody did.
        """
        state = await self._rig.client.state(self._info.axis)
        return not self._under_way and state is not None and state.target is not None and state.target == start

    async def check_flight(self, fly: Fly) -> None:
        """Raise what the motion of a flight would be refused for."""
        await self._check(fly.end, self._velocity_of(fly))

    def begin_flight(self, fly: Fly, began: asyncio.Future[None], after_stops: int | None) -> Status:
        """Move to the end of a flight; see `prepare_flight`."""
        velocity, acceleration = self._velocity_of(fly), self.acceleration.value
        fields = {"position": fly.end, "velocity": velocity, "acceleration": acceleration, "after_stops": after_stops}
        return self._begin(f"fly to {fly.end:g}", lambda: self._end_of(self._axis.begin(MoveAbsolute, **fields), began))

    def positions(self) -> Positions:
        """Return the positions from now on, for the devices' own loop."""
        return self._axis.positions()

    async def place_at(self, t: int) -> "dict[str, Reading[float | str]] | None":
        """Return the readings of an instant, UTC in ns since 1970, on the devices' own loop; None if not known."""
        try:
            found = await self._axis.at(t)
        except LdcndError:
            return None
        if found.position is None or found.unit != self._info.unit:
            return None
        value, modulo = found.position.value, self._info.modulo
        condition = assess(self._axis.state.sample, position_quality=found.quality)
        return number_reading(self.name, value % modulo if modulo else value, t * 1e-9, found.quality, condition)

    def _velocity_of(self, fly: Fly) -> float | None:
        return self.velocity.value if fly.velocity is None else fly.velocity

    async def read_speeds(self) -> dict[str, float | None]:
        """Return the velocity and acceleration of a move as the drive's registers would hold them."""
        move = await self._there(
            self._axis.preview(distance=0, velocity=self.velocity.value, acceleration=self.acceleration.value)
        )
        if move.refusal:
            raise RequestRefused(move.refusal.message, axis=self._info.axis)
        return {"velocity": move.velocity, "acceleration": move.acceleration}

    async def describe_speeds(self) -> "dict[str, DataKey]":
        """Return what velocity and acceleration are, by their names."""
        unit = self._info.unit
        return {
            name: number_key(f"{self._source}/{name}", per)
            for name, per in (("velocity", f"{unit}/s"), ("acceleration", f"{unit}/s2"))
        }

    # -- inside the loop ---------------------------------------------------------------------------------------------

    def _begin(self, name: str, work: Callable[[], Awaitable[object]]) -> Status:
        """Start a motion; from now on `stop` has something to halt.

        What is known of the motions changes on the loop alone: the one that is started here is under way, or over,
        before its caller goes on as often as it is not.
        """

        async def moving() -> None:
            self._under_way += 1
            if not self._beginning:
                self._stopped = None
            try:
                await work()
            except (CommandAborted, DriveFault, RequestRefused) as error:
                with suppress(LdcndError):  # why it ended matters more than what its standstill took
                    await self._rest(is_news=isinstance(error, StopLatched))
                if not (self._is_stop_a_success() and isinstance(error, CommandAborted | RequestRefused)):
                    raise
            finally:
                self._not_before_ns = self._axis.state.sample.t
                self._under_way -= 1

        return self._start(name, moving())

    @contextmanager
    def beginning(self) -> Iterator[None]:
        """Have `stop` concern all that is begun in the context, on the loop: what takes several turns of it."""
        self._beginning += 1
        self._stopped = None
        try:
            yield
        finally:
            self._beginning -= 1

    async def _move(self, target: float, after_stops: int | None = None) -> Motion:
        return await self._end_of(
            self._axis.begin(
                MoveAbsolute,
                position=target,
                buffer_mode=BufferMode.ABORTING if self._under_way > 1 else BufferMode.REFUSE,
                velocity=self.velocity.value,
                acceleration=self.acceleration.value,
                after_stops=after_stops,
            )
        )

    async def _move_or_halt(self, target: float, within_s: float | None) -> None:
        """Move, or wait for the move that was set after it; halt what takes too long."""
        own = self._newest = asyncio.current_task()
        try:
            async with asyncio.timeout(within_s):
                try:
                    await self._move(target)
                except CommandAborted:
                    if self._newest is own or self._newest is None or self.is_stopped():
                        raise
                    await asyncio.shield(self._newest)
        except TimeoutError:
            late = f"axis {self._info.axis}: it did not reach {target:g} {self._info.unit} within {within_s:g} s"
            # the wait that was cancelled has sent a halt; one that was not confirmed is sent again
            if not await self._axis.halt_unfinished():
                raise OutcomeUnknown(
                    f"{late}, and its halt was not confirmed: it may move",
                    axis=self._info.axis,
                    remedy="look whether it moves, and stop it again",
                ) from None
            await at_rest(self._axis)  # what a plan does next may move another axis into its way
            raise CommandAborted(
                f"{late} and was halted",
                axis=self._info.axis,
                remedy="wait longer, or move faster",
            ) from None

    async def _end_of(
        self,
        starting: Coroutine[object, object, Motion],
        began: asyncio.Future[None] | None = None,
    ) -> Motion:
        if self.is_stopped():
            starting.close()
            raise CommandAborted(
                f"axis {self._info.axis}: it was stopped before the motion began", axis=self._info.axis
            )
        motion = await starting
        if began and not began.done():
            began.set_result(None)
        if self.is_stopped():  # it overtook the motion on its way to the daemon
            await self._axis.halt()
        await motion.done()
        return motion

    def is_stopped(self) -> bool:
        """Tell whether what was begun last was stopped by `stop`."""
        return self._stopped is not None

    def _is_stop_a_success(self) -> bool:
        return self._stopped is True

    async def _halt(self, *, success: bool) -> None:
        if self._under_way or self._beginning:
            self._stopped = success
        elif self._axis.control and self._axis.control.lost:
            return
        # by the halt of a motion that was on its way meanwhile; a drive that takes no halt takes no motion either
        with suppress(CommandAborted, NotSupported):
            await (await self._axis.halt()).done()
        await self._rest()

    async def _rest(self, *, is_news: bool = False) -> None:
        """Wait until the axis stands, as far as the daemon knows it; after a stop that is news, in a later state."""
        known = self._axis.state.sample
        async with within(PATIENCE_S, f"axis {self._info.axis}: nothing was received from it for {PATIENCE_S:g} s"):
            while is_news and self._axis.state.sample is known:
                await self._axis.news(None)
        with suppress(OutcomeUnknown):  # as far as the daemon knows: it tells by itself that a drive is silent
            await at_rest(self._axis)

    async def _check(self, target: float, velocity: float | None) -> None:
        reply = await self._axis.preview(position=target, velocity=velocity, acceleration=self.acceleration.value)
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
    check_axes(rig.name, (axis,), infos)
    return infos[axis]


async def _discard(work: Awaitable[object]) -> None:
    await work
