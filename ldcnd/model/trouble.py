"""Troubles of a line or an axis, in words: the one overview that daemon, console, fleet and command line share.

The console's script says it in the same words (`console/static/parts/problems.js`; a test compares).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import Protocol

from ldcnd.model.health import AxisHealth
from ldcnd.model.samples import AxisState, FaultEntry, LinkState, TelemetryItem

ENOUGH = 0.9
"""Minimum share of the requested rate at which a rate counts as kept."""
EDGE_HZ = 1.0
"""A report is about one second, at whose edges it sees a sample more or less."""


class Severity(IntEnum):
    """The priority of a trouble; the highest is shown first."""

    FINE = 0
    NOTICE = 1
    """It works with a reservation: missed polls, a warning, a latched stop."""
    WRONG = 2
    """It does not work: a fault, a drive or a line that does not answer."""


class Kind(Enum):
    """The kind of a trouble."""

    UNKNOWN = auto()
    STOP_PENDING = auto()
    LINE_DOWN = auto()
    NO_ANSWER = auto()
    FAULT = auto()
    ERROR_STOP = auto()
    STOP_LATCHED = auto()
    WARNING = auto()
    MISSED_POLLS = auto()
    SLOW = auto()


@dataclass(frozen=True, slots=True)
class Trouble:
    """One thing that is wrong.

    Attributes:
        kind: what it is about.
        severity: its priority.
        text: what it is, without a name: the axis or the line goes before it.
    """

    kind: Kind
    severity: Severity
    text: str


class State(Protocol):
    """The known state of an axis: a state sample, or the daemon's own knowledge."""

    @property
    def link(self) -> LinkState:
        """Whether the drive answers."""

    @property
    def state(self) -> AxisState:
        """PLCopen state."""

    @property
    def stop_latched(self) -> bool:
        """A stop is latched."""

    @property
    def stop_pending(self) -> bool:
        """The drive has not confirmed a stop."""

    @property
    def last_error(self) -> str | None:
        """How the last command ended, other than done."""


class Faults(Protocol):
    """The faults of an axis: a fault sample, or the daemon's own knowledge."""

    @property
    def active(self) -> Sequence[FaultEntry]:
        """Those that are active now."""

    @property
    def first(self) -> FaultEntry | None:
        """The one that came first."""


_NOT_CONFIRMED = Trouble(
    Kind.STOP_PENDING,
    Severity.WRONG,
    "a stop is NOT confirmed by the drive: use the machine's emergency stop",
)
_NO_ANSWER = Trouble(Kind.NO_ANSWER, Severity.WRONG, "the drive does not answer")
_NEVER_SEEN = Trouble(Kind.UNKNOWN, Severity.NOTICE, "nothing was received from it yet")
_LATCHED = Trouble(Kind.STOP_LATCHED, Severity.NOTICE, "a stop is latched: nothing moves before reset")
_MISSED_POLLS = Trouble(Kind.MISSED_POLLS, Severity.NOTICE, "the drive missed its latest polls")


def line_troubles(*, up: bool, problem: str = "") -> tuple[Trouble, ...]:
    """Return what is wrong with a line; empty when it is up.

    Args:
        up: whether its drives are polled.
        problem: why it is not up; empty when that is not known.
    """
    text = f"the line is not up: {problem}" if problem else "the line is not up"
    return () if up else (Trouble(Kind.LINE_DOWN, Severity.WRONG, text),)


def axis_troubles(
    state: State | None, faults: Faults | None = None, health: AxisHealth | None = None
) -> tuple[Trouble, ...]:
    """Return what is wrong with an axis, the worst first; empty when nothing is.

    Of an axis that does not answer, nothing else is said but a stop that it has not confirmed: what was known of it may
    be over. How its last command ended is an event, not a state: it is given only where it explains an error stop.

    Args:
        state: its last state; None before the first.
        faults: its last faults; None when they are not known.
        health: its last report; None when there is none.
    """
    if state is None:
        return (_NEVER_SEEN,)
    pending = (_NOT_CONFIRMED,) if state.stop_pending else ()
    if state.link is LinkState.DOWN:
        return (*pending, _NO_ANSWER)
    entries = _first_cause_first(faults) if faults else []
    found = [Trouble(Kind.FAULT, Severity.WRONG, _told(entry)) for entry in entries if entry.stops]
    if state.state is AxisState.ERROR_STOP and not found:
        text = f"in error stop: {state.last_error or 'reset it to go on'}"
        found.append(Trouble(Kind.ERROR_STOP, Severity.WRONG, text))
    if state.stop_latched and not pending:
        found.append(_LATCHED)
    found += [Trouble(Kind.WARNING, Severity.NOTICE, _told(entry)) for entry in entries if not entry.stops]
    if state.link is LinkState.DEGRADED:
        found.append(_MISSED_POLLS)
    elif health:
        found += _slowness(health)
    return (*pending, *found)


def _first_cause_first(faults: Faults) -> list[FaultEntry]:
    first = faults.first.code if faults.first else None
    return sorted(faults.active, key=lambda entry: entry.code != first)


def _told(entry: FaultEntry) -> str:
    return f"{entry.code}: {entry.text}"


def _slowness(health: AxisHealth) -> list[Trouble]:
    """Compare the rate of positions with the configured one."""
    asked = {item.item: item.asked_hz for item in health.items}
    wanted_hz = asked.get(TelemetryItem.POSITION, health.rate_wanted_hz)
    if health.rate_hz + EDGE_HZ >= ENOUGH * wanted_hz:
        return []
    text = f"fewer samples a second than asked for: {health.rate_hz:.1f} of {wanted_hz:.1f}"
    return [Trouble(Kind.SLOW, Severity.NOTICE, text)]
