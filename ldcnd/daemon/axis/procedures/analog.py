"""A motion to a value of the analog position sensor, bounded by the daemon in time, distance and software limits.

In the drive it is a motion at constant velocity that ends when the sensor reads the target (LS-182AP manual, "Load
Trajectory"): with a sensor that does not follow, for which a slipped coupling is enough, it has no end there. Only
limit switches stop it in the drive, where they are armed.
"""

from ldcnd.daemon.axis import guards
from ldcnd.daemon.axis.guards import Permit
from ldcnd.daemon.axis.motion import AxisMotion
from ldcnd.daemon.axis.procedure import Procedure
from ldcnd.daemon.axis.state import AxisTracker, Completion
from ldcnd.drivers.driver import AnalogMotion, AxisReading
from ldcnd.errors import ValueOutOfRange
from ldcnd.model.commands import CommandReply, MoveAnalog
from ldcnd.model.samples import AxisState


class AnalogMove(Procedure):
    """One such motion; it ends when the drive says so, and its only step is to stop at one of its bounds."""

    def __init__(self, motion: AxisMotion, permit: Permit, request: MoveAnalog) -> None:
        bounds = motion.config.analog
        self.permit = permit
        self._motion = motion
        self._request = request
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
        tracker = motion.tracker
        guards.check_may_move(tracker)
        self._check_target()
        speed = motion.config.velocity if request.velocity is None else request.velocity
        plan = motion.plan_at(speed, request.acceleration)
        self._distance = self._distance or abs(plan.velocity) * self._timeout_s
        self._from_counts = motion.latest().position_counts
        await self.permit.load(
            AnalogMotion(request.target, abs(plan.motion.velocity_counts_per_s), plan.motion.acceleration_counts_per_s2)
        )
        self.deadline_s = motion.clock.now_s() + self._timeout_s
        self._failure = f"not there within {self._timeout_s:g} s"
        await motion.start(self.permit, AxisState.DISCRETE_MOTION, Completion.PROFILE)
        return motion.reply(self.permit, target=request.target, velocity=plan.velocity, acceleration=plan.acceleration)

    def calls_for_step(self, reading: AxisReading) -> bool:
        """See `Procedure`: a bound is reached, or the axis lost its command while it was out of sight and may run."""
        motion, tracker = self._motion, self._motion.tracker
        if tracker.command is None:
            return True
        travelled = abs((reading.position_counts - self._from_counts) / motion.counts_per_unit)
        if self._distance is not None and travelled > self._distance:
            self._failure = f"not there within {self._distance:g} {motion.config.unit}"
            return True
        if not tracker.referenced:
            return False
        position = motion.telemetry.position(reading.position_counts)
        low, high = motion.config.limits.position_min, motion.config.limits.position_max
        if (low is not None and position < low) or (high is not None and position > high):
            self._failure = "stopped beyond a software limit"
            return True
        return False

    async def step(self) -> bool:
        """See `Procedure`: stop. An axis that has lost its loop meanwhile is switched off instead."""
        await self._motion.end(self.permit, self._failure)
        return False

    def outlived(self, tracker: AxisTracker) -> bool:
        """See `Procedure`; without a command the drive may still run until it is seen at rest."""
        if tracker.command is None:
            return tracker.at_rest
        return super().outlived(tracker)

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
