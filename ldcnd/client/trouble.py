"""What is wrong with an axis, in words: the same for every program that shows one.

The console says it in the same words (`console/static/parts/problems.js`).
"""

from dataclasses import dataclass
from enum import IntEnum

from ldcnd.model.health import AxisHealth
from ldcnd.model.samples import AxisState, FaultEntry, FaultSample, LinkState, StateSample, TelemetryItem

ENOUGH = 0.9
"""A rate counts as kept from this share of the one that is asked for on."""
EDGE_HZ = 1.0
"""A report is about one second, at whose edges it sees a sample more or less."""


class Severity(IntEnum):
    """How much something asks for attention; the highest is shown first."""

    FINE = 0
    NOTICE = 1
    """It works, with a doubt: missed polls, a warning, a latched stop."""
    WRONG = 2
    """It does not work: a fault, a drive or a line that does not answer."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """One thing that is wrong.

    Attributes:
        severity: how much it asks for attention.
        text: what it is.
    """

    severity: Severity
    text: str


STOP_PENDING = "a stop is NOT confirmed by the drive: use the machine's emergency stop"


def axis_troubles(
    state: StateSample | None, fault: FaultSample | None, health: AxisHealth | None
) -> tuple[Trouble, ...]:
    """Return what is wrong with an axis, the worst first; empty when nothing is.

    Of an axis that does not answer, nothing else is said but a stop that it has not confirmed: what was known of it may
    be over. How its last command ended
    is news, not a state, and is told only where it is why the axis is in error stop.

    Args:
        state: its last state; None before the first.
        fault: its last faults; None when they are not known.
        health: its last report; None when there is none.
    """
    if state is None:
        return (Trouble(Severity.NOTICE, "nothing was heard of it yet"),)
    pending = (Trouble(Severity.WRONG, STOP_PENDING),) if state.stop_pending else ()
    if state.link is LinkState.DOWN:
        return (*pending, Trouble(Severity.WRONG, "the drive does not answer"))
    faults = _first_cause_first(fault) if fault else []
    wrong = [_told(entry) for entry in faults if entry.stops]
    failed = state.state is AxisState.ERROR_STOP
    if failed and not wrong:
        wrong.append(f"in error stop: {state.last_error or 'reset it to go on'}")
    latched = state.stop_latched and not pending
    notices = ["a stop is latched: nothing moves before reset"] if latched else []
    notices += [_told(entry) for entry in faults if not entry.stops]
    if state.link is LinkState.DEGRADED:
        notices.append("the drive missed its latest polls")
    elif health:
        notices += _slowness(health)
    return (
        *pending,
        *(Trouble(Severity.WRONG, text) for text in wrong),
        *(Trouble(Severity.NOTICE, text) for text in notices),
    )


def _first_cause_first(fault: FaultSample) -> list[FaultEntry]:
    first = fault.first.code if fault.first else None
    return sorted(fault.active, key=lambda entry: entry.code != first)


def _told(entry: FaultEntry) -> str:
    return f"{entry.code}: {entry.text}"


def _slowness(health: AxisHealth) -> list[str]:
    """Compare with what the drive is asked for."""
    asked = {item.item: item.asked_hz for item in health.items}
    wanted_hz = asked.get(TelemetryItem.POSITION, health.rate_wanted_hz)
    if health.rate_hz + EDGE_HZ >= ENOUGH * wanted_hz:
        return []
    return [f"fewer samples a second than asked for: {health.rate_hz:.1f} of {wanted_hz:.1f}"]
