"""What a reading changes of the state of an axis: the step that every poll takes. Pure.

One that was requested before the latest command took effect says nothing about that command.
"""

import math
from dataclasses import replace

from ldcnd.axis.events import ReadingTaken, StopUnconfirmed
from ldcnd.axis.faults import DRIVE_CHANGED, LOOP_OPENED, NOT_FOLLOWED, NOT_SETTLED, OUTSIDE_LIMITS
from ldcnd.axis.outcome import (
    changed,
    fail,
    finished,
    keep_stop,
    own_and,
    place_lost,
    target_lost,
    why_beside,
    with_faults,
)
from ldcnd.axis.rest import RestEvidence, SettleProgress, shows_velocity
from ldcnd.axis.status import ActiveCommand, AxisStatus, Completion
from ldcnd.axis.watch import let_go, parted, stood, watch_braking, watch_course, watch_encoder
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.drives.driver import Fault, StopMode

ERROR_WITHIN_S = 0.5
"""Longest time for which a reading with a following error is waited for where a motion has not settled, seconds."""
CLOSED_AGAIN = "sent because its drive had opened its loop, and what was sent before that was seen has closed it again"


def take_reading(status: AxisStatus, event: ReadingTaken) -> AxisStatus:
    """Return the status behind a reading; the step that every poll takes."""
    if not status.commanded:
        return _take_of_others(status, event)
    reading, now_ns = event.reading, event.now_ns
    faults = (*reading.faults, *status.own) if status.own else reading.faults
    if reading.altered and DRIVE_CHANGED not in faults:
        faults = (*faults, DRIVE_CHANGED)
    low, high = status.span
    # under a command it is on its way back, or that command says where it ends
    if not low <= reading.position_counts <= high and status.referenced and status.command is None:
        faults = (*faults, OUTSIDE_LIMITS)
    # any reading ends both rows: the drive answers, and its reply can be used
    if status.misses or status.in_vain or status.link is not LinkState.UP:
        status = replace(status, misses=0, in_vain=0, link=LinkState.UP, was_read=True)
    if status.braking:
        status = watch_braking(status, status.braking, event)
    if faults or status.faults or status.stop:
        lost = any(fault.loses_position for fault in faults) or parted(status, event, faults)
        status = changed(with_faults(status, faults, now_ns), position_lost=lost)
        if lost or stood(status, event):
            status = target_lost(place_lost(status))
    if event.sent_at_s >= status.effective_from_s:  # else it says nothing about the latest command
        status = _take_effective(status, event, faults)
    if status.target is None and status.enabled and _came_to_rest(status):
        return replace(status, target=status.scale.shown_at(reading.position_counts))
    return status


def _take_effective(status: AxisStatus, event: ReadingTaken, faults: tuple[Fault, ...]) -> AxisStatus:
    """Take what a reading shows that was requested after the latest command took effect."""
    reading, at_s, now_ns = event.reading, event.sent_at_s, event.now_ns
    rest, enabled, command = status.rest.observe(reading, at_s), reading.enabled, status.command
    if rest is not status.rest or enabled is not status.enabled:
        status = _see_rest(status, rest, at_s, enabled=enabled)
    unsure = status.progress.unsure
    if unsure and unsure.from_rest and (shows_velocity(reading) or not reading.profile_done):
        status = replace(status, progress=replace(status.progress, unsure=None))
    # the command fails when it comes to rest, not before: until then it may still move
    if reading.cut_short and command:
        status = changed(status, progress=replace(status.progress, failure=reading.cut_short))
    # nothing holds it there any more
    if not enabled and status.target is not None:
        status = target_lost(status)
    if status.following or status.coast or (rest.turns and (not enabled or status.limits.braking_counts_per_s2)):
        before, status = status, watch_encoder(status, event, faults)
        if status.own is not before.own and NOT_FOLLOWED in status.own:
            return status
    if faults and any(fault.stops for fault in faults):
        return _fail_by_fault(status, event)
    if enabled:
        # with its loop closed it is not driven open any more, whatever came of the stop
        if status.driven_open:
            status = replace(status, driven_open=False)
        before = status
        if command and (status.progress.way or status.progress.pace):
            status = watch_course(status, event)
        # a stop that this reading has called for has ended the command, and the axis is in error_stop
        return _take_enabled(status, event, faults) if status.stop is before.stop else status
    # an open loop is no failure where it was asked for, or is known already
    if (command and command.opens_loop) or status.state in (AxisState.DISABLED, AxisState.ERROR_STOP):
        return status
    return fail(with_faults(status, (*faults, LOOP_OPENED), now_ns), LOOP_OPENED.text)


def _see_rest(status: AxisStatus, rest: RestEvidence, at_s: float, *, enabled: bool) -> AxisStatus:
    if status.enabled and not enabled and status.limits.slowing_counts_per_s2:
        return replace(status, rest=rest.let_go(), enabled=enabled, coast=let_go(status, at_s))
    return replace(status, rest=rest, enabled=enabled)


def _fail_by_fault(status: AxisStatus, event: ReadingTaken) -> AxisStatus:
    if status.enabled and any(fault.stops and fault.hides_motion for fault in event.reading.faults):
        status = keep_stop(status, StopUnconfirmed(event.now_ns, StopMode.OFF, CLOSED_AGAIN))
    lost = "; its position is lost" if status.position_lost or status.reference_lost else ""
    return fail(status, f"the drive reports a fault{lost}")


def _take_enabled(status: AxisStatus, event: ReadingTaken, faults: tuple[Fault, ...]) -> AxisStatus:
    """Take a reading of a closed loop that nothing has stopped; `faults` are warnings."""
    command, rests, reading = status.command, status.rest.rests, event.reading
    awaited = status.following and status.following.is_awaited
    if awaited:
        rests = None
    if command is None:
        # nothing but a reset leads out of error_stop, and what is not known to rest or to move changes nothing
        if status.state is AxisState.ERROR_STOP or (rests is None and status.state is not AxisState.DISABLED):
            return status
        if status.state is AxisState.DISABLED and reading.altered:
            return fail(status, DRIVE_CHANGED.text)
        # without a command of this daemon: the motion of another program, or one of before
        state = AxisState.STANDSTILL if rests else AxisState.DISCRETE_MOTION
        status = status if status.state is state else replace(status, state=state)
        target = status.target_counts
        # the way of another program may lie between two polls: where it has led to, the drive shows when it stands
        if target is not None and reading.held_away_counts(target, math.inf) > status.limits.window_counts:
            return target_lost(status)
        return status
    match command.completion:
        case Completion.PROFILE if reading.profile_done and not awaited:
            return _take_profile_end(status, command, event, faults)
        case Completion.REST if reading.profile_done and rests:
            return finished(status)
        case _:
            return status


def _take_profile_end(
    status: AxisStatus, command: ActiveCommand, event: ReadingTaken, faults: tuple[Fault, ...]
) -> AxisStatus:
    before, settling, reading, at_s = status.progress, command.settling, event.reading, event.sent_at_s
    ended_at, value = command.sensor_end, reading.adc_counts
    if ended_at and not before.failure and (value is None or not ended_at.is_reached(value)):
        return finished(status, why_beside(status, reading))
    # what has failed need not settle
    if settling is None or before.failure:
        return finished(status)
    settle, settled = (before.settle or SettleProgress(at_s + settling.timeout_s)).observe(settling, reading, at_s)
    if settled is None:
        return changed(status, progress=replace(before, settle=settle))
    if not settled:
        if not before.unsure and reading.following_error_counts is None and at_s < settle.until_s + ERROR_WITHIN_S:
            return status  # the next reading may tell it
        # where the motion may never have begun, an axis beside its target has no fault
        if before.unsure or settling.ended_elsewhere(reading):
            return finished(status, why_beside(status, reading), settled=False)
    if settled or not settling.faults:
        return finished(status, settled=settled)
    off = (settling.target_counts - reading.position_counts) / status.scale.counts_per_unit
    status = replace(status, own=own_and(status, NOT_SETTLED))
    status = with_faults(status, (*faults, NOT_SETTLED), event.now_ns)
    return fail(status, f"{command.verb} did not settle: {off:.4g} {status.scale.unit} off", settled=False)


def _take_of_others(status: AxisStatus, event: ReadingTaken) -> AxisStatus:
    """Take a reading of a drive that others command: it alone shows whether it is disabled, stands, moves or failed."""
    reading = event.reading
    faults = (*reading.faults, DRIVE_CHANGED) if reading.altered else reading.faults
    status = changed(status, misses=0, in_vain=0, link=LinkState.UP, was_read=True)
    status = with_faults(status, faults, event.now_ns)
    rest, pieces = status.rest, reading.pieces
    if pieces and pieces.recounted:
        rest = replace(rest, since_s=None)
    # a position of before says nothing of the time since, and its speed alone does not tell whether a shaft creeps
    if pieces is None or pieces.position or shows_velocity(reading):
        rest = rest.observe(reading, event.sent_at_s)
    state = AxisState.STANDSTILL if rest.rests else AxisState.DISCRETE_MOTION
    if any(fault.stops for fault in reading.faults):
        state = AxisState.ERROR_STOP
    elif not reading.enabled:
        state = AxisState.DISABLED
    # no reset of this daemon ends it: it goes with its faults
    first = status.first_fault if status.active_faults else None
    return changed(status, first_fault=first, rest=rest, enabled=reading.enabled, state=state)


def _came_to_rest(status: AxisStatus) -> bool:
    """Tell whether a closed loop stands at a place to which no command has sent it."""
    return (
        status.command is None
        and not status.position_lost
        and status.rest.rests is True
        and (status.link is LinkState.UP)
    )
