"""The commands of one axis: check, plan, send to the drive, update the tracker."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

from ldcnd.axis import guards
from ldcnd.axis.course import pace_of
from ldcnd.axis.events import (
    CommandOver,
    LoopSwitched,
    PlaceKnown,
    PowerSwitched,
    ResetDone,
    SpeedChanged,
)
from ldcnd.axis.gains import AxisGains
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import LATENCY_S, MotionPlan
from ldcnd.axis.procedure import Procedure
from ldcnd.axis.procedures.analog import AnalogMove
from ldcnd.axis.procedures.approach import ApproachMove
from ldcnd.axis.procedures.group import GroupMember, GroupMoveRequest
from ldcnd.axis.procedures.home import HomeSequence
from ldcnd.axis.procedures.jog import HeldJog, Holds, no_such_jog
from ldcnd.axis.procedures.path import PathMember, PathShareRequest
from ldcnd.axis.procedures.probe import ProbeMove
from ldcnd.axis.procedures.pwm import PwmRun
from ldcnd.axis.procedures.track import SetPoint
from ldcnd.axis.procedures.velocity import VelocityChange
from ldcnd.axis.status import ActiveCommand, Completion
from ldcnd.axis.trapezoid import braking_way, duration_from_s, way_within
from ldcnd.contract.commands import (
    AxisCommand,
    BufferMode,
    CommandReply,
    Effect,
    Home,
    Jog,
    MotionKind,
    Move,
    MoveAbsolute,
    MoveAnalog,
    MoveRelative,
    MoveVelocity,
    Power,
    Probe,
    Reset,
    SetGains,
    SetOutputs,
    SetPosition,
    SetPwm,
    Track,
    Verb,
    kind_of,
)
from ldcnd.contract.errors import (
    BusError,
    CommandAborted,
    DriveFault,
    NotSupported,
    OutcomeUnknown,
    RequestRefused,
    StopLatched,
)
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.drives.driver import AxisReading, CountsMotion, StopMode
from ldcnd.line.exchange import NEVER_S, Timing

STEP_RETRY_S = 0.2
"""Delay before a step whose packets were lost is taken again, seconds."""
BLIND_RETRY_S = 1.0
"""The same while the drive does not reply at all."""
BRAKING_ROOM = 1.1
"""Least way to a new end in mid-motion, as a multiple of what it needs to brake."""
MOST_LATE = 3
"""Attempts to send a change of speed within `LATENCY_S` of its reading."""
CANCELLED = "its packets were cut short"
NOT_SLOWED = "sent because its drive could not be told in time to be slower"
GOALS = frozenset({Verb.MOVE_ABSOLUTE, Verb.MOVE_RELATIVE})
"""Motions that were sent to a place."""
MOVES = GOALS | {Verb.MOVE_VELOCITY}
"""Trapezoids in the drive."""


@dataclass(frozen=True, slots=True)
class _Moved:
    """The trapezoid that was started last, as the speed override may change it on its way.

    Attributes:
        permit: of its command.
        plan: as it was sent.
        shares: of its velocity, 0 to 1, by one of which it goes: the one that the drive has acknowledged, and those
            behind it, the latest last, that it was told since and may not have heard.
        farthest_counts: where it was to end as it began; None without an end.
        ends_at_s: when, in loop time; infinite without one.
    """

    permit: Permit
    plan: MotionPlan
    shares: tuple[float, ...]
    farthest_counts: int | None
    ends_at_s: float

    def is_slowed_by(self, share: float) -> bool:
        """Tell whether a share is a slowing: no faster than what it was told last, and than what it may go by."""
        return share <= self.shares[-1] and share < max(self.shares)

    def perhaps_told(self, share: float) -> "_Moved":
        """Return it behind packets of which it is not known whether the drive has heard them."""
        return replace(self, shares=(*(each for each in self.shares if each != share), share))


class _TooLate(Exception):
    """A motion that follows from a reading was refused because it would have come too late for that."""

    def __init__(self, refusal: RequestRefused) -> None:
        self.refusal = refusal


Carry = Callable[[Any, Permit, Any], Awaitable[CommandReply]]
"""Carries out one kind of command; takes the `AxisCommands`, the permit and the request."""


def _procedure(kind: Callable[[AxisMotion, Permit, Any], Procedure]) -> Carry:
    """Return what carries out a command that goes on after it was accepted."""

    async def begin(commands: "AxisCommands", permit: Permit, request: AxisCommand[CommandReply]) -> CommandReply:
        return await commands.undertake(kind, permit, request)

    return begin


class AxisCommands:
    """The verbs of one axis, and the procedure that the last one may have begun.

    Attributes:
        procedure: what is under way and takes more than one step; None otherwise.
        step_due: its next step is due.
        holds: the jogs that are held.
        gains: the gains of the axis, and those that a client has lent it.
    """

    def __init__(self, motion: AxisMotion) -> None:
        self.step_due = False
        self._motion = motion
        self._config = motion.config
        self._driver = motion.driver
        self._tracker = motion.tracker
        self.procedure: Procedure | None = None
        self.holds = Holds(motion.config.name)
        self.gains = AxisGains(motion)
        self._moved: _Moved | None = None  # the last trapezoid, and the speed share of its plan
        self._retry_s: float | None = None  # when the step that was not taken is taken again
        self._blind = False  # that step was tried while the drive did not answer
        self._cut_short = ""  # id of a command that goes on behind its limit switch

    async def carry_out(self, permit: Permit, request: AxisCommand[CommandReply]) -> CommandReply:
        """Do what the request says; returns once the drive has acknowledged it.

        Raises:
            RequestRefused: it cannot be done; nothing was sent.
            DriveFault: the drive's condition forbids it.
            BusError: the line failed; `OutcomeUnknown` when the drive may have started.
        """
        kinds = (each for each in type(request).__mro__ if each in self._CARRIED_OUT)
        carry_out = self._CARRIED_OUT.get(next(kinds, type(request)))
        if carry_out is None:
            raise self._cannot(permit)
        if request.effect is not Effect.MOTION:
            return await carry_out(self, permit, request)
        with self.gains.of(kind_of(request.verb)):
            return await carry_out(self, permit, request)

    def _cannot(self, permit: Permit) -> NotSupported:
        return NotSupported(f"axis {self._config.name} cannot {permit.verb}", axis=self._config.name)

    def renew_jog(self, request: Jog, command_id: str) -> CommandReply:
        """Take note that a jog is held; what it is to do from now on is its next step.

        Raises:
            LeaseExpired: the jog is over.
            VelocityLimit, AccelerationLimit, ValueOutOfRange: the jog goes on as it was, and is not renewed.
        """
        hold, procedure = self.holds.get(command_id), self.procedure
        if hold is None:
            raise no_such_jog(self._config.name, command_id)
        # a halt, a limit or a fault has ended it meanwhile
        if hold.begun and not (isinstance(procedure, HeldJog) and procedure.is_of(hold)):
            hold.over = True
        now_s = self._motion.clock.now_s()
        hold.check(now_s)
        # before the hold is renewed: with a velocity that is refused it must run out
        plan = self._motion.plans.at(request.velocity, request.acceleration)
        hold.renew(request, now_s)
        if isinstance(procedure, HeldJog) and procedure.wants_step:
            self.step_due = True
        return CommandReply(
            command_id=command_id,
            axis=self._config.name,
            verb=request.verb,
            velocity=plan.velocity,
            acceleration=plan.acceleration,
        )

    def brought_to_rest(self, command_id: str, verb: Verb) -> None:
        """The drive acknowledged a stop: watch the axis come to rest."""
        self._drop_procedure()
        self._motion.stopping(command_id, verb)

    def switched_off(self) -> None:
        """The drive acknowledged that its motor is off: nothing that was under way goes on."""
        self._drop_procedure()

    # -- procedures --------------------------------------------------------------------------------------------------

    @property
    def step_is_due(self) -> bool:
        """Whether the procedure under way has a step to take now."""
        return self.step_due or self._motion.clock.now_s() >= self.deadline_s

    @property
    def deadline_s(self) -> float:
        """When the procedure takes its next step at the latest, in loop time; infinite without one."""
        if self.procedure is None:
            return NEVER_S
        return self.procedure.deadline_s if self._retry_s is None else self._retry_s

    @property
    def watch_s(self) -> float:
        """Longest time between two readings that the procedure allows, in seconds; infinite without one."""
        return self.procedure.watch_s if self.procedure else NEVER_S

    @property
    def needs_daemon(self) -> bool:
        """Whether what is under way has no end in the drive: the daemon watches it, and ends it."""
        procedure = self.procedure
        return procedure is not None and procedure.watch_s < NEVER_S and not procedure.outlived(self._tracker)

    def observed(self, reading: AxisReading, timing: Timing) -> None:
        """Give the procedure a reading that the tracker has taken; have a motion stopped that met its limit switch."""
        procedure, status = self.procedure, self._tracker.status
        command = status.command if status.concerns(timing) else None
        # told another speed or target behind the switch, a drive goes on: it is stopped by a command of ours
        if reading.cut_short and not reading.profile_done and command and command.completion is Completion.PROFILE:
            self._cut_short, self.step_due = command.command_id, True
        if procedure is None:
            return
        if procedure.outlived(self._tracker):
            self._drop_procedure()
        elif self._tracker.status.concerns(timing) and (
            # the drive answers again: a step that ends a motion does not wait for its next try
            (self._retry_s is not None and self._blind) or procedure.calls_for_step(reading)
        ):
            self.step_due = True

    async def step(self) -> None:
        """Let the procedure take the step that is due.

        Raises:
            StopLatched: a stop has overtaken it.
            BusError: the line failed; the step is taken again.
        """
        procedure, self.step_due = self.procedure, False
        cut_short, self._cut_short = self._cut_short, ""
        command = self._tracker.status.command
        if command is not None and command.command_id == cut_short:
            await self._motion.end(command, self._tracker.status.progress.failure or "")
            self._drop_procedure()
            self._motion.publish_state()
            return
        if procedure is None:
            return
        if procedure.outlived(self._tracker):
            self._drop_procedure()
            return
        self._blind = self._tracker.status.link is not LinkState.UP
        # before it is tried: if its packets are lost, that is when it is tried again
        self._retry_s = self._motion.clock.now_s() + (BLIND_RETRY_S if self._blind else STEP_RETRY_S)
        try:
            goes_on = await self._take_step(procedure)
        finally:
            self.step_due = False  # what was read during the step called for the one that is over
        self._retry_s = None
        if procedure is self.procedure and not goes_on:
            self._drop_procedure()
        self._motion.publish_state()

    async def _take_step(self, procedure: Procedure) -> bool:
        try:
            return await procedure.step()
        except OutcomeUnknown:
            # what was started must not be started again: the readings tell how it goes
            return (
                self._tracker.status.command is not None
                and self._tracker.status.command.completion is Completion.PROCEDURE
            )
        # before `RequestRefused`, which they are, too: the command that has overtaken the step sees to the drive
        except (StopLatched, CommandAborted):
            raise
        except (RequestRefused, DriveFault) as error:
            if self._tracker.status.energised and not procedure.outlived(self._tracker):
                mode = await self._driver.stop(StopMode.SMOOTH)  # of the step before something may still run
                self._motion.comes_to_rest(procedure.permit, error.message, mode=mode)
            elif not procedure.outlived(self._tracker):
                self._tracker.take(CommandOver(procedure.permit.command_id, error.message))
            return False

    def _drop_procedure(self) -> None:
        self._take_up(None)

    def _take_up(self, procedure: Procedure | None) -> None:
        self.procedure, self._retry_s, self.step_due = procedure, None, False

    async def undertake(
        self, kind: Callable[[AxisMotion, Permit, Any], Procedure], permit: Permit, request: AxisCommand[CommandReply]
    ) -> CommandReply:
        """Begin a procedure of a kind; see `carry_out`."""
        return await self._undertake(kind(self._motion, permit, request))

    async def _undertake(self, procedure: Procedure) -> CommandReply:
        """Begin a procedure; it takes steps only from then on, also when it is unknown whether the drive has begun."""
        try:
            reply = await procedure.begin()
        except OutcomeUnknown:
            # what has only been prepared has nothing that runs, and that a step would have to end
            if procedure.permit.has_begun:
                self._take_up(procedure)
            else:
                self._take_up_begun(procedure)
            raise
        except asyncio.CancelledError:  # it may have begun all the same
            self._take_up_begun(procedure)
            raise
        self._take_up_begun(procedure)
        return reply

    def _take_up_begun(self, procedure: Procedure) -> None:
        command = self._tracker.status.command
        if command and command.command_id == procedure.permit.command_id:  # else a stop has ended it meanwhile
            self._take_up(procedure)

    # -- power -------------------------------------------------------------------------------------------------------

    async def _power_on(self, permit: Permit, request: Power) -> CommandReply:
        if not request.on:
            raise self._cannot(permit)  # a drive that can be switched off takes that as a stop
        permit.check_state()
        await self._motion.check_does_not_coast()
        guards.check_has_gains(self._driver)
        # a loop that is closed keeps its gains
        with nullcontext() if self._tracker.status.enabled else self.gains.of(MotionKind.POSITION):
            await permit.power_on()
        self._drop_procedure()
        self._tracker.take(PowerSwitched(on=True, now_s=self._motion.clock.now_s()))
        self._motion.publish_state()
        return self._motion.reply(permit)

    async def _reset(self, permit: Permit, request: Reset) -> CommandReply:
        """Recover from what has stopped the motor; mere warnings are cleared with a closed loop as it is.

        A drive whose loop is open may hold a cause that it does not show: a Logosol drive hides a position error while
        its power driver is off, and a host that took it over has not seen what came before.
        """
        tracker = self._tracker
        if request.faults_only:
            guards.check_reachable(tracker)
            guards.check_not_latched(tracker)
        permit.check_state()  # a stop that is under way keeps its latch
        stopped = tracker.status.state is AxisState.ERROR_STOP or any(
            fault.stops for fault in tracker.status.active_faults
        )
        if stopped or not tracker.status.energised:
            permit.ask_to_open_loop()
            await self._driver.reset()
            self._drop_procedure()
            tracker.take(LoopSwitched(on=False, now_s=self._motion.clock.now_s()))
        elif tracker.status.active_faults:
            await self._driver.clear_warnings()
        permit.still_wanted()  # a stop that came meanwhile keeps its latch
        tracker.take(ResetDone(self._motion.clock.now_s()))
        self._motion.publish_state()
        return self._motion.reply(permit)

    # -- motion ------------------------------------------------------------------------------------------------------

    def retargets(self, request: Move) -> bool:
        """Tell whether the drive takes this motion in mid-move of the one under way; see `supersedes` for the sender.

        PIC-SERVO SC takes goal, velocity and acceleration of a trapezoid at any time and keeps both limits (later
        vendor data sheets); on other drives a trapezoid loaded in mid-move is erratic (PIC-SERVO manual, 4.4). From
        the points of a path it would begin at standstill, wherever the drive is by then.
        """
        tracker = self._tracker
        return (
            self._driver.retargets
            # a group starts from rest
            and not isinstance(request, Jog | GroupMoveRequest | PathShareRequest)
            and not isinstance(self.procedure, PathMember)
            and not self.gains.switches(kind_of(request.verb))
            and not self.gains.are_due
            and tracker.status.command is not None
            and tracker.status.command.verb in MOVES
            and tracker.status.state in (AxisState.DISCRETE_MOTION, AxisState.CONTINUOUS_MOTION)
            # another program has stopped it: nothing goes on from there
            and not self._motion.ended_elsewhere
        )

    def supersedes(self, request: Move) -> bool:
        """Tell whether what is under way may go on to this motion, or be halted for it.

        That is for its sender to say; a motion that goes on from one of its own, as another velocity does, need not.
        """
        if request.buffer_mode is BufferMode.REFUSE:
            return self._driver.retargets and guards.goes_on(request.verb, self._tracker)
        return request.buffer_mode is BufferMode.ABORTING

    def goes_on(self, request: Move) -> bool:
        """Tell whether the drive goes on to this motion in mid-move; what could not turn in time is halted first."""
        if not self.retargets(request):
            return False
        if isinstance(request, MoveVelocity):
            plan = self._motion.plans.at(request.velocity, request.acceleration)
        else:
            plan = self._PLANNED[type(request)](self, request)
            if isinstance(request, MoveAbsolute | MoveRelative):
                # its first motion may be the one away from the goal
                plan = self._detour(request, plan, in_motion=True) or plan
        return self._motion.plans.follows_on(plan.motion.acceleration_counts_per_s2, plan.motion.target_counts)

    def _check_may_start(self, permit: Permit, request: Move) -> None:
        permit.check_state(follows=self.supersedes(request) and self.retargets(request))

    def check(self, request: Move) -> None:
        """Refuse a move that could not follow what the axis is doing now; nothing is halted for it.

        Raises:
            RequestRefused: as the move itself would be, once the axis stands.
        """
        guards.check(request.verb, self._tracker, follows=True)
        goal = self._PLANNED[type(request)](self, request)
        if isinstance(request, MoveAbsolute | MoveRelative):
            self._detour(request, goal)

    async def _move_absolute(self, permit: Permit, request: MoveAbsolute) -> CommandReply:
        self._check_may_start(permit, request)
        return await self._move_to(permit, request, self._from_now(request, self._plan_absolute(request)))

    async def _move_relative(self, permit: Permit, request: MoveRelative) -> CommandReply:
        self._check_may_start(permit, request)
        if self._tracker.status.target_counts is None:
            here = (await self._motion.read()).position_counts  # one reading alone may be wrong
            permit.still_wanted()
            self._check_may_start(permit, request)
            return await self._move_to(permit, request, self._plan_relative(request, here))
        return await self._move_to(permit, request, self._from_now(request, self._plan_relative(request)))

    def _from_now(self, request: Move, plan: MotionPlan) -> MotionPlan:
        return self._motion.plans.in_mid_move(plan) if self.retargets(request) else plan

    async def _move_to(self, permit: Permit, request: MoveAbsolute | MoveRelative, goal: MotionPlan) -> CommandReply:
        """Go to a goal, from the configured side where there is one."""
        if first := self._detour(request, goal, in_motion=self._tracker.status.command is not None):
            return await self._undertake(ApproachMove(self._motion, permit, request, first, goal))
        return await self._move(permit, goal, AxisState.DISCRETE_MOTION)

    def _detour(
        self, request: MoveAbsolute | MoveRelative, goal: MotionPlan, *, in_motion: bool = False
    ) -> MotionPlan | None:
        plans = self._motion.plans
        return plans.before_approach(goal, request.velocity, request.acceleration, in_motion=in_motion)

    async def _move_velocity(self, permit: Permit, request: MoveVelocity) -> CommandReply:
        if guards.goes_on(request.verb, self._tracker) and not self._driver.retargets:
            return await self._undertake(VelocityChange(self._motion, permit, request))
        self._check_may_start(permit, request)
        in_motion = self.retargets(request)
        velocity, bounded, ends = self._plan_velocity(request, in_motion=in_motion)
        if in_motion:
            bounded = self._motion.plans.in_mid_move(bounded)
        reply = await self._move(permit, bounded, AxisState.CONTINUOUS_MOTION)
        return reply.model_copy(update={"velocity": velocity, "ends": ends})

    async def _jog(self, permit: Permit, request: Jog) -> CommandReply:
        now_s = self._motion.clock.now_s()
        # `begin_hold` has made one on arrival, unless the jog comes from inside the daemon
        hold = self.holds.get(permit.command_id) or self.holds.begin(permit.command_id, request, now_s)
        return await self._undertake(HeldJog(self._motion, permit, hold))

    async def _track(self, permit: Permit, request: Track) -> CommandReply:
        return await self._undertake(SetPoint(self._motion, permit, request, self.procedure))

    def _plan_absolute(self, request: MoveAbsolute) -> MotionPlan:
        plans, from_counts, command = self._motion.plans, None, self._tracker.status.command
        if self.retargets(request):
            # a goal sent again in mid-move stays: from where it can stand it might be a turn away by then
            on_its_way = command is not None and command.verb in GOALS
            if not (on_its_way and plans.is_sent_to(request.position, request.direction)):
                from_counts = plans.stands_at(request.acceleration)
        position = plans.unwrapped(request.position, request.direction, from_counts=from_counts)
        return plans.to(position, request.velocity, request.acceleration)

    def _plan_relative(self, request: MoveRelative, here_counts: int | None = None) -> MotionPlan:
        plans = self._motion.plans
        return plans.by(request.distance, request.velocity, request.acceleration, from_counts=here_counts)

    def _plan_velocity(self, request: MoveVelocity, *, in_motion: bool) -> tuple[float, MotionPlan, str]:
        """Return the velocity as the drive will have it, a trapezoid that ends even if this host dies, and how."""
        motion = self._motion
        plan = motion.plans.at(request.velocity, request.acceleration)
        end, ends = motion.plans.run(request.duration_s, plan, in_motion=in_motion)
        return plan.velocity, motion.plans.to(end, abs(request.velocity), request.acceleration), ends

    async def _move(
        self,
        permit: Permit,
        plan: MotionPlan,
        state: AxisState,
        completion: Completion = Completion.PROFILE,
    ) -> CommandReply:
        share = self._tracker.status.speed_share
        await permit.load(plan.motion)
        try:
            await self._motion.start(permit, state, completion, plan=plan)
        finally:
            status = self._tracker.status
            if status.is_at(permit.command_id):  # a motion that it has not come to replace keeps its own
                ends_at_s = status.ends_at_s or math.inf
                self._moved = _Moved(permit, plan, (share,), plan.motion.target_counts, ends_at_s)
        return self._motion.reply(permit, plan)

    @property
    def has_speed_to_tell(self) -> bool:
        """Whether the drive has a motion under way that can be told another velocity, and not this one already."""
        share, moved, command = self._tracker.status.speed_share, self._moved, self._tracker.status.command
        if moved is None or command is None or not self._driver.retargets or share <= 0:
            return False
        own = command.command_id == moved.permit.command_id and command.completion is Completion.PROFILE
        return own and not isinstance(self.procedure, HeldJog) and moved.shares != (share,)

    def step_to_speed(self) -> Literal["changed"] | None:
        """Have a held jog take the speed override in its next step; tell whether it does."""
        if not isinstance(self.procedure, HeldJog):
            return None
        self.step_due = self.step_due or self.procedure.wants_step
        return "changed" if self.step_due else None

    async def change_speed(self) -> Literal["changed", "halted", "unconfirmed"] | None:
        """Have a motion under way go on at the velocity that the speed override leaves; tell whether it does.

        Only where a drive takes another velocity for a trapezoid under way: its goal stays, so nothing moves twice.
        A change that is too late is planned again from a new reading, `MOST_LATE` times in all; a slower motion is then
        halted.

        Raises:
            RequestRefused: it may not be moved any more, or its drive could not be told in time to be faster.
            BusError: the line failed; it goes on at the one velocity or the other.
        """
        share, moved, command = self._tracker.status.speed_share, self._moved, self._tracker.status.command
        if moved is None or command is None or not self.has_speed_to_tell:
            return None
        for _ in range(MOST_LATE):
            try:
                return "changed" if await self._tell_speed(command, moved, share) else None
            except _TooLate as late:
                error = late.refusal
        if not moved.is_slowed_by(share):
            raise error
        try:
            await self._motion.must_end(moved.permit, error.message, NOT_SLOWED)
        except BusError:  # then its line sends the stop until it is confirmed
            return "unconfirmed"
        return "halted"

    async def _tell_speed(self, command: ActiveCommand, moved: _Moved, share: float) -> bool:
        """Tell the drive, by a reading of now, to go on at a share of its velocity; see `change_speed`.

        Raises:
            _TooLate: what follows from the reading was not sent in time.
        """
        tracker, permit = self._tracker, moved.permit
        asked_at_s = self._motion.clock.now_s()
        # the latest poll may be older than what has ended it, and its goal would be sent again
        if (await self._motion.read()).profile_done or tracker.status.command is not command:
            return False
        # of what was asked for: what registers have rounded once would be rounded again
        asked = replace(moved.plan.motion, velocity_counts_per_s=moved.plan.full_counts_per_s * share)
        changed = self._motion.plans.quantise(asked, keeps_acceleration=True)
        if command.state is AxisState.CONTINUOUS_MOTION and moved.farthest_counts is not None:
            changed = self._that_ends_in_time(changed, moved.farthest_counts, moved.ends_at_s, asked_at_s)
        slower = moved.is_slowed_by(share)
        # what was allowed as the motion began, and is no more since a reload, is not done any faster
        if not slower and not self._motion.plans.allows(changed):
            return False
        # the goal of a move stays; a motion at a velocity gets a nearer one, never one behind the axis
        # nobody sends a slowing again: readings are to show whether the drive has heard it, from its load on
        may_have_heard = slower
        try:
            await permit.load(changed, slower=slower)
            if tracker.status.command is not command:
                return False  # it has ended meanwhile: what was loaded is not started
            may_have_heard = True
            await permit.start()
        except (BusError, asyncio.CancelledError) as error:
            if may_have_heard:
                self._moved = moved.perhaps_told(share)
                self._expect(permit, changed, error.message if isinstance(error, BusError) else CANCELLED)
            raise
        except RequestRefused as error:
            if self._motion.clock.now_s() > changed.by_s:
                raise _TooLate(error) from error
            raise
        self._moved = replace(moved, shares=(share,))
        self._expect(permit, changed)
        return True

    def _expect(self, permit: Permit, changed: CountsMotion, doubt: str = "") -> None:
        """Have the motion under way seen to go on as its drive was told, or may have been; see `SpeedChanged`."""
        if not self._tracker.status.is_at(permit.command_id):
            return
        reading = self._motion.latest()
        way = abs((changed.target_counts or 0) - reading.position_counts)
        rest_s = duration_from_s(
            way,
            abs(reading.velocity_counts_per_s),
            changed.velocity_counts_per_s,
            changed.acceleration_counts_per_s2,
        )
        now_s, now_ns = self._motion.clock.now_s(), self._motion.clock.now_ns()
        profile = changed.velocity_counts_per_s, changed.acceleration_counts_per_s2
        # by what it was told: with the reply to a load it is lost what its registers hold
        pace = pace_of(*profile, reading, now_s)
        self._tracker.take(SpeedChanged(rest_s, now_s, now_ns, pace, changed.target_counts, profile, doubt))

    def _that_ends_in_time(
        self, motion: CountsMotion, farthest: int, ends_at_s: float, asked_at_s: float
    ) -> CountsMotion:
        """Return a motion at a velocity with an end for its new speed: it was given a time, and not a way.

        Args:
            motion: with its new speed.
            farthest: where it was to end at the speed that it was asked for, counts.
            ends_at_s: when it was to, in loop time.
            asked_at_s: when the latest reading was asked for, in loop time.
        """
        reading, rest_s = self._motion.latest(), ends_at_s - self._motion.clock.now_s()
        speed = abs(reading.velocity_counts_per_s)
        way = way_within(rest_s, speed, motion.velocity_counts_per_s, motion.acceleration_counts_per_s2)
        # by the time at which the drive has it, it is a little farther, and no later; it may be faster than it shows
        fastest = speed + reading.velocity_resolution_counts_per_s
        least = BRAKING_ROOM * braking_way(fastest, motion.acceleration_counts_per_s2) + fastest * LATENCY_S
        left = farthest - reading.position_counts
        end = reading.position_counts + math.copysign(min(max(way, least), abs(left)), left)
        return replace(motion, target_counts=round(end), by_s=asked_at_s + LATENCY_S)

    # -- registers ---------------------------------------------------------------------------------------------------

    async def _set_position(self, permit: Permit, request: SetPosition) -> CommandReply:
        motion = self._motion
        permit.check_state()
        guards.check_origin(self._tracker, motion.config.farthest, request.position)
        here = await motion.read()  # one reading alone may be wrong
        # before the axis gets another origin: a crash between the two must not leave the old one
        await motion.reference.forget()
        await motion.reference.void_elsewhere()
        permit.still_wanted()
        guards.check_position_kept(self._tracker)
        self._tracker.take(PlaceKnown(motion.scale.with_position(here.position_counts, request.position), resting=True))
        motion.publish_state()
        return motion.reply(permit, position=request.position)

    async def _set_outputs(self, permit: Permit, request: SetOutputs) -> CommandReply:
        permit.check_state()
        await permit.set_outputs(request.limit1, request.limit2)
        return self._motion.reply(permit)

    _CARRIED_OUT: ClassVar[Mapping[type, Carry]] = {
        Power: _power_on,
        Reset: _reset,
        MoveAbsolute: _move_absolute,
        MoveRelative: _move_relative,
        MoveVelocity: _move_velocity,
        Jog: _jog,
        Track: _track,
        Home: _procedure(HomeSequence),
        Probe: _procedure(ProbeMove),
        MoveAnalog: _procedure(AnalogMove),
        SetPwm: _procedure(PwmRun),
        GroupMoveRequest: _procedure(GroupMember),
        PathShareRequest: _procedure(PathMember),
        SetPosition: _set_position,
        SetGains: lambda self, permit, request: self.gains.set(permit, request),
        SetOutputs: _set_outputs,
    }
    """What carries out each command in its turn; what brings the axis to rest has none, see stopping.py."""

    _PLANNED: ClassVar[Mapping[type, Callable[[Any, Any], MotionPlan]]] = {
        MoveAbsolute: _plan_absolute,
        GroupMoveRequest: _plan_absolute,
        PathShareRequest: _plan_absolute,
        MoveRelative: _plan_relative,
        MoveVelocity: lambda self, request: self._plan_velocity(request, in_motion=self.goes_on(request))[1],
        Jog: lambda self, request: self._motion.plans.at(request.velocity, request.acceleration),
    }
    """How each move is planned that may wait for another one, or take it over."""
