"""An axis for a module of a SECoP node: what the module shows, and what is done to it."""

import asyncio
import math
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType

from ldcnd.client.axis import Axis
from ldcnd.client.motion import Motion
from ldcnd.client.rig import Rig
from ldcnd.contract.commands import BufferMode
from ldcnd.contract.condition import Alarm, Condition, Place, assess
from ldcnd.contract.errors import CommandAborted, LdcndError, WrongState
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import (
    AdcSample,
    AxisState,
    FaultSample,
    MonitorSample,
    Moving,
    PositionSample,
    Quality,
    Sample,
    StateSample,
    VelocitySample,
)
from ldcnd.contract.units import Dimension, shown_quantity
from ldcnd.lab.borrowed_control import BorrowedControl
from ldcnd.lab.fresh import fresh_samples

WHO = "secop node"


class StatusCode(IntEnum):
    """Codes of the status of a module, as the SECoP specification has them."""

    DISABLED = 0
    IDLE = 100
    WARN = 200
    BUSY = 300
    ERROR = 400


@dataclass(frozen=True, slots=True)
class Update:
    """A new value of a parameter.

    Attributes:
        module: the name of the module.
        parameter: of it.
        value: the value; None when it is not known.
        at_s: when it was true, in seconds since 1970; now when missing.
        error: by how much it may be wrong, in its unit; None when that is not known, as of what is no known place.
        problem: why it is not known.
    """

    module: str
    parameter: str
    value: object = None
    at_s: float | None = None
    error: float | None = None
    problem: str | None = None


Announce = Callable[[Update], None]


class AxisLink:
    """One axis; made by `linked`.

    Attributes:
        info: what it is, as the module is described.
        moves: whether clients may move it.
        speed: of its moves, in units a second; None for the default of the axis.
        former_unit: in which the numbers of its clients may still be: it is not moved before a reset; else None.
        stops: how often it was stopped or switched off from here: what was asked for before one does not begin after
            it. They count from when a client's request is read, on whichever thread.
    """

    def __init__(
        self, rig: Rig, info: AxisInfo, announce: Announce, *, moves: bool, former_unit: str | None = None
    ) -> None:
        self.info = info
        self.moves = moves
        self.former_unit = former_unit
        self.speed: float | None = None
        self._rig = rig
        self._announce = announce
        self._condition: Condition = assess(None)
        self._state: StateSample | None = None
        self._faults: FaultSample | None = None
        self._position: PositionSample | None = None  # the last one since it is heard
        self._target: object = None  # as it is shown
        self._pending = 0
        self._goals = 0  # targets that clients have sent it to so far
        self.stops = 0
        self._counting = threading.Lock()
        self._on_the_way = 0  # commands of motions that have no reply yet
        self._velocity = 0.0
        self._motions: set[asyncio.Task[None]] = set()
        self.control = BorrowedControl(
            rig, info.axis, WHO, is_busy=self.is_busy, on_change=self._show_control, on_taken=self._check_description
        )

    def values(self) -> Mapping[str, str]:
        """Return the units of what the axis publishes besides its position, by the names of their modules."""
        name = self.info.axis
        found = {f"{name}_velocity": shown_quantity(0.0, self.info, Dimension.VELOCITY)[1]}
        if self.info.adc_full_scale:
            found[f"{name}_adc"] = "V"
        return found | {f"{name}_{monitor}": "" for monitor in self.info.monitors}

    def is_busy(self) -> bool:
        """Tell whether the axis moves, or is to move."""
        return bool(self._pending) or (self._state is not None and not self._state.has_ended)

    # -- what it says ------------------------------------------------------------------------------------------------

    async def follow(self) -> None:
        """Show what the axis publishes, until cancelled."""
        axis = self.info.axis
        async with self._rig.samples(axis) as samples:
            for item in self.info.items:
                last = await self._rig.latest(axis, item)
                if last:
                    self.take(last)
            async for sample in fresh_samples(samples):
                if sample is None:
                    if self._state is not None:
                        self._condition = assess(self._state, self._faults, age_s=math.inf)
                        self._state = None
                    self._position = None
                    for module in (axis, *self.values()):
                        self._announce(Update(module, "value", problem=self._unheard))
                    self._show_state()
                else:
                    self.take(sample)

    async def follow_monitor(self, monitor: str) -> None:
        """Show what a monitor publishes, until cancelled."""
        async with self._rig.samples(self.info.axis, f"monitor/{monitor}") as samples:
            async for _, sample in samples:
                if isinstance(sample, MonitorSample):
                    self._show(f"{self.info.axis}_{monitor}", sample, sample.value)

    def take(self, sample: Sample) -> None:
        """Show a sample."""
        match sample:
            case PositionSample() | VelocitySample() if not self.info.describes(sample):
                module, per = ("_velocity", "/s") if isinstance(sample, VelocitySample) else ("", "")
                problem = self._other_unit(sample.unit, per)
                self._announce(Update(f"{self.info.axis}{module}", "value", problem=problem))
            case PositionSample():
                self._position = sample
                self._show_position(sample)
                if self._state is not None:
                    self._show_target()
            case VelocitySample():
                self._velocity = sample.value
                shown, _ = shown_quantity(sample.value, self.info, Dimension.VELOCITY)
                self._show(f"{self.info.axis}_velocity", sample, shown)
            case AdcSample():
                self._show(f"{self.info.axis}_adc", sample, sample.volts)
            case FaultSample():
                self._faults = sample
            case StateSample():
                place = self._condition.place
                self._state, self._condition = sample, assess(sample, self._faults)
                if self._position and self._condition.place is not place:
                    self._show_position(self._position)
                self._show_state()

    def _show_position(self, sample: PositionSample) -> None:
        """Show a position, and how wrong it may be where it says where the axis is."""
        at = assess(self._state, self._faults, position_quality=sample.quality)
        step = 1.0 / self.info.counts_per_unit if self.info.counts_per_unit else 1.0
        error = step + abs(self._velocity) * sample.t_error_ns * 1e-9 if at.place is Place.KNOWN else None
        self._show(self.info.axis, sample, sample.value, error)

    @property
    def _unheard(self) -> str | None:
        """Why what was heard of the axis last may not be so any more; None while it is heard."""
        return None if self._condition.live else self._condition.troubles[0].text

    def _show_state(self) -> None:
        """Show all that is known of the axis besides its values, or why it is not known."""
        if self.moves:
            problem, state = self._unheard, self._state
            self._update("enabled", state.enabled if state and not problem else None, problem=problem)
        self._show_target()
        self._show_status()

    def _other_unit(self, unit: str | None, per: str = "") -> str:
        return f"it is in {unit} now and is described in {self.info.unit}{per}"

    def _show_target(self) -> None:
        """Show where the axis was sent, by any program, or else where it is."""
        if not self.moves or self._on_the_way:
            return
        state, here, problem = self._state, self._position, self._unheard
        if state is not None and not problem:
            problem = self._no_target(state)
            if here is None and not problem:
                return
        target = problem or (
            None if state is None else self.control.set_point(state, lambda: here.value if here else 0.0)
        )
        if target != self._target:
            self._target = target
            self._update("target", None if problem else target, problem=problem)

    def _no_target(self, state: StateSample) -> str | None:
        """Return why it is not known where an axis that is heard goes; None where it is."""
        if not self.info.describes(state):
            return self._other_unit(state.unit)
        return "where it goes is not known" if state.moving is Moving.UNKNOWN else None

    def _show(self, module: str, sample: Sample, value: float, error: float | None = None) -> None:
        if sample.quality is Quality.BAD:
            self._announce(Update(module, "value", at_s=sample.t * 1e-9, problem="it was not measured"))
        else:
            self._announce(Update(module, "value", value, sample.t * 1e-9, error))

    def _update(self, parameter: str, value: object = None, *, problem: str | None = None) -> None:
        self._announce(Update(self.info.axis, parameter, value, problem=problem))

    def _show_status(self) -> None:
        self._update("status", self.status())

    def status(self) -> tuple[int, str]:
        """Return the status of the module: its code, and all that is to be said."""
        said, state = ", ".join(trouble.short for trouble in self._condition.troubles), self._state
        if state is None or self._condition.alarm is Alarm.INVALID:
            return StatusCode.ERROR, said or "its state is not known"
        # after a stop, a fault or power off, too: clients take what is not busy to stand, and to be ready for a reset
        if self.moves and (state.moving is not Moving.NO or state.state is AxisState.STOPPING):
            unknown = "whether it moves is not known: " if state.moving is Moving.UNKNOWN else ""
            return StatusCode.BUSY, unknown + self._condition.summary
        if state.moving is Moving.UNKNOWN:
            return StatusCode.ERROR, said or "its state is not known"
        if self.former_unit:
            return StatusCode.ERROR, ", ".join((self._unit_text, "reset it", *([said] if said else [])))
        if state.state is AxisState.ERROR_STOP or self._condition.alarm is Alarm.MAJOR or state.stop_latched:
            return StatusCode.ERROR, said
        if self.moves and self.is_busy():
            return StatusCode.BUSY, said or state.state.value
        if self.moves and not state.enabled:
            return StatusCode.DISABLED, said or "its position loop is open"
        return (StatusCode.WARN, said) if self._condition.alarm is not Alarm.NONE else (StatusCode.IDLE, said)

    async def _show_control(self, _holder: str) -> None:
        self._show_status()

    # -- what is done to it ------------------------------------------------------------------------------------------

    @property
    def _unit_text(self) -> str:
        return f"its unit is {self.info.unit} now and was {self.former_unit}"

    async def go(self, target: float, stops: int | None = None) -> float:
        """Send the axis to a target; returns once the drive has acknowledged it, or has another one that came later.

        Args:
            target: in the unit of the axis.
            stops: how often it had been stopped when that was asked for; now when missing.

        Raises:
            WrongState: its unit has changed, and it was not reset since then.
            LdcndError: as the move itself.
        """
        if self.former_unit:
            name, unit = self.info.axis, self.info.unit
            raise WrongState(
                f"axis {name}: {self._unit_text}",
                axis=name,
                remedy=f"see that your client shows {unit}, restart its session if it does not, then send `reset`",
            )
        self._goals += 1
        own = self._goals
        try:
            await self._begin(
                lambda axis: axis.move_absolute(target, buffer_mode=BufferMode.ABORTING, velocity=self.speed),
                target,
                stops,
            )
        except CommandAborted:
            if own == self._goals:
                raise
        return target

    async def home(self, stops: int | None = None) -> None:
        """Begin to find the reference position, as the axis's configuration says; `stops` as for `go`."""
        await self._begin(lambda axis: axis.home(), None, stops)

    def stop(self) -> Coroutine[object, object, None]:
        """Return what halts; it counts from here on. See `BorrowedControl.halt`."""
        self._count_stop()
        return self.control.halt()

    def power_off(self) -> Coroutine[object, object, None]:
        """Return what opens the position loop; it counts from here on."""
        self._count_stop()
        return self.control.power_off()

    def _count_stop(self) -> None:
        with self._counting:
            self.stops += 1

    async def clear_errors(self, stops: int | None = None) -> None:
        """Clear the latch and faults, and take numbers in the unit of now; nothing moves. `stops` as for `go`."""
        self._check_not_stopped(stops)
        self.former_unit = None
        self._show_status()
        await self.control.reset()

    async def power_on(self, stops: int | None = None) -> None:
        """Close the position loop; `stops` as for `go`."""
        self._check_not_stopped(stops)
        await self.control.power_on()

    def _check_not_stopped(self, stops: int | None) -> None:
        if stops not in (None, self.stops):
            raise CommandAborted(f"axis {self.info.axis}: stopped before it began", axis=self.info.axis)

    async def _begin(
        self, starting: Callable[[Axis], Awaitable[Motion]], target: float | None, stops: int | None
    ) -> None:
        stops = self.stops if stops is None else stops
        self._check_not_stopped(stops)
        axis = await self.control.taken()
        self._check_not_stopped(stops)
        self._pending += 1
        self._on_the_way += 1
        try:
            motion = await starting(axis)
            if self.stops != stops:  # the halt may have come to the daemon before it
                await self.control.halt()
        except BaseException:
            self._pending -= 1
            raise
        finally:
            self._on_the_way -= 1
        self.control.begun(motion, target if self.info.modulo is None else None)
        self._target = None  # the client is shown what it has put
        task = asyncio.create_task(self._until_end(motion), name=f"motion of {self.info.axis}")
        self._motions.add(task)
        task.add_done_callback(self._motions.discard)
        self._show_status()  # busy before the reply, as the specification wants it
        self._show_target()

    async def _until_end(self, motion: Motion) -> None:
        try:
            await motion.done()
        except LdcndError:
            pass  # the status of the axis says why
        finally:
            self._pending -= 1
            self._show_status()

    async def _check_description(self) -> None:
        """Refuse control of an axis that is not what its module says.

        Raises:
            WrongState: it has another unit or other limits.
        """
        for info in await self._rig.describe():
            if info.axis == self.info.axis and described_by(info) != described_by(self.info):
                raise WrongState(
                    f"axis {info.axis}: it is not any more what its module says", axis=info.axis, remedy="describe anew"
                )


def described_by(info: AxisInfo) -> tuple[object, ...]:
    """Return all of an axis that the description of its modules is made of."""
    return (
        info.unit,
        info.units,
        info.counts_per_unit,
        info.limits,
        info.capabilities,
        info.monitors,
        info.adc_full_scale,
    )


@asynccontextmanager
async def linked(
    rig: Rig,
    infos: Mapping[str, AxisInfo],
    announce: Announce,
    moves: tuple[str, ...],
    former_units: Mapping[str, str] = MappingProxyType({}),
) -> AsyncIterator[dict[str, AxisLink]]:
    """Follow axes, and control those that are moved, until the context ends.

    Args:
        rig: the rig.
        infos: its axes.
        announce: is called with each new value.
        moves: those that clients may move.
        former_units: of axes whose clients may still send numbers in another unit.
    """
    links = {
        name: AxisLink(
            rig, info, announce, moves=name in moves, former_unit=former_units.get(name) if name in moves else None
        )
        for name, info in infos.items()
    }
    tasks: list[asyncio.Task[None]] = []
    async with asyncio.TaskGroup() as group:
        for name, link in links.items():
            tasks.append(group.create_task(link.follow(), name=f"values of {name}"))
            tasks.extend(group.create_task(link.follow_monitor(monitor)) for monitor in link.info.monitors)
            if link.moves:
                tasks.append(group.create_task(link.control.run(), name=f"control of {name}"))
        try:
            yield links
        finally:
            for task in tasks:
                task.cancel()
