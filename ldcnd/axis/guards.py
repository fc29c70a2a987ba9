"""What must hold of an axis before a command begins and before its packets go, in a table. Pure.

Each refusal says what, which limit, and what to do. The table also answers `why`: nothing else says what forbids a
command.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass

from ldcnd.axis.status import AxisStatus
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.catalogue import AXIS_COMMANDS
from ldcnd.contract.commands import Effect, Verb
from ldcnd.contract.condition import is_over, over_in_words, way_to_rest
from ldcnd.contract.errors import (
    AccelerationLimit,
    AxisUnreachable,
    CommandExpired,
    DriveFault,
    LdcndError,
    NotReferenced,
    PositionLimit,
    Remedy,
    StopLatched,
    StopNotConfirmed,
    ValueOutOfRange,
    VelocityLimit,
    WrongState,
    step,
)
from ldcnd.contract.meta import AxisLimits
from ldcnd.contract.samples import AxisState, FaultEntry, LinkState, Moving, Unseen
from ldcnd.contract.units import Dimension
from ldcnd.drives.driver import QuietDrive

_POWER_ON = step("power", 'send power {"on": true}', on=True)


def check_reachable(axis: AxisTracker) -> None:
    """Refuse when the drive does not answer, or is not known to be the one that is configured."""
    if not axis.proof.holds:
        raise axis.proof.refusal()
    if axis.status.link is LinkState.DOWN:
        raise AxisUnreachable(
            f"axis {axis.name}: the drive does not answer", axis=axis.name, remedy="check its power and the line"
        )


def check_not_overtaken(axis: AxisTracker, after_stops: int | None) -> None:
    """Refuse what was asked for before a stop that has come first; see `AxisCommand.after_stops`."""
    if after_stops not in {None, axis.status.stops}:
        raise CommandExpired(
            f"axis {axis.name}: a stop, halt or power off came after this was asked for; nothing has happened",
            axis=axis.name,
            value=after_stops,
            limit=axis.status.stops,
            remedy="look at the axis, then send it again",
        )


def check_not_latched(axis: AxisTracker) -> None:
    """Refuse while a stop is latched, or not confirmed by the drive."""
    if axis.status.stop:
        check_stop_confirmed(axis)
    if axis.status.stop_latched:
        raise StopLatched(f"axis {axis.name}: a stop is latched", axis=axis.name, remedy=_reset(axis.status))


def check_stop_confirmed(axis: AxisTracker) -> None:
    """Refuse while the drive has not confirmed a stop; what latches counts from the instant at which it is sent."""
    if axis.status.stop_due or (axis.status.stop and axis.status.stop_latched):
        if axis.status.stop_due and not axis.status.stop_pending:
            unread = "is" if axis.status.was_read else "was not read yet, and is"
            raise StopNotConfirmed(
                f"axis {axis.name}: the drive {unread} sent its stop first", axis=axis.name, remedy="wait a moment"
            )
        away = axis.status.link is LinkState.DOWN
        raise StopNotConfirmed(
            f"axis {axis.name}: the drive has not confirmed a stop yet",
            axis=axis.name,
            remedy=f"{'give the drive power' if away else 'wait'}: the stop is sent again until the drive confirms it;"
            " check the drive and its line",
        )


def check_not_in_error(axis: AxisTracker) -> None:
    """Refuse while a fault, or a command that ended badly, waits to be acknowledged."""
    if axis.status.state is AxisState.ERROR_STOP:
        raise error_stop(axis)


def check_enabled(axis: AxisTracker) -> None:
    """Refuse a motion while the position loop is open."""
    status = axis.status
    # error_stop hides that it is disabled as well, which its reset does not change
    if status.state is AxisState.DISABLED or (status.state is AxisState.ERROR_STOP and not status.enabled):
        raise WrongState(
            f"axis {axis.name} is disabled",
            axis=axis.name,
            value=AxisState.DISABLED,
            remedy=Remedy("wait until it stands, then {}", _POWER_ON) if status.coasts else Remedy("{}", _POWER_ON),
        )


def check_stands(axis: AxisTracker) -> None:
    """Refuse while a motion runs: a trapezoid loaded in mid-move is erratic on most drives (PIC-SERVO manual, 4.4)."""
    if axis.status.state.is_motion:
        raise WrongState(
            f"axis {axis.name} is {axis.status.state.words}",
            axis=axis.name,
            value=axis.status.state,
            remedy=way_to_rest(axis.status.state),
        )


def check_does_not_coast(axis: AxisTracker) -> None:
    """Refuse to close the loop while the shaft turns: the drive would hold it where it is, at once.

    A shaft turns when its drive shows a velocity, which is more than a count in a servo cycle: one that creeps, as a
    load that sinks, can be caught.
    """
    if axis.status.motion_hidden_by and not axis.status.enabled:
        raise WrongState(
            f"axis {axis.name} may turn with its motor off, and its readings do not prove that it does not",
            axis=axis.name,
            value=axis.status.motion_hidden_by,
            remedy=Remedy("look whether it stands, then {}", step("reset")),
        )
    if axis.status.unseen is Unseen.LEFT_TURNING:
        raise WrongState(
            f"axis {axis.name} may turn with its motor off: it was not read while it moved, and its encoder has not"
            f" counted since; it stands once it has not counted for {axis.status.rest.unseen_s:g} s",
            axis=axis.name,
            limit=axis.status.rest.unseen_s,
            remedy=Remedy("wait until it stands, then {}", _POWER_ON),
        )
    if axis.status.coasts:
        raise WrongState(
            f"axis {axis.name} turns with its motor off: its drive would hold it at once, whatever its speed",
            axis=axis.name,
            remedy=Remedy("wait until it stands, then {}", _POWER_ON),
        )


def check_referenced(axis: AxisTracker) -> None:
    """Refuse an absolute position on an axis that is not referenced."""
    if not axis.status.referenced:
        kept = f"; what was kept of it was refused: {axis.status.refused}" if axis.status.refused else ""
        raise NotReferenced(
            f"axis {axis.name} is not homed: its position is not known{kept}",
            axis=axis.name,
            remedy=way_to_rest(axis.status.state)
            if axis.status.state is AxisState.HOMING
            else Remedy("{} or {}", step("home"), step("set_position", "set_position")),
        )


def check_origin(axis: AxisTracker, farthest: float, position: float) -> None:
    """Refuse to call a place by a number at which single counts could not be told apart any more."""
    if abs(position) > farthest:
        nearest = math.copysign(farthest, position)
        raise ValueOutOfRange(
            f"axis {axis.name}: position {position:.12g} {axis.status.unit} is beyond {nearest:.12g}"
            f" {axis.status.unit}: it could not be told to a count",
            axis=axis.name,
            value=position,
            limit=nearest,
            nearest=nearest,
        )


def check_position_kept(axis: AxisTracker) -> None:
    """Refuse to give the position a meaning while the drive says that it has lost it."""
    if axis.status.position_lost:
        raise WrongState(
            f"axis {axis.name}: its position is lost: {_said(axis)}",
            axis=axis.name,
            remedy=Remedy("{} first", step("reset")),
        )


def check_position(axis: AxisTracker, limits: AxisLimits, position: float) -> None:
    """Refuse a target outside the software limits, naming the nearest that is inside."""
    if limits.position_min is not None and position < limits.position_min:
        limit, side = limits.position_min, "below"
    elif limits.position_max is not None and position > limits.position_max:
        limit, side = limits.position_max, "above"
    else:
        return
    raise PositionLimit(
        f"axis {axis.name}: target {position:.12g} {axis.status.unit} is {side} the limit"
        f" {limit:.12g} {axis.status.unit}",
        axis=axis.name,
        value=position,
        limit=limit,
        nearest=limit,
    )


def check_velocity(axis: AxisTracker, limits: AxisLimits, velocity: float) -> None:
    """Refuse a speed above the limit."""
    if limits.velocity is not None and abs(velocity) > limits.velocity:
        raise VelocityLimit(
            f"axis {axis.name}: velocity {axis.status.scale.text(velocity, Dimension.VELOCITY)} is above the limit"
            f" {axis.status.scale.text(limits.velocity, Dimension.VELOCITY)}",
            axis=axis.name,
            value=velocity,
            limit=limits.velocity,
            nearest=limits.velocity if velocity > 0 else -limits.velocity,
        )


def check_acceleration(axis: AxisTracker, limits: AxisLimits, acceleration: float) -> None:
    """Refuse an acceleration above the limit."""
    if limits.acceleration is not None and acceleration > limits.acceleration:
        raise AccelerationLimit(
            f"axis {axis.name}: acceleration {axis.status.scale.text(acceleration, Dimension.ACCELERATION)} is above"
            f" the limit {axis.status.scale.text(limits.acceleration, Dimension.ACCELERATION)}",
            axis=axis.name,
            value=acceleration,
            limit=limits.acceleration,
            nearest=limits.acceleration,
        )


def check_rates(axis: AxisTracker, limits: AxisLimits, velocity: float, acceleration: float) -> None:
    """Refuse a speed or an acceleration above its limit, and any while the speed override of the rig is 0."""
    check_velocity(axis, limits, velocity)
    check_acceleration(axis, limits, acceleration)
    check_speed(axis)


def check_speed(axis: AxisTracker) -> None:
    """Refuse a motion while the speed override of the rig is 0."""
    if axis.status.speed_share <= 0:
        raise WrongState(
            f"axis {axis.name}: the speed override of the rig is 0 %",
            axis=axis.name,
            value=0.0,
            remedy=Remedy("{} above 0 %", step("set_speed_override", "set the speed override")),
        )


def check_not_forced(axis: AxisTracker) -> None:
    """Refuse to reset a faulted axis whose motor has voltage and turns, or may, whatever the state says."""
    status = axis.status
    if _is_forced(status):
        raise WrongState(
            f"axis {axis.name} still moves, or may: a reset would switch its motor off at speed",
            axis=axis.name,
            value=axis.status.moving.value,
            remedy=_way_out(axis.status) if axis.status.motion_hidden_by else _reset(status),
        )


def _is_forced(status: AxisStatus) -> bool:
    # a shaft that was only not seen to count may coast: behind the reset `coast_s` tells when it stands
    stands = status.moving is Moving.NO or (status.unseen and status.at_rest and not status.rest_unproven_by)
    return status.state is AxisState.ERROR_STOP and status.energised and not stands


def _reset(status: AxisStatus) -> Remedy:
    """Return the step that clears a latch or error_stop, behind those without which it would be refused."""
    if _is_forced(status):
        return Remedy("{}, wait until it stands, then {}", step("halt"), step("reset"))
    return Remedy(f"{'wait until it stands, then ' if status.state.is_motion else ''}{{}}", step("reset"))


def check_has_gains(drive: QuietDrive) -> None:
    """Refuse to close the loop of a drive that takes gains and has none."""
    if Verb.SET_GAINS in drive.capabilities and drive.wanted_gains is None:
        raise WrongState(
            f"axis {drive.spec.name} has no gains: its loop cannot close",
            axis=drive.spec.name,
            remedy=Remedy("configure gains or {}", step("set_gains")),
        )


def fault(axis: AxisTracker, entry: FaultEntry) -> DriveFault:
    """Return a fault of a drive as what keeps its axis from moving."""
    return DriveFault(f"axis {axis.name}: {entry.text}", axis=axis.name, value=entry.code, remedy=_way_out(axis.status))


def _way_out(status: AxisStatus) -> Remedy:
    """Return the way out of a fault: where only a look tells whether the shaft stands, its motor is off before."""
    clear = "remove the cause, then {}"
    if not status.motion_hidden_by:
        return Remedy(clear, step("reset"))
    looks = f"look at it, for it may move unseen; {clear}"
    if not status.energised:
        return Remedy(looks, step("reset"))
    return Remedy(f"{{}}; {looks}", step("power", 'send power {"on": false}', on=False), step("reset"))


def error_stop(axis: AxisTracker, said: Collection[FaultEntry] = ()) -> WrongState:
    """Return the refusal of an axis in error_stop, with its causes but for those that were said before."""
    status, first, in_error = axis.status, axis.status.first_fault, f"axis {axis.name} is in error stop"
    if first and not status.active_faults and is_over(first, (), status.link):
        text, remedy = f"{in_error} because of {over_in_words(first)}", _reset(status)
    else:
        causes = _said(axis, said) or ("" if said else "a command ended badly")
        text, remedy = (
            f"{in_error}: {causes}" if causes else in_error,
            _way_out(status),
        )
    return WrongState(text, axis=axis.name, value=status.state, remedy=remedy)


def in_words(status: AxisStatus, entry: FaultEntry) -> str:
    """Return a fault that has come up since the last reset in words: its text says what is so while it stands."""
    over = is_over(entry, status.active_faults, status.link)
    return over_in_words(entry) if over else f"{entry.code}: {entry.text}"


def _said(axis: AxisTracker, before: Collection[FaultEntry] = ()) -> str:
    first = (axis.status.first_fault,) if axis.status.first_fault else ()
    entries = axis.status.active_faults or first
    return "; ".join(dict.fromkeys(entry.text for entry in entries if entry not in before))


# -- what each command needs -----------------------------------------------------------------------------------------


Guard = Callable[[AxisTracker], None]
"""Raises what a command is refused with while the axis does not hold what it needs."""
ENERGY: tuple[Guard, ...] = (check_reachable, check_not_latched, check_not_in_error)
"""Needed for as long as the motor gets voltage."""
STILL: tuple[Guard, ...] = (*ENERGY, check_enabled, check_stands)
TO_MOVE: tuple[Guard, ...] = (*ENERGY, check_speed)
"""Asked directly before each packet that can move."""
TO_POWER: tuple[Guard, ...] = (*ENERGY, check_does_not_coast)
"""Asked directly before each packet that closes the loop."""


@dataclass(frozen=True, slots=True)
class Needs:
    """What a command needs of the state of its axis, whatever its values.

    Attributes:
        to_begin: asked in this order when its turn has come, before its values.
        at_packet: asked after its values, directly before its packets.
        of_drive: asked of the drive before its first packet.
    """

    to_begin: tuple[Guard, ...] = ()
    at_packet: tuple[Guard, ...] = ()
    of_drive: tuple[Callable[[QuietDrive], None], ...] = ()


BY_VERB: Mapping[Verb, Needs] = {
    Verb.POWER: Needs((*ENERGY, check_stands), TO_POWER, (check_has_gains,)),
    Verb.MOVE_ABSOLUTE: Needs((*STILL, check_referenced), TO_MOVE),
    Verb.TRACK: Needs((*STILL, check_referenced), TO_MOVE),
    Verb.RESET: Needs((check_reachable, check_stop_confirmed, check_stands, check_not_forced)),
    Verb.SET_OUTPUTS: Needs((check_reachable, check_not_latched)),  # what hangs on them may move, as on a module's
    Verb.SET_POSITION: Needs((check_reachable, check_stands, check_position_kept)),
    Verb.TRACE: Needs(at_packet=(check_reachable,)),
    Verb.TRACE_ABORT: Needs(),
    Verb.RESTART_EEPROM_COUNT: Needs(),  # the count is the daemon's own
}
"""`power` is to close the loop: to open it needs nothing."""
BY_EFFECT: Mapping[Effect, Needs] = {Effect.MOTION: Needs(STILL, TO_MOVE), Effect.CHANGE: Needs((check_reachable,))}
"""What a command needs that has no entry of its own; nothing where its effect has none either."""


AT_ALL = Needs(ENERGY)
"""What a motion needs that a drive takes over its own inputs."""


def needs(verb: Verb) -> Needs:
    """Return what a command needs."""
    return BY_VERB[verb] if verb in BY_VERB else BY_EFFECT.get(AXIS_COMMANDS[verb].effect, Needs())


_MOTIONS = frozenset(state for state in AxisState if state.is_motion)
GOES_ON: Mapping[Verb, frozenset[AxisState]] = {
    Verb.MOVE_VELOCITY: frozenset({AxisState.CONTINUOUS_MOTION}),
    Verb.SET_PWM: _MOTIONS,
    Verb.TRACK: _MOTIONS,
}
"""Commands that one of their own takes over without a standstill, while the axis is in one of these states."""


def goes_on(verb: Verb, axis: AxisTracker) -> bool:
    """Tell whether a command takes over one of its own that is under way."""
    return (
        axis.status.command is not None
        and axis.status.command.verb is verb
        and axis.status.state in GOES_ON.get(verb, ())
    )


def check(verb: Verb, axis: AxisTracker, *, follows: bool = False) -> None:
    """Refuse to begin a command; with `follows` one that need not wait until the axis stands."""
    follows = follows or goes_on(verb, axis)
    for guard in needs(verb).to_begin:
        if not (follows and guard is check_stands):
            guard(axis)


def require(guards: tuple[Guard, ...], axis: AxisTracker) -> None:
    """Refuse while the axis does not hold what one of these guards asks for; the first says why."""
    for guard in guards:
        guard(axis)


def obstacles(row: Needs, axis: AxisTracker, drive: QuietDrive) -> Iterator[tuple[LdcndError, Guard | None]]:
    """Yield all that a command with these needs would be refused with now, the first first; and which guard says so."""
    for guard in dict.fromkeys(row.to_begin + row.at_packet):
        try:
            guard(axis)
        except LdcndError as error:
            yield error, guard
    for of_drive in row.of_drive:
        try:
            of_drive(drive)
        except LdcndError as error:
            yield error, None
