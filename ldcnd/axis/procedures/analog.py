"""A motion to a value of the analog position sensor, bounded by the daemon in time, distance and software limits.

In the drive it is a motion at constant velocity that ends when the sensor reads the target (LS-182AP manual, "Load
Trajectory"): with a sensor that does not follow, for which a slipped coupling is enough, it has no end there. Only
limit switches stop it in the drive, where they are armed.
"""

from typing_extensions import override

from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import LATENCY_S
from ldcnd.axis.procedures.endless import EndlessMotion
from ldcnd.axis.rest import SensorEnd
from ldcnd.axis.status import Completion
from ldcnd.contract.commands import CommandReply, MoveAnalog
from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import AnalogMotion, AxisReading, sensed_counts


class AnalogMove(EndlessMotion):
    """One such motion; it ends when the drive says so, and its only step is to stop at one of its bounds."""

    def __init__(self, motion: AxisMotion, permit: Permit, request: MoveAnalog) -> None:
        bounds = motion.config.analog
        super().__init__(motion, permit)
        self._request = request
        self._speed = 0.0
        self._timeout_s = request.timeout_s or bounds.timeout_s
        self._distance = request.distance or bounds.distance
        self._from_counts = 0
        self._failure = ""

    async def begin(self) -> CommandReply:
        """See `Procedure`.

        Raises:
            ValueOutOfRange: the target is beyond full scale.
            DriveFault: the sensor reads like a broken one.
        """
        motion, request = self._motion, self._request
        self.permit.check_state()
        self._check_target()
        speed = motion.config.velocity if request.velocity is None else request.velocity
        plan = motion.plans.at(speed, request.acceleration)
        self._speed, self.acceleration = abs(plan.velocity), plan.acceleration
        self._distance = self._distance or abs(plan.velocity) * self._timeout_s
        self._from_counts = motion.latest().position_counts
        self.check_room()
        held = plan.motion
        await self.permit.load(
            AnalogMotion(
                request.target,
                abs(held.velocity_counts_per_s),
                held.acceleration_counts_per_s2,
                held.servo_divisor,
            )
        )
        value = (await motion.read()).adc_counts  # read from here on: the drive is about to look at it, too
        within = sensed_counts(motion.driver.adc_full_scale or 0)
        sensor_end = None if value is None else SensorEnd(request.target, value, within)
        # before the start: if that is not confirmed the motion is ended all the same
        self._until_s = motion.clock.now_s() + self._timeout_s
        self._failure = f"not there within {self._timeout_s:g} s"
        await motion.start(self.permit, AxisState.DISCRETE_MOTION, Completion.PROFILE, sensor_end=sensor_end)
        return motion.reply(self.permit, target=request.target, velocity=plan.velocity, acceleration=plan.acceleration)

    def calls_for_step(self, reading: AxisReading) -> bool:
        """See `Procedure`: a bound is reached, or the axis lost its command while it was out of sight and may run."""
        motion, tracker = self._motion, self._motion.tracker
        if tracker.status.command is None:
            return True
        travelled = abs((reading.position_counts - self._from_counts) / motion.scale.counts_per_unit)
        if self._distance is not None and travelled > self._distance:
            self._failure = f"not there within {self._distance:g} {motion.config.unit}"
            return True
        return self.ends_before_limit(reading, tracker.read_at_s)

    @override
    def fastest(self, velocity: float) -> tuple[float, float]:
        """See `EndlessMotion`: the drive chooses the direction."""
        gained = self.acceleration * LATENCY_S
        forward, backward = min(self._speed, velocity + gained), min(self._speed, gained - velocity)
        return max(0.0, velocity, forward), max(0.0, -velocity, backward)

    async def step(self) -> bool:
        """See `Procedure`: stop. An axis that has lost its loop meanwhile is switched off instead."""
        is_near = self._stop_at_s <= self._motion.clock.now_s() < self._until_s
        await self._motion.end(self.permit, "stopped before a software limit" if is_near else self._failure)
        return False

    def _check_target(self) -> None:
        name, full_scale, target = (
            self._motion.config.name,
            self._motion.driver.adc_full_scale or 0,
            self._request.target,
        )
        if target > full_scale:
            raise ValueOutOfRange(
                f"axis {name}: analog target {target} is above full scale {full_scale}",
                axis=name,
                value=target,
                limit=full_scale,
                nearest=full_scale,
            )
