"""What changes the state of an axis: one function from a status and an event to the next status.

Pure; time is an input.
The states are those of PLCopen, function blocks for motion control, part 1, state diagram.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from ldcnd.axis.course import Braking, ToldAnew
from ldcnd.axis.events import (
    AxisEvent,
    CommandBegun,
    CommandFailing,
    CommandGoesOn,
    CommandOver,
    ControlChanged,
    DriveLost,
    FaultFound,
    LatchNamed,
    LatchRecalled,
    LimitsSet,
    LookTaken,
    LoopSeen,
    LoopSwitched,
    MotionStarted,
    Overtaken,
    PlaceKnown,
    PlaceUnknown,
    PollMissed,
    PowerSwitched,
    ReadingsContradicted,
    ReadingTaken,
    ReferenceRefused,
    ReplyUnusable,
    ResetDone,
    SpeedChanged,
    SpeedOverridden,
    StopAcknowledged,
    StopConfirmed,
    StopDue,
    StopLatch,
    StopOverdue,
    StopSent,
    StopUnconfirmed,
)
from ldcnd.axis.faults import (
    LINK_BLOCKED,
    LINK_LOST,
    NOT_IDENTIFIED,
    READINGS_CONTRADICT,
    REFERENCE_REFUSED,
    REPLIES_UNUSABLE,
    STOP_UNCONFIRMED,
    entry_again,
    entry_of,
)
from ldcnd.axis.outcome import (
    abort,
    changed,
    fail,
    finished,
    keep_stop,
    own_and,
    place_lost,
    send_stop,
    state_at_rest,
    target_lost,
    with_faults,
    with_how,
)
from ldcnd.axis.reading_step import take_reading
from ldcnd.axis.rest import NOTHING_SEEN, RestEvidence, shows_velocity
from ldcnd.axis.status import STRENGTH, AxisStatus, CommandProgress
from ldcnd.axis.watch import let_go, next_following
from ldcnd.contract.commands import Verb
from ldcnd.contract.samples import AxisState, LinkState, Unseen
from ldcnd.drives.driver import StopMode
from ldcnd.line.proof import MISSES_UNTIL_LOST

LEFT = "sent before the drive was read: what it did while no daemon read it is not known"


def step(status: AxisStatus, event: AxisEvent) -> AxisStatus:
    """Return the status after an event; the same object where nothing changes."""
    return STEPS[type(event)](status, event)


def _take_look(status: AxisStatus, event: LookTaken) -> AxisStatus:
    braking = status.braking
    # where it shows that the motor is off, the power that may follow is not what a stop was to take away
    if braking and braking.mode is StopMode.OFF and not status.driven_open and not event.reading.enabled:
        braking = None
    return changed(status, rest=replace(status.rest, turns=shows_velocity(event.reading)), braking=braking)


def _see_loop(status: AxisStatus, event: LoopSeen) -> AxisStatus:
    return changed(status, enabled=event.enabled)


def _miss(status: AxisStatus, event: PollMissed) -> AxisStatus:
    status = changed(status, misses=min(status.misses + 1, MISSES_UNTIL_LOST))
    if status.misses >= MISSES_UNTIL_LOST:
        return _lose_drive(status, DriveLost(event.now_ns, event.another, event.before, asked=True))
    return replace(status, link=LinkState.DEGRADED) if status.link is LinkState.UP else status


def _lose_drive(status: AxisStatus, event: DriveLost) -> AxisStatus:
    was_up = status.link is not LinkState.DOWN
    lost = replace(LINK_LOST, text=LINK_BLOCKED.format(before=event.before)) if event.before else LINK_LOST
    fault = NOT_IDENTIFIED if event.another else lost
    status = target_lost(status)
    if not was_up and any(entry.code == fault.code for entry in status.faults):
        return with_faults(status, (fault,), event.now_ns)  # what is before it is known by now, or answers again
    if not was_up and not event.another and not event.asked:
        return status
    # a counter that is not read may have been set, so what it shows later is no place
    rest = _out_of_sight(status) if was_up else status.rest
    status = replace(place_lost(status), link=LinkState.DOWN, rest=rest, coast=None)
    status = with_faults(status, (fault,), event.now_ns)
    # it stays as the reason of error_stop when the drive answers again
    return fail(status, "the drive did not answer") if was_up and status.state is not AxisState.DISABLED else status


def _out_of_sight(status: AxisStatus) -> RestEvidence:
    """Return what is known of the rest of an axis that could not be read for a while."""
    # what stood goes on standing: only a motor that has power turns a shaft, and that the next reading shows
    if status.at_rest and not status.rest_unproven_by and status.unseen is None:
        return NOTHING_SEEN
    return replace(status.limits.unseen, left_turning=status.unseen is not Unseen.MOTOR_OFF)


def _take_unusable(status: AxisStatus, event: ReplyUnusable) -> AxisStatus:
    link = LinkState.DEGRADED if status.link is LinkState.UP else status.link
    status = changed(status, misses=0, in_vain=min(status.in_vain + 1, MISSES_UNTIL_LOST), link=link)
    if status.in_vain < MISSES_UNTIL_LOST or status.replies_unusable or link is LinkState.DOWN:
        return status
    own = own_and(status, REPLIES_UNUSABLE)
    status = with_faults(replace(status, rest=_out_of_sight(status), own=own), own, event.now_ns)
    return status if status.state is AxisState.DISABLED else fail(status, REPLIES_UNUSABLE.text)


def _take_contradiction(status: AxisStatus, event: ReadingsContradicted) -> AxisStatus:
    # what has proved its rest before was of the same encoder
    rest = replace(status.limits.unseen, left_turning=True)
    if not status.contradicts:
        own = own_and(status, READINGS_CONTRADICT)
        status = with_faults(replace(status, own=own), own, event.now_ns)
    status = changed(place_lost(status), misses=0, in_vain=0, link=LinkState.UP, rest=rest, position_lost=True)
    return status if status.state is AxisState.DISABLED else fail(status, READINGS_CONTRADICT.text)


def _find_fault(status: AxisStatus, event: FaultFound) -> AxisStatus:
    return changed(target_lost(status), own=own_and(status, event.fault))


def _refuse_reference(status: AxisStatus, event: ReferenceRefused) -> AxisStatus:
    if status.referenced:
        return status  # there is another one
    text = f"{REFERENCE_REFUSED.text}: {event.reason}; home the axis, or set its position"
    own = own_and(status, replace(REFERENCE_REFUSED, text=text))
    # it was left in a motion, or something has moved it since: it may turn still, and its encoder may be dead
    return replace(
        status, refused=event.reason, reference_lost=True, own=own, rest=replace(status.rest, left_turning=True)
    )


def _know_place(status: AxisStatus, event: PlaceKnown) -> AxisStatus:
    own = tuple(fault for fault in status.own if fault.code != REFERENCE_REFUSED.code)
    target = None if event.resting else status.target
    return replace(
        status,
        scale=event.scale,
        span=status.limits.span(event.scale),
        referenced=True,
        reference_lost=False,
        refused="",
        own=own,
        target=target,
        rest=replace(status.rest, unseen_s=0.0) if event.stood else status.rest,
    )


def _set_limits(status: AxisStatus, event: LimitsSet) -> AxisStatus:
    return changed(status, limits=event.limits, span=event.limits.span(status.scale))


def _unknow_place(status: AxisStatus, _event: PlaceUnknown) -> AxisStatus:
    return place_lost(status)


def _begin(status: AxisStatus, event: CommandBegun | CommandGoesOn) -> AxisStatus:
    command, before, last_error = event.command, status.command, status.last_error
    if before is None:
        last_error = None
    elif before.command_id != command.command_id:
        status = abort(status, command.verb, command.command_id)
        if command.state is not AxisState.STOPPING:  # what takes a motion over goes on with it as another command's
            last_error = None
        elif before.state is not AxisState.STOPPING:  # a stop that gives way to another one has not failed
            last_error = status.last_error
    rest = status.rest
    return replace(
        status,
        command=command,
        state=command.state,
        # no reading says anything of it before the drive has it
        effective_from_s=math.inf,
        last_error=last_error,
        interlock=status.interlock if command.state is AxisState.STOPPING else "",  # that is how it ends the motion
        target=None if command.state is AxisState.CONTINUOUS_MOTION else command.target,
        target_counts=None,
        approached=False,
        # the motion replaces the stop that readings were to show
        braking=None,
        progress=CommandProgress(failure=status.progress.failure, way=command.way),
        # it counts as moving before it does, so that nothing is decided by the rest of before
        rest=RestEvidence(rests=False, commanded=rest.commanded, unseen_s=rest.unseen_s, at_once=rest.at_once),
    )


def _start(status: AxisStatus, event: MotionStarted) -> AxisStatus:
    command, progress = status.command, status.progress
    following, rest = next_following(status, event), RestEvidence(rests=False, commanded=not event.endless)
    if status.unseen:  # its encoder proves nothing before it has counted in a motion that is long enough for that
        if event.following and following and following.is_long:
            following = following.doubted()
        else:
            rest = replace(status.rest, rests=False)
    if command and command.duration_s is not None:
        progress = replace(progress, ends_at_s=event.now_s + command.duration_s)
    status = replace(
        status,
        effective_from_s=event.now_s,
        progress=replace(progress, pace=event.pace, unsure=event.unsure),
        following=following,
        driven_open=status.driven_open or (command is not None and command.opens_loop),
        rest=rest,
    )
    if event.target_counts is None:
        return status
    return replace(status, target_counts=event.target_counts, approached=event.approached)


def _change_speed(status: AxisStatus, event: SpeedChanged) -> AxisStatus:
    command = status.command
    if command is None:
        return status
    # of the whole motion, a part of which lies behind it
    duration_s = (event.now_ns - command.since_ns) / 1e9 + event.rest_s
    command, target, told_anew = replace(command, duration_s=duration_s), event.target_counts, ToldAnew(event.doubt)
    if target is not None and command.settling:
        former = command.settling.target_counts
        told_anew = told_anew.after(status.progress.told_anew, former, target)
        if former != target:
            settling = replace(command.settling, target_counts=target)
            shown = None if command.target is None else status.scale.shown_at(target)
            command = replace(command, settling=settling, target=shown)
    following = status.following and event.profile and status.following.going_on(*event.profile)
    ends_at_s = event.now_s + event.rest_s
    progress = replace(status.progress, ends_at_s=ends_at_s, pace=event.pace, told_anew=told_anew)
    return replace(status, command=command, progress=progress, following=following or None)


def _note_failure(status: AxisStatus, event: CommandFailing) -> AxisStatus:
    progress, interlock = replace(status.progress, failure=event.reason), event.interlock or status.interlock
    return changed(status, progress=progress, interlock=interlock)


def _end_command(status: AxisStatus, event: CommandOver) -> AxisStatus:
    return finished(status, event.error)


def _switch_power(status: AxisStatus, event: PowerSwitched) -> AxisStatus:
    on, ended = event.on, abort(status, Verb.POWER, event.by)
    # a loop that closes holds the shaft; one that is let go may coast, or fall; what was off before is as it was
    rest = ended.rest
    if on:  # where nothing has shown that the encoder counts, its first motion does
        seen = status.unseen is None
        rest = RestEvidence(rests=True, commanded=seen, unseen_s=0.0 if seen else rest.unseen_s)
    elif status.enabled:
        rest = RestEvidence(unseen_s=rest.unseen_s)
    coast = status.coast
    if status.enabled and status.limits.slowing_counts_per_s2:
        coast = let_go(status, event.now_s)
    return replace(
        ended,
        state=state_at_rest(status, enabled=on),
        enabled=on,
        effective_from_s=event.now_s,
        target_counts=None,
        braking=None,
        following=None if on else status.following,
        coast=None if on else coast,
        rest=rest,
    )


def _switch_loop(status: AxisStatus, event: LoopSwitched) -> AxisStatus:
    rest = RestEvidence(rests=False, commanded=status.rest.commanded, unseen_s=status.rest.unseen_s)
    if not event.on:  # a load may fall; a shaft whose motor was off before is as it was
        rest = replace(rest, rests=None) if status.enabled else status.rest
    coast = let_go(status, event.now_s) if status.coast and status.enabled and not event.on else status.coast
    return replace(status, effective_from_s=event.now_s, enabled=event.on, rest=rest, coast=coast)


def _override_speed(status: AxisStatus, event: SpeedOverridden) -> AxisStatus:
    return changed(status, speed_share=event.share)


def _change_control(status: AxisStatus, event: ControlChanged) -> AxisStatus:
    return changed(status, holder=event.holder)


def _count_stop(status: AxisStatus, _event: Overtaken) -> AxisStatus:
    return replace(status, stops=status.stops + 1)


def _latch(status: AxisStatus, _event: StopLatch) -> AxisStatus:
    return status if status.stop_latched else replace(status, stop_latched=True)


def _name_latch(status: AxisStatus, event: LatchNamed) -> AxisStatus:
    return replace(status, latched_by=event.by) if status.stop_latched and status.latched_by is None else status


def _take_due_stop(status: AxisStatus, event: StopDue) -> AxisStatus:
    status = send_stop(status, StopSent(event.mode, event.verb))
    stop = status.stop
    if stop is None:
        return status
    return changed(status, stop=replace(stop, unread=True, asked=with_how(stop.asked, event.how)))


def _note_overdue(status: AxisStatus, event: StopOverdue) -> AxisStatus:
    stop = status.stop
    if stop is None or not stop.unread or stop.fault:
        return status
    return replace(status, stop=replace(stop, fault=entry_of(STOP_UNCONFIRMED, event.now_ns)))


def _acknowledge_stop(status: AxisStatus, event: StopAcknowledged) -> AxisStatus:
    braking = Braking(event.mode, event.now_s, event.deceleration_counts_per_s2)
    # a profile that ends at once has no way in which the shaft was to be seen to move
    following = status.following
    if event.mode is StopMode.ABRUPT and not (following and following.gone_counts >= 4 * following.leeway.least_counts):
        following = None
    rest, coast = status.rest, status.coast
    if event.mode is StopMode.ABRUPT:
        at_once, coast = coast is not None and coast.is_fast and status.enabled, None
    else:  # a loop that closes beside a shaft which a duty has driven
        at_once = status.driven_open and event.mode is not StopMode.OFF
    if at_once and status.limits.slowing_counts_per_s2:
        rest = replace(status.limits.unseen, commanded=True, at_once=True)
    return replace(status, braking=braking, off_again=False, following=following, rest=rest, coast=coast)


def _confirm_stop(status: AxisStatus, event: StopConfirmed) -> AxisStatus:
    stop = status.stop
    # the acknowledgement of a halt says nothing of a power-off that was asked for meanwhile
    if stop is None or STRENGTH[stop.mode] <= STRENGTH[event.mode]:
        return status if stop is None else replace(status, stop=None)
    asked = tuple(each for each in stop.asked if STRENGTH[each.mode] > STRENGTH[event.mode])
    return status if asked == stop.asked else replace(status, stop=replace(stop, asked=asked))


def _recall_latch(status: AxisStatus, event: LatchRecalled) -> AxisStatus:
    status = replace(status, stop_latched=event.stopped, latched_by=event.by)
    if event.again is not None and event.confirmed:
        # it may have been moved since: that is not known, and no failure of a stop
        status = _take_due_stop(status, StopDue(event.again, LEFT))
    elif event.again is not None:
        status = keep_stop(status, StopUnconfirmed(event.now_ns, event.again))
    if not event.in_error:
        return status
    return replace(status, state=AxisState.ERROR_STOP, first_fault=entry_again(event.first) if event.first else None)


def _reset(status: AxisStatus, event: ResetDone) -> AxisStatus:
    rest = status.rest
    if status.rest_unproven_by:  # a person has looked at it: that permits power, and proves no rest to interlocks
        rest = rest.doubted(status.limits.unseen.unseen_s)
    return replace(
        status,
        # MC_Reset leads to Standstill or, without power, to Disabled (PLCopen part 1, state diagram, notes 3 and 4)
        state=AxisState.STANDSTILL if status.enabled else AxisState.DISABLED,
        # a reading that was asked for before still shows what was reset
        effective_from_s=event.now_s,
        stop_latched=False,
        latched_by=None,
        position_lost=False,
        following=None,
        own=(),
        faults=(),
        first_fault=None,
        last_error=None,
        interlock="",
        rest=rest,
    )


OfCommand = CommandGoesOn | MotionStarted | CommandFailing | CommandOver
"""What befalls the command that it names, and no other."""


def _named(take: Callable[[AxisStatus, Any], AxisStatus]) -> Callable[[AxisStatus, OfCommand], AxisStatus]:
    """Return a step that changes nothing where the command that its event names is not under way."""

    def take_named(status: AxisStatus, event: OfCommand) -> AxisStatus:
        return take(status, event) if status.is_at(event.command_id) else status

    return take_named


STEPS: Mapping[type, Callable[[AxisStatus, Any], AxisStatus]] = MappingProxyType(
    {
        ReadingTaken: take_reading,
        LimitsSet: _set_limits,
        LookTaken: _take_look,
        LoopSeen: _see_loop,
        PollMissed: _miss,
        DriveLost: _lose_drive,
        ReplyUnusable: _take_unusable,
        ReadingsContradicted: _take_contradiction,
        FaultFound: _find_fault,
        ReferenceRefused: _refuse_reference,
        PlaceKnown: _know_place,
        PlaceUnknown: _unknow_place,
        CommandBegun: _begin,
        CommandGoesOn: _named(_begin),
        MotionStarted: _named(_start),
        SpeedChanged: _change_speed,
        CommandFailing: _named(_note_failure),
        CommandOver: _named(_end_command),
        PowerSwitched: _switch_power,
        LoopSwitched: _switch_loop,
        SpeedOverridden: _override_speed,
        ControlChanged: _change_control,
        Overtaken: _count_stop,
        StopLatch: _latch,
        LatchNamed: _name_latch,
        StopSent: send_stop,
        StopAcknowledged: _acknowledge_stop,
        StopUnconfirmed: keep_stop,
        StopDue: _take_due_stop,
        StopOverdue: _note_overdue,
        StopConfirmed: _confirm_stop,
        LatchRecalled: _recall_latch,
        ResetDone: _reset,
    }
)
