"""A jog: it runs for as long as its client renews the hold, and in the drive never much farther than that.

The client renews the hold periodically; this daemon ends the jog as soon as no renewal has come for `Jog.hold_s`. If
the daemon dies, the drive ends it: every packet that runs the axis names a goal. PIC-SERVO SC takes a new goal in
mid-move, so its goal is only ever twice `hold_s` ahead. Other drives must not get another trapezoid before they stand
(PIC-SERVO manual, 4.4): their goal is `jog_reach_s` ahead, and a jog that is held for longer, or gets another velocity,
comes to rest and goes on from there.
"""

import math
from dataclasses import dataclass
from enum import Enum

from typing_extensions import override

from ldcnd.axis.events import CommandOver, MotionStarted
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import COUNTER_SHARE, LATENCY_S, MotionPlan
from ldcnd.axis.procedure import Procedure
from ldcnd.axis.status import Completion
from ldcnd.contract.commands import CommandReply, Jog
from ldcnd.contract.errors import LeaseExpired, Remedy, step
from ldcnd.contract.meta import AxisLimits
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import LARGEST_COUNT, AxisReading, StopMode

REACH_HOLDS = 2.0
"""Distance of the goal of a drive that accepts a new one in mid-move, in units of `hold_s`,"""
EXTEND_HOLDS = 0.75
"""and time between two goals, in the same unit."""


class Hold:
    """State of the hold of one jog.

    Attributes:
        axis: that it jogs.
        command_id: names the jog.
        velocity: requested now, in units a second.
        acceleration: likewise, in units a second squared; None for the default of the axis.
        hold_s: time from the last renewal to the end of the jog, in seconds.
        until_s: when it ends unless it is renewed, in loop time.
        begun: its procedure has taken it over.
        over: it has ended, and is not begun again.
    """

    def __init__(self, axis: str, command_id: str, request: Jog, now_s: float) -> None:
        self.axis = axis
        self.command_id = command_id
        self.begun = self.over = False
        self._take(request, now_s)

    def renew(self, request: Jog, now_s: float) -> None:
        """Renew the hold, with the velocity requested now.

        Raises:
            LeaseExpired: it is over.
        """
        self.check(now_s)
        self._take(request, now_s)

    def check(self, now_s: float) -> None:
        """Refuse to move on when no renewal has come in time; from then on the jog is over.

        Raises:
            LeaseExpired: the jog is over.
        """
        self.over = self.over or now_s >= self.until_s
        if self.over:
            raise no_such_jog(self.axis, self.command_id)

    def _take(self, request: Jog, now_s: float) -> None:
        self.velocity, self.acceleration, self.hold_s = request.velocity, request.acceleration, request.hold_s
        self.until_s = now_s + request.hold_s


def no_such_jog(axis: str, command_id: str) -> LeaseExpired:
    """Return the refusal of a renewal of a jog that is over, or never was."""
    return LeaseExpired(
        f"axis {axis}: the jog {command_id} is over",
        axis=axis,
        value=command_id,
        remedy=Remedy("let go, then {} again", step("jog")),
    )


class Holds:
    """The jogs of one axis that are held, or wait for their turn."""

    def __init__(self, axis: str) -> None:
        self._axis = axis
        self._holds: dict[str, Hold] = {}

    def begin(self, command_id: str, request: Jog, now_s: float) -> Hold:
        """Remember a jog from its command on, also while that waits."""
        # a holder that ended without being told is cleared away here
        self._holds = {name: hold for name, hold in self._holds.items() if not hold.over and hold.until_s > now_s}
        hold = self._holds[command_id] = Hold(self._axis, command_id, request, now_s)
        return hold

    def get(self, command_id: str) -> Hold | None:
        """Return a jog; None when it was removed."""
        return self._holds.get(command_id)


class _Phase(Enum):
    """Phase of the drive in a jog."""

    RUNS = "runs"
    """It runs to a goal that is there to end it if this host dies."""
    ENDS = "ends"
    """It runs to the software limit."""
    SLOWS = "slows"
    """It comes to rest, to go on at another velocity."""
    RESTS = "rests"
    """Its motion is over."""


@dataclass(frozen=True, slots=True)
class _Course:
    """What a jog is to keep to now.

    Attributes:
        velocity: in axis units a second.
        acceleration: in axis units a second squared; None for the default.
        share: of the velocity that the speed override leaves.
        limits: of the axis, which a reload may narrow.
    """

    velocity: float
    acceleration: float | None
    share: float
    limits: AxisLimits


class HeldJog(Procedure):
    """A jog, from its first packet to the stop that ends it."""

    def __init__(self, motion: AxisMotion, permit: Permit, hold: Hold) -> None:
        self.permit = permit
        self._motion = motion
        self._hold = hold
        self._wanted: _Course | None = None  # at what it runs
        self._phase = _Phase.RESTS
        self._goal: int | None = None  # that the drive has, in counts; None before it has one, and while it slows down
        self._extend_at_s = math.inf

    @property
    @override
    def deadline_s(self) -> float:  # type: ignore[override]
        """See `Procedure`: when the hold expires, or when the drive gets its next goal."""
        return min(self._hold.until_s, self._extend_at_s)

    async def begin(self) -> CommandReply:
        """See `Procedure`.

        Raises:
            PositionLimit: the axis stands at the software limit ahead.
            LeaseExpired: no renewal came while the command waited.
        """
        self.permit.check_state()
        try:
            await self._motion.read()
            return await self._run()
        finally:
            command = self._motion.tracker.status.command
            # also when its start was not confirmed: it may run, and a renewal must reach it
            self._hold.begun = command is not None and command.command_id == self.permit.command_id

    def is_of(self, hold: Hold) -> bool:
        """Tell whether this is the jog of a hold, and goes on."""
        return self._hold is hold and not hold.over and not self.outlived(self._motion.tracker)

    @property
    def wants_step(self) -> bool:
        """Whether the drive runs at another velocity, or under other limits, than it is to."""
        return self._phase in (_Phase.RUNS, _Phase.ENDS) and self._wanted != self._asked

    def calls_for_step(self, reading: AxisReading) -> bool:
        """See `Procedure`: the drive has reached its goal, or was stopped by a limit switch."""
        if reading.profile_done and (self._phase is not _Phase.SLOWS or self._motion.tracker.status.at_rest):
            self._extend_at_s = math.inf
            if self._phase is not _Phase.ENDS:
                self._phase = _Phase.RESTS
            return True
        return bool(reading.cut_short) or self.wants_step

    async def step(self) -> bool:
        """See `Procedure`: end, or go on as long as it is held."""
        hold, motion = self._hold, self._motion
        reading = motion.latest()
        if hold.over or motion.clock.now_s() >= hold.until_s:
            return await self._stop(f"its hold was not renewed for {hold.hold_s:g} s")
        if reading.cut_short:
            return await self._stop(reading.cut_short)
        if self._phase is _Phase.ENDS and reading.profile_done and not self.wants_step:
            motion.tracker.take(CommandOver(self.permit.command_id, self._ended_beside(reading)))
            return False
        if self._phase is not _Phase.RESTS:
            if self.wants_step and not await self._turns_in_time():
                await self._slow_down()
                return True
            # its goal stays until it stands; from there it goes on
            if not motion.driver.retargets:
                return True
        if self._phase is _Phase.RESTS or self.wants_step or motion.clock.now_s() >= self._extend_at_s:
            reading = await motion.read()  # the latest reading may be as old as the rates let it be
            self.permit.still_wanted()
            if why := self._ended_beside(reading):
                hold.over = True
                motion.tracker.take(CommandOver(self.permit.command_id, why))
                return False
            await self._run()
        return True

    def _ended_beside(self, reading: AxisReading) -> str | None:
        """Return why the drive has ended its motion beside the goal that it has; None where it has not."""
        return None if self._goal is None else self._motion.ended_beside(self._goal, reading)

    async def _turns_in_time(self) -> bool:
        """Tell whether the drive takes the requested velocity in mid-move without leaving the software limits."""
        motion, asked = self._motion, self._asked
        if not motion.driver.retargets:
            return False
        by_s = motion.clock.now_s() + LATENCY_S
        await motion.read()  # the latest reading may be as old as the rates let it be
        rate = motion.plans.at(asked.velocity, asked.acceleration).motion.acceleration_counts_per_s2
        if not motion.plans.follows_on(rate, None) or motion.clock.now_s() >= by_s:
            return False
        self.permit.by_s = by_s
        return True

    @property
    def _asked(self) -> "_Course":
        hold, motion = self._hold, self._motion
        return _Course(hold.velocity, hold.acceleration, motion.tracker.status.speed_share, motion.config.limits)

    async def _run(self) -> CommandReply:
        """Have the drive run to a goal that is as far ahead of where it was read just now as it may be."""
        motion, asked = self._motion, self._asked
        # again, because the reading has taken its time
        self.permit.ask_to_move()
        plan, velocity, reach_s, at_limit = self._plan(asked.velocity, asked.acceleration)
        await self.permit.load(plan.motion)
        self._goal = plan.motion.target_counts
        # as planned: by now something else may be asked for, which is the next step
        self._wanted = asked
        self._phase = _Phase.ENDS if at_limit else _Phase.RUNS  # also if it is unknown whether the drive has started
        extends = motion.driver.retargets and not at_limit
        self._extend_at_s = motion.clock.now_s() + EXTEND_HOLDS * self._hold.hold_s if extends else math.inf
        await motion.start(self.permit, AxisState.CONTINUOUS_MOTION, Completion.PROCEDURE)
        return motion.reply(self.permit, velocity=velocity, acceleration=plan.acceleration, duration_s=reach_s)

    def _plan(self, velocity: float, acceleration: float | None) -> tuple[MotionPlan, float, float, bool]:
        """Return the motion, its velocity, for how long it runs, and whether it ends at the software limit."""
        motion = self._motion
        steady = motion.plans.at(velocity, acceleration)
        longest_s = COUNTER_SHARE * LARGEST_COUNT / abs(steady.motion.velocity_counts_per_s)
        reach_s = min(self._reach_s, longest_s)
        # with the ramp at its end behind it, so that it has its velocity for `reach_s`: in mid-move from when it has it
        in_motion, ramp_s = self._phase is not _Phase.RESTS, abs(steady.velocity) / steady.acceleration
        way = steady.velocity * (reach_s + (ramp_s if in_motion else ramp_s / 2))
        end, at_limit = motion.plans.runs_to(steady, way, in_motion=in_motion, delay_s=LATENCY_S)
        return motion.plans.to(end, abs(velocity), acceleration), steady.velocity, reach_s, at_limit

    @property
    def _reach_s(self) -> float:
        motion = self._motion
        return REACH_HOLDS * self._hold.hold_s if motion.driver.retargets else motion.config.jog_reach_s

    async def _slow_down(self) -> None:
        """Bring the axis to rest; the jog goes on from there."""
        motion, own = self._motion, self.permit.command_id
        await motion.driver.stop(StopMode.SMOOTH)
        motion.begin(own, self.permit.verb, AxisState.CONTINUOUS_MOTION, Completion.PROCEDURE, goes_on=True)
        motion.tracker.take(MotionStarted(own, motion.clock.now_s(), endless=False))
        # no next goal before it stands: at another acceleration the limit ahead may be too near
        self._phase, self._goal, self._extend_at_s = _Phase.SLOWS, None, math.inf

    async def _stop(self, reason: str) -> bool:
        self._hold.over = True  # nobody renews it while the packets of the stop are under way
        await self._motion.end(self.permit, reason)
        return False
