"""A move to a goal from one side: past it first, then back, so that the play of the mechanics is always taken up.

A move that already goes the right way, far enough to take the play up, is one motion, and so is one that goes on in
that direction from where the last such move has ended.
"""

from dataclasses import replace

from typing_extensions import override

from ldcnd.axis.events import CommandOver
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import MotionPlan, both_s
from ldcnd.axis.procedure import Procedure
from ldcnd.axis.status import Completion
from ldcnd.contract.commands import CommandReply, MoveAbsolute, MoveRelative
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import AxisReading


class ApproachMove(Procedure):
    """Two motions under one command: to the point where the approach begins, and from there to the goal."""

    def __init__(
        self,
        motion: AxisMotion,
        permit: Permit,
        request: MoveAbsolute | MoveRelative,
        first: MotionPlan,
        goal: MotionPlan,
    ) -> None:
        self.permit = permit
        self._motion = motion
        self._request = request
        self._first = first
        self._goal = goal

    async def begin(self) -> CommandReply:
        """See `Procedure`; the command is of the goal from the beginning."""
        motion, goal = self._motion, self._goal
        whole = replace(goal, duration_s=both_s(self._first, goal))
        await self.permit.load(self._first.motion)
        await motion.start(self.permit, AxisState.DISCRETE_MOTION, Completion.PROCEDURE, plan=whole)
        return motion.reply(self.permit, whole)

    @override
    def calls_for_step(self, reading: AxisReading) -> bool:
        return reading.profile_done and self._motion.tracker.status.at_rest

    async def step(self) -> bool:
        """See `Procedure`: go to the goal, if nothing has cut the first motion short; it ends like any move."""
        motion, reading = self._motion, self._motion.latest()
        # a switch may have stopped it just before its end
        if why := motion.ended_beside(self._first.motion.target_counts or 0, reading) or reading.cut_short:
            motion.tracker.take(CommandOver(self.permit.command_id, why))
            return False
        # planned anew: limits and the speed override may be others by now
        goal = motion.plans.to(self._goal.position or 0.0, self._request.velocity, self._request.acceleration)
        await self.permit.load(goal.motion)
        await motion.start(self.permit, AxisState.DISCRETE_MOTION, Completion.PROFILE, plan=goal)
        return False
