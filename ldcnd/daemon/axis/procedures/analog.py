"""A motion to a value of the analog position sensor, watched for the software limits: the drive knows none."""

from ldcnd.daemon.axis import guards
from ldcnd.daemon.axis.motion import AxisMotion
from ldcnd.daemon.axis.procedure import Procedure, Turn
from ldcnd.daemon.axis.state import Completion
from ldcnd.drivers.driver import AnalogMotion, AxisReading, StopMode
from ldcnd.errors import ValueOutOfRange
from ldcnd.model.commands import CommandReply, MoveAnalog
from ldcnd.model.samples import AxisState


class AnalogMove(Procedure):
    """One such motion; it ends when the drive says so, and its only step is to stop beyond a software limit."""

    def __init__(self, motion: AxisMotion, turn: Turn, request: MoveAnalog) -> None:
        self.turn = turn
        self._motion = motion
        self._request = request

    async def begin(self) -> CommandReply:
        """See `Procedure`.

        Raises:
            ValueOutOfRange: the target is beyond full scale.
            DriveFault: the sensor reads like a broken one.
        """
        motion, request = self._motion, self._request
        view = motion.tracker.view()
        guards.check_may_move(view)
        self._check_target()
        speed = motion.config.velocity if request.velocity is None else request.velocity
        plan = motion.planner.at_velocity(view, speed, request.acceleration)
        await self.turn.permit.load(
            AnalogMotion(request.target, abs(plan.motion.velocity_counts_per_s), plan.motion.acceleration_counts_per_s2)
        )
        await motion.start(self.turn, AxisState.DISCRETE_MOTION, Completion.PROFILE)
        return motion.reply(self.turn).model_copy(
            update={"target": request.target, "velocity": plan.velocity, "acceleration": plan.acceleration}
        )

    def calls_for_step(self, reading: AxisReading) -> bool:
        """See `Procedure`."""
        limits, tracker = self._motion.config.limits, self._motion.tracker
        if not tracker.referenced or self.outlived(tracker):
            return False
        position = self._motion.telemetry.position(reading.position_counts)
        low, high = limits.position_min, limits.position_max
        return (low is not None and position < low) or (high is not None and position > high)

    async def step(self) -> bool:
        """See `Procedure`: stop."""
        await self._motion.driver.stop(StopMode.SMOOTH)
        self.turn.still_wanted()
        self._motion.stopping(self.turn.command_id, self.turn.verb)
        self._motion.tracker.failing("stopped beyond a software limit")
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
