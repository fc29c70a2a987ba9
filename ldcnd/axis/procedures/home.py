"""Homing step by step: off the switch if the axis stands on it, search, take the reference over, move on.

Every leg is a trapezoid with an end in the drive, so that a search ends even if this host dies.
"""

import math
from dataclasses import dataclass, replace
from enum import Enum

from typing_extensions import override

from ldcnd.axis import guards
from ldcnd.axis.events import CommandOver, LoopSwitched, PlaceKnown, PlaceUnknown
from ldcnd.axis.motion import LEAST_FOLLOWED_COUNTS, AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import LATENCY_S, MotionPlan
from ldcnd.axis.procedure import Procedure
from ldcnd.axis.procedures.probe import check_index_is_seen
from ldcnd.axis.status import Completion
from ldcnd.axis.trapezoid import braking_way
from ldcnd.axis.unmoved import homing
from ldcnd.contract.commands import CommandReply, Home, HomeMethod, HomeStop
from ldcnd.contract.errors import BusError, DriveFault, MalformedRequest, NotSupported
from ldcnd.contract.samples import AxisState
from ldcnd.drives.axis_config import AxisConfig, HomeConfig
from ldcnd.drives.driver import LARGEST_COUNT, AxisReading, HomeCapture, QuietDrive, StopMode
from ldcnd.log import get_logger

log = get_logger("axis")

STOPS = {HomeStop.SMOOTH: StopMode.SMOOTH, HomeStop.ABRUPT: StopMode.ABRUPT, HomeStop.OFF: StopMode.OFF}
ONTO_A_STOP = frozenset({HomeMethod.POSITION_ERROR, HomeMethod.CURRENT})
REBOUND_S = 1.0
"""Longest time for which a shaft may still turn after it has run onto its stop, seconds."""
BEYOND = 1.1
"""Length of a search without a distance, as a multiple of its time-out: the drive ends it if this host does not."""


def runs_onto_switch(search: HomeConfig, counts_per_unit: float) -> bool:
    """Tell whether a search moves towards the limit switch that it looks for."""
    forward = search.velocity * counts_per_unit > 0
    return search.method is (HomeMethod.FORWARD_LIMIT if forward else HomeMethod.REVERSE_LIMIT)


def plan_search(config: AxisConfig, driver: QuietDrive, request: Home) -> HomeConfig:
    """Return the configuration of the axis with what a request says in its place.

    Raises:
        MalformedRequest: neither says how to search, or it contradicts itself.
        NotSupported: the drive cannot capture on that.
    """
    preset = config.home
    method = request.method or (preset.method if preset else None)
    velocity = request.velocity if request.velocity is not None else (preset.velocity if preset else None)
    if method is None or velocity is None:
        missing = "method" if method is None else "velocity"
        raise MalformedRequest(
            f"axis {config.name}: home needs a {missing}; neither the request nor the configuration has one",
            axis=config.name,
            remedy=f"send {missing}, or configure [bus.axis.home]",
        )
    methods = homing(driver).home_methods
    if method not in methods:
        raise NotSupported(
            f"axis {config.name}: {config.model} cannot home on {method}; it can on {', '.join(sorted(methods))}",
            axis=config.name,
            value=method.value,
        )
    asked = {name: value for name in HomeConfig.model_fields if (value := getattr(request, name, None)) is not None}
    if preset and preset.method is not method:
        asked.setdefault("find_velocity", None)  # what was configured is for finding another signal
    if request.alone:
        asked |= {"find_velocity": None, "move_to": None}
    search = (preset or HomeConfig(method=method, velocity=velocity)).model_copy(update=asked)
    if search.stop is HomeStop.OFF and search.move_to is not None:
        raise MalformedRequest(
            f"axis {config.name}: home cannot both open the loop and move to {search.move_to:g} afterwards",
            axis=config.name,
            remedy="leave out move_to, or stop otherwise",
        )
    return search


class Leg(Enum):
    """Where a homing is."""

    FIND = "find"
    """Fast, onto the limit switch; what is captured there does not count."""
    BRAKE = "brake"
    """On the switch, coming to rest."""
    OFF_SWITCH = "off_switch"
    CLEAR = "clear"
    """Off the switch, coming to rest."""
    SEARCH = "search"
    FOUND = "found"
    """Coming to rest before moving on."""


TO_REST = frozenset({Leg.BRAKE, Leg.CLEAR, Leg.FOUND})
"""What follows these begins at rest: most drives take no trapezoid in mid-move (PIC-SERVO manual, 4.4)."""


@dataclass(frozen=True, slots=True)
class _SearchedWay:
    """Where a leg has begun, and how it goes on.

    Attributes:
        from_counts: where it begins.
        velocity_counts_per_s: signed.
        acceleration_counts_per_s2: at which it brakes, too.
        began_s: when, in loop time.
    """

    from_counts: int
    velocity_counts_per_s: float
    acceleration_counts_per_s2: float
    began_s: float

    @property
    def brakes_counts(self) -> float:
        """What it may go between a reading and its rest."""
        speed = abs(self.velocity_counts_per_s)
        return speed * LATENCY_S + braking_way(speed, self.acceleration_counts_per_s2)

    def gone_counts(self, position_counts: int) -> float:
        """Return how far ahead of its begin a position is."""
        return math.copysign(1.0, self.velocity_counts_per_s) * (position_counts - self.from_counts)


class HomeSequence(Procedure):
    """One homing, from the request to the reference."""

    def __init__(self, motion: AxisMotion, permit: Permit, request: Home) -> None:
        self.permit = permit
        self._motion = motion
        self._search = plan_search(motion.config, motion.driver, request)
        self._acceleration = request.acceleration
        self._leg = Leg.SEARCH
        self._way: _SearchedWay | None = None
        self._ahead = HomeMethod.FORWARD_LIMIT  # the limit switch that the leg leads to

    @override
    async def begin(self) -> CommandReply:
        motion, tracker = self._motion, self._motion.tracker
        self.permit.check_state()
        search = self._search
        guards.check_origin(tracker, motion.config.farthest, search.position)
        plan = motion.plans.at(search.velocity, self._acceleration)
        if search.method is HomeMethod.INDEX:
            check_index_is_seen(motion, plan, search.index_width)
        if search.move_to is not None:
            # what follows the search must be possible before it begins
            guards.check_position(tracker, motion.config.limits, search.move_to)
        # the limit switches may not have been in sight at the last poll
        off_switch = runs_onto_switch(search, motion.scale.counts_per_unit) and self._on_switch(await motion.read())
        await motion.reference.forget()  # before the drive captures: the kept reference has another origin
        finds = search.find_velocity is not None and runs_onto_switch(search, motion.scale.counts_per_unit)
        await self._set_out(Leg.OFF_SWITCH if off_switch else Leg.FIND if finds else Leg.SEARCH)
        return motion.reply(
            self.permit, position=search.position, velocity=plan.velocity, acceleration=plan.acceleration
        )

    @override
    def calls_for_step(self, reading: AxisReading) -> bool:
        return self._rests(reading) or (self._leg not in TO_REST and not reading.homing)

    def _rests(self, reading: AxisReading) -> bool:
        return reading.profile_done and self._motion.tracker.status.at_rest

    @override
    async def step(self) -> bool:
        motion, late = self._motion, self._motion.clock.now_s() >= self.deadline_s
        reading = motion.latest()
        if self._leg in TO_REST and not self._rests(reading):
            off = " off the switch" if self._leg is Leg.CLEAR else ""
            return await self._give_up(f"not at rest{off} within {self._search.timeout_s:g} s") if late else True
        match self._leg:
            case Leg.CLEAR if self._on_switch(reading):
                return await self._give_up(f"the axis does not come off the {self._search.method} switch")
            case Leg.CLEAR:
                await self._set_out(Leg.SEARCH)
                return True
            case Leg.BRAKE:
                await self._set_out(Leg.OFF_SWITCH)
                return True
            case Leg.FOUND if self._search.move_to is not None:
                return await self._move_on(self._search.move_to)
        if late:  # the latest reading may be of before the leg began
            try:
                reading = await motion.read()
            except BusError:
                return await self._give_up(self._failure())
        if not reading.captured:
            return await self._give_up(self._failure())
        return await self._take_captured(reading)

    async def _take_captured(self, reading: AxisReading) -> bool:
        """Go on behind a leg that has captured something."""
        opened = self._leg is Leg.SEARCH and self._opens_loop
        if self._ahead is not self._search.method and homing(self._motion.driver).stands_on(self._ahead, reading):
            switch = self._ahead.value.replace("_", " ")
            return await self._give_up(f"the drive stopped at the {switch} switch", opened=opened)
        if self._leg is Leg.SEARCH:
            return await self._take_over(reading)
        await self._motion.driver.stop(StopMode.SMOOTH)
        self.permit.still_wanted()
        self._wait_for_rest(Leg.BRAKE if self._leg is Leg.FIND else Leg.CLEAR)
        self._motion.comes_to_rest(self.permit, state=AxisState.HOMING, completion=Completion.PROCEDURE)
        return True

    async def _set_out(self, leg: Leg) -> None:
        """Begin a leg that looks for the mark."""
        motion, search = self._motion, self._search
        away = leg is Leg.OFF_SWITCH
        velocity = -search.velocity if away else search.velocity
        if leg is Leg.FIND and search.find_velocity is not None:
            velocity = math.copysign(search.find_velocity, search.velocity)
        plan = motion.plans.at(velocity, self._acceleration)
        stop = STOPS[search.stop] if leg is Leg.SEARCH else StopMode.SMOOTH
        capture = HomeCapture(search.method, stop, guarded=True)
        leg_motion = replace(
            plan.motion,
            target_counts=self._end_of_leg(plan),
            velocity_counts_per_s=abs(plan.motion.velocity_counts_per_s),
        )
        self._way = _SearchedWay(
            motion.latest().position_counts,
            plan.motion.velocity_counts_per_s,
            plan.motion.acceleration_counts_per_s2,
            motion.clock.now_s(),
        )
        await self.permit.load(leg_motion, home=capture)
        self._leg = leg
        forward = plan.motion.velocity_counts_per_s > 0
        self._ahead = HomeMethod.FORWARD_LIMIT if forward else HomeMethod.REVERSE_LIMIT
        motion.tracker.take(PlaceUnknown())
        # before the start: if that is not confirmed the search ends all the same
        self.deadline_s = motion.clock.now_s() + search.timeout_s
        await motion.start(
            self.permit,
            AxisState.HOMING,
            Completion.PROCEDURE,
            opens_loop=leg is Leg.SEARCH and self._opens_loop,
            follows=search.method not in ONTO_A_STOP,
        )

    def _end_of_leg(self, plan: MotionPlan) -> int:
        search, here = self._search, self._motion.latest().position_counts
        speed = plan.motion.velocity_counts_per_s
        if search.distance is None:
            reach = abs(speed) * search.timeout_s * BEYOND
        else:
            reach = search.distance * abs(self._motion.scale.counts_per_unit)
        return here + round(math.copysign(min(reach, LARGEST_COUNT), speed))

    def _failure(self) -> str:
        search = self._search
        if self._motion.clock.now_s() >= self.deadline_s:
            return f"no {search.method} within {search.timeout_s:g} s"
        if search.distance is None:
            return f"no {search.method} before the search was ended, within its {search.timeout_s:g} s"
        return f"no {search.method} within {search.distance:g} {self._motion.config.unit}"

    @property
    def _opens_loop(self) -> bool:
        """Whether what the search captures opens the loop."""
        return self._search.stop is HomeStop.OFF or self._search.method is HomeMethod.POSITION_ERROR

    async def _give_up(self, failure: str, *, opened: bool = False) -> bool:
        """Bring the axis to rest; where a capture has opened its loop, that is not closed beside a shaft that turns."""
        motion = self._motion
        await motion.driver.stop(StopMode.OFF if opened else StopMode.SMOOTH)
        self.permit.still_wanted()
        log.warning("homing failed", axis=motion.config.name, reason=failure)
        if opened:
            motion.let_go(self.permit, failure)
            return False
        motion.comes_to_rest(self.permit, failure)
        return False

    async def _take_over(self, reading: AxisReading) -> bool:
        """Read what was captured and make it the reference; the axis comes to rest meanwhile."""
        motion, search = self._motion, self._search
        driver, tracker = motion.driver, motion.tracker
        if search.method is HomeMethod.POSITION_ERROR:
            await driver.reset()  # the drive has tripped, as it was meant to, perhaps since it was polled last
            tracker.take(LoopSwitched(on=False, now_s=motion.clock.now_s()))
        else:
            await driver.stop(STOPS[search.stop])
        try:
            captured = await homing(driver).captured_home()
        except DriveFault as error:
            return await self._give_up(error.message, opened=self._opens_loop)
        if not self._is_on_way(captured, reading):
            found = motion.scale.position(captured) - motion.scale.position(reading.position_counts)
            failure = f"the position that was captured is {found:g} {motion.config.unit} from here, not on the way here"
            return await self._give_up(failure, opened=self._opens_loop)
        await driver.clear_warnings()  # homing on the current sets one
        self.permit.still_wanted()
        closed = search.stop is not HomeStop.OFF
        if search.method is HomeMethod.POSITION_ERROR and closed:
            await motion.check_does_not_coast(REBOUND_S)
            await self.permit.power_on()
        tracker.take(LoopSwitched(on=closed, now_s=motion.clock.now_s()))
        tracker.take(PlaceKnown(motion.scale.with_position(captured, search.position)))
        if not closed:
            tracker.take(CommandOver(self.permit.command_id))
            motion.publish_state()
            return False
        if search.move_to is None:
            motion.comes_to_rest(self.permit, state=AxisState.HOMING)
            return False
        self._wait_for_rest(Leg.FOUND)
        return True

    def _wait_for_rest(self, leg: Leg) -> None:
        self._leg, self.deadline_s = leg, self._motion.clock.now_s() + self._search.timeout_s

    def _is_on_way(self, captured: int, reading: AxisReading) -> bool:
        """Tell whether the search has passed a position, or has come so near that readings cannot tell."""
        motion, way = self._motion, self._way
        if way is None:
            return False
        leeway = way.brakes_counts + 2 * max(motion.window_counts, LEAST_FOLLOWED_COUNTS)
        if self._search.method in ONTO_A_STOP and not math.isinf(motion.lags_counts):
            leeway += motion.lags_counts  # it springs back
        gone = way.gone_counts(reading.position_counts)
        if self._opens_loop:  # a load may have sunk back
            gone = max(gone, abs(way.velocity_counts_per_s) * (motion.clock.now_s() - way.began_s))
        return -leeway <= way.gone_counts(captured) <= gone + leeway

    async def _move_on(self, position: float) -> bool:
        motion = self._motion
        plan = motion.plans.to(motion.plans.unwrapped(position), None, None)
        await self.permit.load(plan.motion)
        await motion.start(self.permit, AxisState.HOMING, Completion.PROFILE, plan=plan)
        return False

    def _on_switch(self, reading: AxisReading) -> bool:
        level = reading.reverse_limit if self._search.method is HomeMethod.REVERSE_LIMIT else reading.forward_limit
        return level is not None and level is (self._search.switch_active == "high")
