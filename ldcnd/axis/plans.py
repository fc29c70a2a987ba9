"""Plans of the motions of one axis: from a request in axis units to a motion in counts that its drive may be given.

A plan is checked against limits and quantised to the drive's registers; preview.py says with the same code what a
motion would do.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from ldcnd.axis.guards import check_origin, check_position, check_rates
from ldcnd.axis.scale import AxisScale
from ldcnd.axis.straight import LineAxis
from ldcnd.axis.tracker import AxisTracker
from ldcnd.axis.trapezoid import braking_way, duration_from_s, profile_duration_s
from ldcnd.contract.commands import Direction
from ldcnd.contract.errors import NotSupported, PositionLimit, Remedy, ValueOutOfRange, step
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import LARGEST_COUNT, ROUNDING, AxisReading, Ceiling, CountsMotion, PwmOutput, QuietDrive

COUNTER_SHARE = 0.99
"""Of the way to the end of the drive's position counter, which a motion in velocity mode would run through."""
LATENCY_S = 0.2
"""Longest time from a reading to the packet that follows it; what is gone meanwhile must not reach a software limit."""


@dataclass(frozen=True, slots=True)
class MotionPlan:
    """A motion that may be loaded as it is.

    Attributes:
        motion: in counts, as the registers hold it.
        scale: of the axis, as it was planned.
        duration_s: of the profile, without settling; None for a motion without an end.
        full_counts_per_s: its velocity at a speed override of 100 %, before registers round it.
    """

    motion: CountsMotion
    scale: AxisScale
    duration_s: float | None
    full_counts_per_s: float

    @property
    def position(self) -> float | None:
        """Its target in axis units; None for a motion without one."""
        target = self.motion.target_counts
        return None if target is None else self.scale.position(target)

    @property
    def velocity(self) -> float:
        """Its velocity in units a second: positive to a target, signed without one."""
        per_unit = self.scale.counts_per_unit
        return self.motion.velocity_counts_per_s / (per_unit if self.motion.target_counts is None else abs(per_unit))

    @property
    def acceleration(self) -> float:
        """Its acceleration in units a second squared."""
        return self.motion.acceleration_counts_per_s2 / abs(self.scale.counts_per_unit)


def both_s(first: MotionPlan, goal: MotionPlan) -> float:
    """Return how long a motion and the approach that follows it take, without settling."""
    way = abs((goal.motion.target_counts or 0) - (first.motion.target_counts or 0))
    motion = goal.motion
    last_s = profile_duration_s(way, motion.velocity_counts_per_s, motion.acceleration_counts_per_s2)
    return (first.duration_s or 0.0) + last_s


class AxisPlans:
    """Where an axis is, and which motions it may be given from there.

    Attributes:
        config: of the axis, as it is now.
    """

    def __init__(
        self, config: AxisConfig, driver: QuietDrive, tracker: AxisTracker, latest: Callable[[], AxisReading]
    ) -> None:
        """Take what a plan depends on.

        Args:
            config: of the axis.
            driver: of its drive.
            tracker: of its state.
            latest: returns the latest reading.
        """
        self.config = config
        self._driver = driver
        self._tracker = tracker
        self._latest = latest

    @property
    def scale(self) -> AxisScale:
        """The coordinates of the axis."""
        return self._tracker.status.scale

    @property
    def here(self) -> float:
        """Where the axis is by its latest reading, in axis units, counted through all turns."""
        return self.scale.position(self._latest().position_counts)

    @property
    def commanded_counts(self) -> int:
        """Where the axis was sent last, counts; where it is when that has no end, or when something else followed."""
        target_counts = self._tracker.status.target_counts
        return self._latest().position_counts if target_counts is None else target_counts

    def counts_of(self, position: float) -> int:
        """Return the count of the drive that a position stands for; on an axis with a modulo the nearest of them."""
        return self._within_limits(self.unwrapped(position))

    def _within_limits(self, position: float) -> int:
        """Return the count nearest to a position; of one within the software limits it is within them as well."""
        limits = self.config.limits
        if not self._tracker.status.referenced:
            return self.scale.counts(position)
        return self.scale.counts_within(position, limits.position_min, limits.position_max)

    def unwrapped(
        self, position: float, direction: Direction | None = None, *, from_counts: int | None = None
    ) -> float:
        """Return the position, counted through all turns, to which a request means to go.

        Without a modulo that is the position itself. With one it is counted from the commanded position: a position
        equal to that, to a count, is no distance in any direction.

        Args:
            position: in axis units; any turn of it is meant.
            direction: in which the axis turns; the shortest way if missing.
            from_counts: where the axis will be when it turns there, in counts of the drive; the commanded position if
                missing.

        Raises:
            NotSupported: a direction, and the axis has no modulo.
            ValueOutOfRange: it has one, and no count tells of the position where in a turn it is.
        """
        modulo = self.config.modulo
        if modulo is None:
            if direction is not None:
                raise NotSupported(
                    f"axis {self.config.name} has no modulo: its positions have no direction",
                    axis=self.config.name,
                    value=direction.value,
                    remedy="leave direction out, or configure modulo",
                )
            return position
        check_origin(self._tracker, self.config.farthest, position)
        here = self.scale.position(self.commanded_counts if from_counts is None else from_counts)
        forward = (position - here) % modulo
        count = 1.0 / abs(self.scale.counts_per_unit)
        if forward < count or modulo - forward < count:
            way = forward if forward < count else forward - modulo
        elif direction is Direction.NEGATIVE or (direction is not Direction.POSITIVE and forward > modulo / 2):
            way = forward - modulo
        else:
            way = forward
        return here + way

    def shown(self, position: float | None) -> float | None:
        """Return a position as clients see it: on an axis with a modulo from 0 up to it."""
        return None if position is None else self.scale.shown(position)

    def to(self, position: float, velocity: float | None, acceleration: float | None) -> MotionPlan:
        """Plan a trapezoid from where the axis is to a position in axis units, counted through all turns.

        Raises:
            PositionLimit, VelocityLimit, AccelerationLimit: a software limit forbids it; names the nearest value.
            ValueOutOfRange: a register cannot hold it.
            WrongState: the position has not been read yet.
        """
        if velocity is not None and velocity <= 0:
            raise ValueOutOfRange(
                f"axis {self._tracker.name}: velocity {velocity:g} {self._tracker.status.unit}/s is not above 0;"
                " the target gives the direction",
                axis=self._tracker.name,
                value=velocity,
                limit=0.0,
                nearest=-velocity if velocity < 0 else None,
                remedy="send a velocity above 0",
            )
        tracker, scale, from_counts = self._tracker, self.scale, self._latest().position_counts
        speed, rate = self._checked(velocity, acceleration)
        if tracker.status.referenced:
            check_position(tracker, self.config.limits, position)
        away = scale.exact_counts(position) - from_counts
        if abs(away) >= LARGEST_COUNT + 0.5:
            nearest = from_counts + math.copysign(LARGEST_COUNT, away)
            raise ValueOutOfRange(
                f"axis {tracker.name}: target {position:g} {scale.unit} is {abs(away):.10g} counts away,"
                " farther than the drive's 32-bit counter reaches",
                axis=tracker.name,
                value=position,
                limit=LARGEST_COUNT,
                nearest=scale.position(nearest),
                remedy="move there in parts",
            )
        target, counts_per_unit = self._within_limits(position), abs(scale.counts_per_unit)
        full, share = speed * counts_per_unit, tracker.status.speed_share
        motion = self.quantise(CountsMotion(target, full * share, rate * counts_per_unit))
        duration_s = profile_duration_s(
            abs(target - from_counts), motion.velocity_counts_per_s, motion.acceleration_counts_per_s2
        )
        return MotionPlan(motion, scale, duration_s, full)

    def by(
        self, distance: float, velocity: float | None, acceleration: float | None, *, from_counts: int | None = None
    ) -> MotionPlan:
        """Plan a trapezoid by a distance from the commanded position, or from another one.

        Args:
            distance: in axis units, signed.
            velocity: in units a second; the axis default if missing.
            acceleration: likewise.
            from_counts: where it begins, counts; the commanded position if missing.

        Raises:
            PositionLimit, VelocityLimit, AccelerationLimit, ValueOutOfRange, WrongState: as `to`.
        """
        begin = self.scale.position(self.commanded_counts if from_counts is None else from_counts)
        return self.to(begin + distance, velocity, acceleration)

    def at(self, velocity: float, acceleration: float | None, *, in_motion: bool = False) -> MotionPlan:
        """Plan a motion at a constant velocity in units a second, without an end.

        Args:
            velocity: signed.
            acceleration: the default of the axis if missing.
            in_motion: its drive takes it over from the motion under way, with the gains that it has.

        Raises:
            ValueOutOfRange: the velocity is 0, or a register cannot hold it.
            VelocityLimit, AccelerationLimit: a software limit forbids it.
        """
        if velocity == 0:
            raise ValueOutOfRange(
                f"axis {self._tracker.name}: a velocity of 0 is not a motion",
                axis=self._tracker.name,
                value=0.0,
                remedy=Remedy("{}", step("halt")),
            )
        speed, rate = self._checked(velocity, acceleration)
        counts_per_unit = self.scale.counts_per_unit
        full, share = speed * counts_per_unit, self._tracker.status.speed_share
        asked = CountsMotion(None, full * share, rate * abs(counts_per_unit))
        motion = self._driver.quantise(asked, self._ceiling, in_motion=in_motion)
        return MotionPlan(motion, self.scale, None, full)

    def output(self, duty: float) -> PwmOutput:
        """Plan a raw duty, positive forward, that a smooth stop at the default acceleration of the axis ends.

        Raises:
            NotSupported: the drive takes none.
            ValueOutOfRange, RegisterUnknown: as `quantise`.
        """
        counts_per_unit = self.scale.counts_per_unit
        output = PwmOutput(duty, self.config.acceleration * abs(counts_per_unit))
        held = self._driver.quantise_output(output, self._ceiling)
        return held if counts_per_unit > 0 else replace(held, duty=-held.duty)

    def quantise(self, motion: CountsMotion, *, keeps_acceleration: bool = False) -> CountsMotion:
        """Return a motion as the drive's registers will hold it, within the limits of the axis also after rounding.

        Args:
            motion: in counts.
            keeps_acceleration: it is not lowered to the present limit: the motion under way would overrun its goal.

        Raises:
            ValueOutOfRange: a register cannot hold it within the limits; names the nearest value.
            RegisterUnknown: the scale of the registers is not known.
        """
        most = self._ceiling
        return self._driver.quantise(motion, Ceiling(most.velocity_counts_per_s) if keeps_acceleration else most)

    @property
    def _ceiling(self) -> Ceiling:
        limits, counts, pwm = self.config.limits, abs(self.scale.counts_per_unit), self.config.pwm
        return Ceiling(
            math.inf if limits.velocity is None else limits.velocity * counts,
            math.inf if limits.acceleration is None else limits.acceleration * counts,
            pwm.duty if pwm else math.inf,
        )

    def allows(self, motion: CountsMotion) -> bool:
        """Tell whether the present limits allow the target and the acceleration of a motion that was planned before."""
        target, acceleration = motion.target_counts, motion.acceleration_counts_per_s2
        inside = target is None or self._within_limits(self.scale.position(target)) == target
        return inside and acceleration <= self._ceiling.acceleration_counts_per_s2 * (1 + ROUNDING)

    def run_s(self, asked_s: float | None, counts_per_s: float) -> float:
        """Return for how long a motion at a velocity goes on, within what the drive's counter holds.

        Args:
            asked_s: the requested duration; the longest one of the configuration when missing.
            counts_per_s: the velocity.

        Raises:
            ValueOutOfRange: the requested duration is longer than the configuration or the counter allows.
        """
        config, counter_s = self.config, COUNTER_SHARE * LARGEST_COUNT / abs(counts_per_s)
        longest_s = min(config.longest_run_s or config.jog_horizon_s, counter_s)
        if asked_s is None:
            return longest_s
        if asked_s > longest_s:
            raise ValueOutOfRange(
                f"axis {config.name}: a motion at this velocity lasts at most {longest_s:g} s, not {asked_s:g} s",
                axis=config.name,
                value=asked_s,
                limit=longest_s,
                nearest=longest_s,
                remedy="send it again before its end" if longest_s == counter_s else "configure longest_run_s",
            )
        return asked_s

    def run(self, asked_s: float | None, plan: MotionPlan, *, in_motion: bool = False) -> tuple[float, str]:
        """Return where a motion at a velocity ends that is about to begin, in axis units, and in words what ends it.

        Args:
            asked_s: for how long it is to have its velocity; None for as long as it may.
            plan: of the velocity.
            in_motion: it goes on from the velocity that the axis has.

        Raises:
            ValueOutOfRange: as `run_s`.
            PositionLimit: as `end_ahead`.
        """
        run_s = self.run_s(asked_s, plan.motion.velocity_counts_per_s)
        if asked_s is None and self.config.longest_run_s is None and self.limit_ahead(plan.velocity) is not None:
            run_s = math.inf  # the limit is its end
        end, at_limit = self.runs_to(plan, plan.velocity * (run_s + self.ramp_s(asked_s, plan)), in_motion=in_motion)
        return end, self.end_in_words(run_s, plan.velocity, at_limit=at_limit)

    def follows_on(self, acceleration_counts_per_s2: float, target_counts: int | None) -> bool:
        """Tell whether a drive that takes another trapezoid in mid-move can be given one without leaving the limits.

        It slows down at the new acceleration; where that is too low it overshoots its target, and the limit behind it.

        Args:
            acceleration_counts_per_s2: of the new motion.
            target_counts: of the new motion; None for one at a velocity.
        """
        reading, scale = self._latest(), self.scale
        forward, braking = reading.velocity_counts_per_s > 0, self._brakes_within(acceleration_counts_per_s2, LATENCY_S)
        limit = self.limit_ahead(reading.velocity_counts_per_s / scale.counts_per_unit)
        ends = [] if target_counts is None else [target_counts]
        ways = [end - reading.position_counts if forward else reading.position_counts - end for end in ends]
        # it can stop at its target, which is within the limits
        if any(way >= braking for way in ways):
            return True
        if limit is not None:
            room = scale.counts(limit) - reading.position_counts
            if braking > (room if forward else -room):
                return False
        # a target ahead that is too near for that would be overshot
        return not any(way > 0 for way in ways)

    def stands_at(self, acceleration: float | None) -> int:
        """Return where an axis in mid-move can stand at the soonest, in counts.

        A goal that is not far enough behind that for what is late, or not shown, is halted for first; it is no turn
        away.

        Args:
            acceleration: in units a second squared; the default of the axis if missing.
        """
        reading, per_unit = self._latest(), abs(self.scale.counts_per_unit)
        rate = (self.config.acceleration if acceleration is None else acceleration) * per_unit
        way = braking_way(abs(reading.velocity_counts_per_s), rate)
        return round(reading.position_counts + math.copysign(way, reading.velocity_counts_per_s))

    def is_sent_to(self, position: float, direction: Direction | None) -> bool:
        """Tell whether an axis in mid-move is on its way to a position, in the direction if one is given."""
        sent_to, per_unit = self.scale.position(self.commanded_counts), abs(self.scale.counts_per_unit)
        left = round((sent_to - self.here) * per_unit)
        if direction not in {None, Direction.SHORTEST_WAY} and left and (direction is Direction.POSITIVE) != (left > 0):
            return False
        off = math.remainder(position - sent_to, self.config.modulo) if self.config.modulo else position - sent_to
        return abs(off * per_unit) < 1

    def _brakes_within(self, acceleration_counts_per_s2: float, delay_s: float) -> float:
        """Return how far it is at most, in counts, from the latest reading to where the axis can stand.

        Args:
            acceleration_counts_per_s2: at which it brakes.
            delay_s: time from the reading until the drive has the motion, seconds.
        """
        reading = self._latest()
        speed = abs(reading.velocity_counts_per_s) + reading.velocity_resolution_counts_per_s
        return speed * delay_s + braking_way(speed, acceleration_counts_per_s2)

    def in_mid_move(self, plan: MotionPlan) -> MotionPlan:
        """Return a plan with the time that it takes from the velocity that the axis has."""
        motion, reading, target = plan.motion, self._latest(), plan.motion.target_counts
        if target is None:
            return plan
        way = target - reading.position_counts
        before = math.copysign(reading.velocity_counts_per_s, reading.velocity_counts_per_s * way)
        there_s = duration_from_s(abs(way), before, motion.velocity_counts_per_s, motion.acceleration_counts_per_s2)
        return replace(plan, duration_s=there_s)

    def runs_to(self, plan: MotionPlan, way: float, *, in_motion: bool, delay_s: float = 0.0) -> tuple[float, bool]:
        """Return where a motion at a velocity ends, in axis units, and whether that is the software limit ahead.

        Args:
            plan: of the velocity.
            way: that it would make from standstill without limits; negative backwards.
            in_motion: it goes on from the velocity that the axis has, and turns no shaft back that turns its way.
            delay_s: time from the reading until the drive has the motion, seconds.

        Raises:
            PositionLimit: as `end_ahead`.
        """
        if not in_motion:
            return self.end_ahead(self.here, way)
        begin, per_unit = self._turned_from(plan.velocity, plan.acceleration), self.scale.counts_per_unit
        if self._latest().velocity_counts_per_s / per_unit * way > 0:
            least = self._brakes_within(plan.motion.acceleration_counts_per_s2, delay_s) / abs(per_unit)
            behind = math.copysign(1.0, way) * (self.here - begin)
            way = math.copysign(max(abs(way), behind + least), way)
        return self.end_ahead(begin, way)

    def _turned_from(self, velocity: float, acceleration: float) -> float:
        """Return from where a motion from standstill would be at a velocity where and when one from mid-move is."""
        before = self._latest().velocity_counts_per_s / self.scale.counts_per_unit
        slewing = (velocity**2 - before**2) / math.copysign(2 * acceleration, velocity - before)
        return self.here + slewing - math.copysign(braking_way(velocity, acceleration), velocity)

    @staticmethod
    def ramp_s(asked_s: float | None, plan: MotionPlan) -> float:
        """Return what a duration at a velocity that was asked for lacks of the whole motion, seconds.

        What is asked for is time at the velocity: both ramps together go as far as one of them lasts at it.
        """
        return 0.0 if asked_s is None else abs(plan.velocity) / plan.acceleration

    def end_in_words(self, run_s: float, velocity: float, *, at_limit: bool) -> str:
        """Return what ends a motion at a velocity that is not stopped; see `CommandReply.ends`."""
        limit = self.limit_ahead(velocity)
        if at_limit and limit is not None:
            return f"runs until it is stopped, at most to its software limit {limit:g} {self.scale.unit}"
        return f"runs until it is stopped, for at most {run_s:g} s unless it is sent again"

    def limit_ahead(self, velocity: float) -> float | None:
        """Return the software limit that a motion at this velocity runs towards, in axis units; None without one.

        An axis that is not referenced does not know where its limits are.
        """
        limits = self.config.limits
        if not self._tracker.status.referenced:
            return None
        return limits.position_max if velocity > 0 else limits.position_min

    def end_ahead(self, here: float, way: float) -> tuple[float, bool]:
        """Return where a motion at a velocity ends, in axis units, and whether that is the software limit ahead.

        Args:
            here: where it begins, in axis units.
            way: that it would make without limits; negative backwards.

        Raises:
            PositionLimit: the limit ahead was reached: the motion would be none, or one the other way.
        """
        end, forward, limit = here + way, way > 0, self.limit_ahead(way)
        last = None if limit is None else self.scale.position(self._within_limits(limit))
        if last is not None and (here >= last if forward else here <= last):
            raise PositionLimit(
                f"axis {self.config.name} is at its limit {limit:g} {self.scale.unit}",
                axis=self.config.name,
                value=here,
                limit=limit,
                remedy="move it the other way",
            )
        if limit is not None and (end >= limit if forward else end <= limit):
            return limit, True
        behind = self.limit_ahead(-way)
        if behind is not None and (end < behind if forward else end > behind):
            end = behind  # from outside the limits at least to the nearest of them
        return end, False

    def _checked(self, velocity: float | None, acceleration: float | None) -> tuple[float, float]:
        """Return the speed at a speed override of 100 %, and the acceleration, both within their limits."""
        speed = self.config.velocity if velocity is None else velocity
        rate = self.config.acceleration if acceleration is None else acceleration
        check_rates(self._tracker, self.config.limits, speed, rate)
        return speed, rate

    def before_approach(
        self, goal: MotionPlan, velocity: float | None, acceleration: float | None, *, in_motion: bool = False
    ) -> MotionPlan | None:
        """Return the motion from which on a goal is approached from its side; None when one motion to it will do.

        Args:
            goal: the motion to it.
            velocity: the requested one; None for the default of the axis.
            acceleration: likewise.
            in_motion: it goes on from the motion under way, wherever that was to end.

        Raises:
            PositionLimit: that motion would leave the software limits.
        """
        approach = self.config.approach
        if approach is None or goal.position is None:
            return None
        forward = approach.direction == "positive"
        runs = in_motion and not self._latest().profile_done
        here = self.here if runs else self.scale.position(self.commanded_counts)
        way = goal.position - here if forward else here - goal.position
        # one that runs may not have taken the play up yet
        if way >= approach.distance or (way >= 0 and self._tracker.status.approached and not runs):
            return None
        begin = goal.position - approach.signed
        return self.to(begin, velocity, acceleration)

    def on_line(self, plan: MotionPlan) -> LineAxis:
        """Return the share of this axis in a straight line that ends where a plan does, no faster than the plan."""
        motion = plan.motion
        return LineAxis(
            from_counts=self.commanded_counts,
            target_counts=motion.target_counts or 0,
            counts_per_unit=abs(self.scale.counts_per_unit),
            most_velocity=motion.velocity_counts_per_s,
            most_acceleration=motion.acceleration_counts_per_s2,
            quantise=self.quantise,
            cycle_s=self._driver.capture_s,
        )

    def replanned(self, plan: MotionPlan, motion: CountsMotion) -> MotionPlan:
        """Return a plan with another velocity and acceleration, to the same target."""
        share = self.on_line(replace(plan, motion=motion))
        duration_s = profile_duration_s(share.way, share.most_velocity, share.most_acceleration)
        return replace(plan, motion=motion, duration_s=duration_s)
