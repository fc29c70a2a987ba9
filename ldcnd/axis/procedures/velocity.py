"""A motion at constant velocity that gets another velocity on its way.

It begins as a trapezoid, which ends in the drive. A trapezoid must not be changed in mid-move, while velocity mode
may be entered and changed at any time (PIC-SERVO manual, 4.4): from its first change on it runs in velocity mode,
which has no end in the drive. The daemon ends it before the software limit or after its duration; only limit switches
that are armed do so without it. PIC-SERVO SC takes a new trapezoid at any time: there it keeps its end in the drive.
"""

from typing_extensions import override

from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import COUNTER_SHARE
from ldcnd.axis.procedures.endless import EndlessMotion
from ldcnd.axis.status import Completion
from ldcnd.contract.commands import CommandReply, MoveVelocity
from ldcnd.contract.samples import AxisState


class VelocityChange(EndlessMotion):
    """A motion in velocity mode, from the change of its velocity to the stop that ends it."""

    def __init__(self, motion: AxisMotion, permit: Permit, request: MoveVelocity) -> None:
        super().__init__(motion, permit)
        self._request = request
        self._velocity = 0.0

    async def begin(self) -> CommandReply:
        """See `Procedure`.

        Raises:
            PositionLimit: a software limit is too near to stop before it.
        """
        motion, request = self._motion, self._request
        self.permit.check_state()
        plan = motion.plans.at(request.velocity, request.acceleration, in_motion=True)
        self._velocity, self.acceleration = plan.velocity, plan.acceleration
        speed_counts = plan.motion.velocity_counts_per_s
        run_s = motion.plans.run_s(request.duration_s, speed_counts)
        await self.look_before_change()
        await self.permit.load(plan.motion)
        room_s = motion.driver.room_counts(forward=speed_counts > 0) / abs(speed_counts)
        last_s = run_s + motion.plans.ramp_s(request.duration_s, plan)
        # before the start: if that is not confirmed the motion is ended all the same
        self._until_s = motion.clock.now_s() + min(last_s, COUNTER_SHARE * room_s)
        await motion.start(self.permit, AxisState.CONTINUOUS_MOTION, Completion.PROCEDURE)
        _, at_limit = motion.plans.end_ahead(motion.plans.here, plan.velocity * last_s)
        ends = motion.plans.end_in_words(run_s, plan.velocity, at_limit=at_limit)
        return motion.reply(self.permit, ends=ends, velocity=plan.velocity, acceleration=plan.acceleration)

    @override
    def fastest(self, velocity: float) -> tuple[float, float]:
        return max(0.0, velocity, self._velocity), max(0.0, -velocity, -self._velocity)
