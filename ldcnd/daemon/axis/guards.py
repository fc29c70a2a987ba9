"""May this start now? Pure checks; each refusal says what, which limit, and what to do."""

from dataclasses import dataclass

from ldcnd.errors import (
    AccelerationLimit,
    AxisUnreachable,
    NotReferenced,
    PositionLimit,
    Remedy,
    StopLatched,
    VelocityLimit,
    WrongState,
    step,
)
from ldcnd.model.meta import AxisLimits
from ldcnd.model.samples import AxisState, LinkState

MOTION_STATES = frozenset(
    {AxisState.HOMING, AxisState.DISCRETE_MOTION, AxisState.CONTINUOUS_MOTION, AxisState.STOPPING}
)


@dataclass(frozen=True, slots=True)
class AxisView:
    """State of an axis for the guards; faults are texts; `position_lost` while one of them has lost the position."""

    name: str
    unit: str
    state: AxisState
    enabled: bool
    referenced: bool
    position_lost: bool
    stop_latched: bool
    link: LinkState
    faults: tuple[str, ...]
    stop_pending: bool = False
    reference_refused: str = ""


def check_reachable(axis: AxisView) -> None:
    """Refuse when the drive does not answer."""
    if axis.link is LinkState.DOWN:
        raise AxisUnreachable(
            f"axis {axis.name}: the drive does not answer", axis=axis.name, remedy="check its power and the line"
        )


def check_not_latched(axis: AxisView) -> None:
    """Refuse while a stop is latched, or not confirmed by the drive."""
    check_stop_confirmed(axis)
    if axis.stop_latched:
        raise StopLatched(f"axis {axis.name}: a stop is latched", axis=axis.name, remedy=Remedy("{}", step("reset")))


def check_stop_confirmed(axis: AxisView) -> None:
    """Refuse while the drive has not confirmed a stop."""
    if axis.stop_pending:
        raise StopLatched(
            f"axis {axis.name}: the drive has not confirmed a stop yet",
            axis=axis.name,
            remedy="wait: it is sent again until the drive confirms it; check the drive and its line",
        )


def check_not_in_error(axis: AxisView) -> None:
    """Refuse while a fault, or a command that ended badly, waits to be acknowledged."""
    if axis.state is AxisState.ERROR_STOP:
        raise _faulted(axis)


def check_enabled(axis: AxisView) -> None:
    """Refuse a motion while the position loop is open."""
    if axis.state is AxisState.DISABLED:
        raise WrongState(
            f"axis {axis.name} is disabled",
            axis=axis.name,
            value=axis.state,
            remedy=Remedy("{}", step("power", 'send power {"on": true}', on=True)),
        )


def check_may_power_on(axis: AxisView) -> None:
    """Refuse to close the loop of an axis that is unreachable, latched or faulted."""
    check_reachable(axis)
    check_not_latched(axis)
    check_not_in_error(axis)


def check_may_follow(axis: AxisView) -> None:
    """Refuse a motion unless the axis is powered; it may still move."""
    check_may_power_on(axis)
    check_enabled(axis)


def check_may_move(axis: AxisView) -> None:
    """Refuse a motion unless the axis is powered and stands still."""
    check_may_follow(axis)
    check_stands(axis)


def check_stands(axis: AxisView) -> None:
    """Refuse while a motion runs: a trapezoid loaded in mid-move is erratic on most drives (PIC-SERVO manual, 4.4)."""
    if axis.state in MOTION_STATES:
        raise WrongState(
            f"axis {axis.name} is in {axis.state}",
            axis=axis.name,
            value=axis.state,
            remedy=Remedy("{} and wait", step("halt")),
        )


def check_referenced(axis: AxisView) -> None:
    """Refuse an absolute position on an axis that is not referenced."""
    if not axis.referenced:
        kept = f"; what was kept of it was refused: {axis.reference_refused}" if axis.reference_refused else ""
        raise NotReferenced(
            f"axis {axis.name} is not referenced: its position means nothing{kept}",
            axis=axis.name,
            remedy=Remedy("{} or {}", step("home"), step("set_position", "set_position")),
        )


def check_position_kept(axis: AxisView) -> None:
    """Refuse to give the position a meaning while the drive says that it has lost it."""
    if axis.position_lost:
        raise WrongState(
            f"axis {axis.name}: its position is lost: {'; '.join(axis.faults)}",
            axis=axis.name,
            remedy=Remedy("{} first", step("reset")),
        )


def check_position(axis: AxisView, limits: AxisLimits, position: float) -> None:
    """Refuse a target outside the software limits, naming the nearest that is inside."""
    if limits.position_min is not None and position < limits.position_min:
        limit, side = limits.position_min, "below"
    elif limits.position_max is not None and position > limits.position_max:
        limit, side = limits.position_max, "above"
    else:
        return
    raise PositionLimit(
        f"axis {axis.name}: target {position:g} {axis.unit} is {side} the limit {limit:g} {axis.unit}",
        axis=axis.name,
        value=position,
        limit=limit,
        nearest=limit,
    )


def check_velocity(axis: AxisView, limits: AxisLimits, velocity: float) -> None:
    """Refuse a speed above the limit."""
    if limits.velocity is not None and abs(velocity) > limits.velocity:
        raise VelocityLimit(
            f"axis {axis.name}: velocity {velocity:g} {axis.unit}/s is above the limit"
            f" {limits.velocity:g} {axis.unit}/s",
            axis=axis.name,
            value=velocity,
            limit=limits.velocity,
            nearest=limits.velocity if velocity > 0 else -limits.velocity,
        )


def check_acceleration(axis: AxisView, limits: AxisLimits, acceleration: float) -> None:
    """Refuse an acceleration above the limit."""
    if limits.acceleration is not None and acceleration > limits.acceleration:
        raise AccelerationLimit(
            f"axis {axis.name}: acceleration {acceleration:g} {axis.unit}/s2 is above the limit"
            f" {limits.acceleration:g} {axis.unit}/s2",
            axis=axis.name,
            value=acceleration,
            limit=limits.acceleration,
            nearest=limits.acceleration,
        )


def no_speed(axis: str) -> WrongState:
    """Return the refusal of a motion while the speed override of the rig is 0."""
    return WrongState(
        f"axis {axis}: the speed override of the rig is 0 %",
        axis=axis,
        value=0.0,
        remedy=Remedy("{} above 0 %", step("set_speed_override", "set the speed override")),
    )


def _faulted(axis: AxisView) -> WrongState:
    causes = "; ".join(axis.faults) or "a command ended badly"
    return WrongState(
        f"axis {axis.name} is in error_stop: {causes}",
        axis=axis.name,
        value=axis.state,
        remedy=Remedy("remove the cause, then {}", step("reset")),
    )
