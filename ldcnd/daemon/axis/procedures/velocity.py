"""A motion at constant velocity that gets another velocity on its way.

It begins as a trapezoid, which ends in the drive. A trapezoid must not be changed in mid-move, while velocity mode
may be entered and changed at any time (PIC-SERVO manual, 4.4): from its first change on it runs in velocity mode,
which has no end in the drive. The daemon ends it before the software limit or at the jog horizon; only limit switches
that are armed do so without it. PIC-SERVO SC takes a new trapezoid at any time: there it keeps its end in the drive.
"""

from ldcnd.daemon.axis import guards
from ldcnd.daemon.axis.guards import Permit
from ldcnd.daemon.axis.motion import AxisMotion
from ldcnd.daemon.axis.procedure import Procedure
from ldcnd.daemon.axis.state import AxisTracker, Completion
from ldcnd.drivers.driver import AxisReading
from ldcnd.errors import PositionLimit, Remedy, step
from ldcnd.model.commands import CommandReply, MoveVelocity, Verb
from ldcnd.model.samples import AxisState

COUNTER_SHARE = 0.99
"""Of the way to the end of the drive's position counter, which a motion in velocity mode would run through."""
LATENCY_S = 0.2
"""Longest time from a reading to the stop that follows it; what is gone meanwhile must not reach the software limit."""


def runs(tracker: AxisTracker) -> bool:
    """Tell whether the axis carries out a motion whose velocity may be changed."""
    command = tracker.command
    return command is not None and command.verb is Verb.MOVE_VELOCITY and tracker.state is AxisState.CONTINUOUS_MOTION


class VelocityChange(Procedure):
    """A motion in velocity mode, from the change of its velocity to the stop that ends it."""

    def __init__(self, motion: AxisMotion, permit: Permit, request: MoveVelocity) -> None:
        self.permit = permit
        self._motion = motion
        self._request = request
        self._end: float | None = None
        self._velocity = 0.0
        self._margin = 0.0

    async def begin(self) -> CommandReply:
        """See `Procedure`.

        Raises:
            PositionLimit: the software limit ahead is too near to stop before it.
        """
        motion, request = self._motion, self._request
        tracker = motion.tracker
        guards.check_may_follow(tracker)
        plan = motion.plan_at(request.velocity, request.acceleration)
        before = abs(motion.latest().velocity_counts_per_s / motion.counts_per_unit)
        self._velocity, speed = plan.velocity, max(abs(plan.velocity), before)
        self._margin = speed * speed / (2 * plan.acceleration) + speed * LATENCY_S
        self._end = motion.limit_ahead(plan.velocity) if tracker.referenced else None
        if self._ends_here(motion.latest()):
            raise PositionLimit(
                f"axis {tracker.name}: the limit {self._end:g} {tracker.unit} is too near for"
                f" {plan.velocity:g} {tracker.unit}/s",
                axis=tracker.name,
                value=plan.velocity,
                limit=self._end,
                remedy=Remedy("{}", step("halt")),
            )
        await self.permit.load(plan.motion)
        speed_counts = plan.motion.velocity_counts_per_s
        room_s = motion.driver.room_counts(forward=speed_counts > 0) / abs(speed_counts)
        self.deadline_s = motion.clock.now_s() + min(motion.config.jog_horizon_s, COUNTER_SHARE * room_s)
        await motion.start(self.permit, AxisState.CONTINUOUS_MOTION, Completion.PROCEDURE)
        return motion.reply(self.permit, velocity=plan.velocity, acceleration=plan.acceleration)

    def calls_for_step(self, reading: AxisReading) -> bool:
        """See `Procedure`: the end is near, the drive has stopped, or the command was lost while out of sight."""
        return self._motion.tracker.command is None or bool(reading.cut_short) or self._ends_here(reading)

    async def step(self) -> bool:
        """See `Procedure`: stop. An axis that has lost its loop meanwhile is switched off instead."""
        await self._motion.end(self.permit, self._motion.latest().cut_short)
        return False

    def outlived(self, tracker: AxisTracker) -> bool:
        """See `Procedure`; without a command the drive may still run until it is seen at rest."""
        return tracker.at_rest if tracker.command is None else super().outlived(tracker)

    def _ends_here(self, reading: AxisReading) -> bool:
        if self._end is None:
            return False
        way = self._end - self._motion.telemetry.position(reading.position_counts)
        return (way if self._velocity > 0 else -way) <= self._margin
