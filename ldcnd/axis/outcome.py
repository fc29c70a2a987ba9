"""What steps of an axis have in common: faults that stand, stops that are owed, and how a command ends. Pure."""

import math
from dataclasses import replace
from typing import Any

from ldcnd.axis.events import StopSent, StopUnconfirmed
from ldcnd.axis.faults import REFERENCE_REFUSED, STOP_UNCONFIRMED, entry_of
from ldcnd.axis.status import JUST_BEGUN, STRENGTH, AskedStop, AxisStatus, CommandEnd, OpenStop, aborted_by
from ldcnd.contract.commands import Verb
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState, FaultEntry
from ldcnd.drives.driver import AxisReading, Fault

ENDED_ELSEWHERE = "its drive holds the axis elsewhere than it was sent: another program has stopped it, or moved it"
NOT_HEARD = "it has ended where it was to end before its speed was changed, which its drive has not heard: {why}"
NOT_SHOWN = "it was acknowledged, perhaps by a late reply to another packet"
ENDED_BY = "ended by a {verb} that its drive has not confirmed yet"


def changed(status: AxisStatus, **changes: Any) -> AxisStatus:  # noqa: ANN401 - fields of a status
    """Return a status with other fields; the same object where they have these values already."""
    for name, value in changes.items():
        if getattr(status, name) != value:
            return replace(status, **changes)
    return status


def target_lost(status: AxisStatus) -> AxisStatus:
    """Return the status of an axis that is not known to be where it was sent: where it stands, readings tell."""
    return changed(status, target=None, target_counts=None, approached=False)


def with_faults(status: AxisStatus, faults: tuple[Fault, ...], now_ns: int) -> AxisStatus:
    """Return a status in which these faults stand; one that stood before keeps its instant."""
    known = {entry.code: entry for entry in status.faults}
    entries = tuple(_entry(known.get(fault.code), fault, now_ns) for fault in faults)
    first = status.first_fault
    if first is None:
        pending = (status.stop.fault,) if status.stop and status.stop.fault else ()
        first = next((entry for entry in (*entries, *pending) if entry.code != REFERENCE_REFUSED.code), None)
    if first and not first.stops:  # a warning puts no axis into error stop, and would hide what does
        first = next((entry for entry in entries if entry.stops), first)
    return changed(status, faults=entries, first_fault=first)


def _entry(known: FaultEntry | None, fault: Fault, now_ns: int) -> FaultEntry:
    """Return the entry of a fault; one that stood before says what is known of it by now."""
    if known is None:
        return entry_of(fault, now_ns)
    return known if known.text == fault.text else known.model_copy(update={"text": fault.text})


def own_and(status: AxisStatus, fault: Fault) -> tuple[Fault, ...]:
    """Return the faults that this daemon has found, and another one; each stands once."""
    return (*(own for own in status.own if own.code != fault.code), fault)


def place_lost(status: AxisStatus) -> AxisStatus:
    """Return the status of an axis whose position is no reference any more."""
    return changed(status, referenced=False, reference_lost=status.referenced or status.reference_lost)


def fail(status: AxisStatus, reason: str, *, settled: bool | None = None) -> AxisStatus:
    """Return the status in error stop; the command under way, if there is one, has failed for the reason."""
    if status.command is None and status.state is not AxisState.ERROR_STOP:  # the first cause stays
        status = changed(status, last_error=reason)
    return _end(changed(status, state=AxisState.ERROR_STOP), CommandStatus.FAILED, reason, settled=settled)


def abort(status: AxisStatus, by: Verb, command_id: str | None) -> AxisStatus:
    """Return the status of a command that another one ends, with the reason where something is wrong, too."""
    if by is Verb.HALT and status.command and status.command.verb is Verb.JOG and not status.progress.failure:
        return _end(status, CommandStatus.DONE)  # MC_Jog: a jog has no other end than to be let go
    when = " while it settled: its profile was over" if status.progress.settle else ""
    failing = f"; it was failing already: {status.progress.failure}" if status.progress.failure else ""
    why = f", because of interlock {status.interlock}" if failing and status.interlock else failing
    return _end(
        status,
        CommandStatus.ABORTED,
        f"{aborted_by(by)}{when}{why}",
        by=(by, command_id) if command_id else None,
    )


def finished(status: AxisStatus, error: str | None = None, *, settled: bool | None = None) -> AxisStatus:
    """Return the status behind a command that has come to its end, or has failed by now."""
    error = error or status.progress.failure
    status = _end(status, CommandStatus.FAILED if error else CommandStatus.DONE, error, settled=settled)
    return changed(status, state=state_at_rest(status, enabled=status.enabled))


def why_beside(status: AxisStatus, reading: AxisReading) -> str:
    """Return why a profile of the command under way has ended beside its target.

    Args:
        status: of the axis.
        reading: that shows it.
    """
    if status.progress.unsure:  # it may never have begun
        return status.progress.unsure.why
    if reading.cut_short:
        return reading.cut_short
    if status.stop:
        return ENDED_BY.format(verb=next((asked.verb for asked in status.stop.asked), Verb.STOP))
    told_anew, settling = status.progress.told_anew, status.command.settling if status.command else None
    if told_anew and settling and told_anew.has_gone_on(settling, reading):
        return NOT_HEARD.format(why=told_anew.doubt or NOT_SHOWN)
    return ENDED_ELSEWHERE


def state_at_rest(status: AxisStatus, *, enabled: bool) -> AxisState:
    """Return the state without a command. MC_Reset alone leads out of ErrorStop (PLCopen part 1, state diagram)."""
    if status.state is AxisState.ERROR_STOP:
        return AxisState.ERROR_STOP
    return AxisState.STANDSTILL if enabled else AxisState.DISABLED


def _end(
    status: AxisStatus,
    how: CommandStatus,
    reason: str | None = None,
    *,
    settled: bool | None = None,
    by: tuple[Verb, str] | None = None,
) -> AxisStatus:
    """Return the status behind the command under way, if there is one."""
    command = status.command
    # what no drive has taken has no effect to wait for: readings count
    effective_from_s = 0.0 if math.isinf(status.effective_from_s) else status.effective_from_s
    # what ended otherwise stands elsewhere: where, the first reading at rest tells
    status = status if how is CommandStatus.DONE else target_lost(status)
    status = changed(status, progress=JUST_BEGUN, effective_from_s=effective_from_s)
    if command is None:
        return status
    rest = status.rest
    if command.opens_loop and status.limits.slowing_counts_per_s2:  # nothing tells how what it has driven is to turn
        rest = replace(status.limits.unseen, left_turning=True)
    return replace(
        status,
        command=None,
        rest=rest,
        last_error=f"{command.verb}: {reason}" if reason else status.last_error,
        last_end=CommandEnd(command, how, reason, settled, by),
    )


def send_stop(status: AxisStatus, event: StopSent) -> AxisStatus:
    """Return the status in which a stop is owed; of several the strongest is."""
    stop, asked = status.stop or OpenStop(event.mode), AskedStop(event.verb, event.mode)
    known = next((each for each in stop.asked if each.verb is event.verb), None)
    mode = max(stop.mode, event.mode, key=STRENGTH.__getitem__)
    if known is None:
        return replace(status, stop=replace(stop, mode=mode, asked=(*stop.asked, asked)))
    return status if mode is stop.mode else replace(status, stop=replace(stop, mode=mode))


def keep_stop(status: AxisStatus, event: StopUnconfirmed) -> AxisStatus:
    """Return the status in which a stop is owed that no drive has confirmed: it is sent until one does."""
    status = send_stop(status, StopSent(event.mode, event.verb))
    stop = status.stop
    if stop is None or (stop.fault and all(each.how for each in stop.asked)):
        return status
    # the fault keeps the instant from which the stop was wanted
    fault = stop.fault or entry_of(STOP_UNCONFIRMED, event.now_ns)
    return replace(status, stop=replace(stop, fault=fault, asked=with_how(stop.asked, event.how)))


def with_how(asked: tuple[AskedStop, ...], how: str) -> tuple[AskedStop, ...]:
    """Return what was asked for, with why it is sent where that is not known yet."""
    return tuple(each if each.how else replace(each, how=how) for each in asked)
