"""What can be wrong with an axis, a line, a module or a daemon: each sentence of it stands here, once.

Which of them hold is for `condition` to decide; a face shows them as they are.
"""

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum, IntEnum, auto

from ldcnd.contract.health import CertificateHealth, DaemonHealth
from ldcnd.contract.samples import Unseen

SOON_DAYS = 30
"""Time before the end of a certificate from which it is said, days: most plants have a day of maintenance each month,
and a new certificate wants a restart."""


class Severity(IntEnum):
    """The priority of a trouble; the highest is shown first."""

    FINE = 0
    NOTICE = 1
    """It works with a reservation: missed polls, a warning, a latched stop."""
    WRONG = 2
    """It does not work: a fault, a drive or a line that does not answer."""


class TroubleKind(Enum):
    """The kind of a trouble."""

    UNKNOWN = auto()
    STOP_PENDING = auto()
    SILENCE = auto()
    LINE_DOWN = auto()
    NO_ANSWER = auto()
    NOT_IDENTIFIED = auto()
    FAULT = auto()
    ERROR_STOP = auto()
    HIDDEN = auto()
    OLD = auto()
    REFERENCE_LOST = auto()
    NOT_HOMED = auto()
    STOP_LATCHED = auto()
    UNCOMMANDED = auto()
    STANDS_BY_OVERRIDE = auto()
    WARNING = auto()
    MISSED_POLLS = auto()
    SLOW = auto()
    INTERLOCK = auto()
    OVERRIDDEN = auto()
    FLOATING = auto()
    SLOWED = auto()


@dataclass(frozen=True, slots=True)
class Trouble:
    """One thing that is to be said.

    Attributes:
        kind: what it is about.
        severity: its priority.
        text: what it is, without a name: the axis or the line goes before it.
        short: the same in a few words, for a cell of a table.
    """

    kind: TroubleKind
    severity: Severity
    text: str
    short: str


_DAY_NS = 86_400 * 10**9
FLOATS, NO_DATA, DAEMON_SILENT, POSITION_LOST = "outputs float", "no data", "daemon silent", "position lost"
BY_INTERLOCK, ERROR_STOP, OVERRIDE, SLOW = "ended by interlock", "error stop", "speed override", "slow"
_WRONG, _NOTICE = Severity.WRONG, Severity.NOTICE
NOT_CONFIRMED = Trouble(
    TroubleKind.STOP_PENDING,
    _WRONG,
    "a stop is NOT confirmed by the drive: use the machine's emergency stop",
    "stop NOT CONFIRMED by the drive",
)
NO_ANSWER = Trouble(TroubleKind.NO_ANSWER, _WRONG, "the drive does not answer", "no answer")
ON_DEAD_LINE = Trouble(TroubleKind.LINE_DOWN, _WRONG, "the line is not up", "line down")
OPENING = Trouble(TroubleKind.UNKNOWN, _NOTICE, "its daemon has just begun to open its line", "line is being opened")
NOT_IDENTIFIED = Trouble(
    TroubleKind.NOT_IDENTIFIED,
    _WRONG,
    "what answers is not known to be its drive: only what stops it is sent",
    "not identified",
)
NEVER_SEEN = Trouble(TroubleKind.UNKNOWN, _NOTICE, "nothing was received from it yet", "nothing received")
OLD = Trouble(TroubleKind.OLD, _WRONG, "its position is old: nothing newer came", "old")
UNCERTAIN = Trouble(
    TroubleKind.OLD,
    _NOTICE,
    "its position is uncertain: it was not read again since a poll was missed, or it was corrected",
    "uncertain",
)
REFERENCE_LOST = Trouble(
    TroubleKind.REFERENCE_LOST,
    _WRONG,
    "has lost its reference: its position is not known before it is homed",
    "reference lost",
)
NOT_HOMED = Trouble(TroubleKind.NOT_HOMED, _NOTICE, "not homed: its position is not known", "not homed")
HOMING = Trouble(TroubleKind.NOT_HOMED, _NOTICE, "it is being homed: its position is not known yet", "homing")
LATCHED = Trouble(TroubleKind.STOP_LATCHED, _NOTICE, "a stop is latched: nothing moves before reset", "stop latched")
LATCHED_UNREAD = replace(LATCHED, text="a stop is latched; the drive was not read yet")
MAY_MOVE = Trouble(
    TroubleKind.HIDDEN,
    _WRONG,
    "it may move: readings do not prove that it stands, because shaft and encoder did not go where they were sent;"
    " switch its motor off, look at the machine, then reset it",
    "may move",
)
UNSEEN = {
    Unseen.MOTOR_OFF: Trouble(
        TroubleKind.HIDDEN,
        _NOTICE,
        "it may coast: nothing has shown yet that its encoder counts; it stands once it has not for four times its"
        " coast_s, or when it is homed",
        "may coast",
    ),
    Unseen.LEFT_TURNING: Trouble(
        TroubleKind.HIDDEN,
        _WRONG,
        "it may coast: it turned when it was read last, and its encoder has not counted since; it stands once it has"
        " not for four times its coast_s",
        "may coast",
    ),
    Unseen.UNDER_POWER: Trouble(
        TroubleKind.HIDDEN,
        _NOTICE,
        "it may turn: it was taken over, and its encoder has not counted in a motion of this daemon yet; home it, or"
        " switch its motor off and wait until it stands",
        "may turn",
    ),
}
UNCOMMANDED = Trouble(
    TroubleKind.UNCOMMANDED,
    _WRONG,
    "moves, and was started by no client that is connected: halt it, or take control of it",
    "moves without a command",
)
PUSHED = Trouble(TroubleKind.UNCOMMANDED, _NOTICE, "it moves, and no command is under way", "moves without a command")
COASTS = Trouble(
    TroubleKind.UNCOMMANDED, _NOTICE, "its motor is off, and it moves: it coasts, or is pushed", "moves with motor off"
)
OVERRIDE_ZERO = Trouble(
    TroubleKind.STANDS_BY_OVERRIDE, _NOTICE, "the speed override is 0 %: no command moves it", f"{OVERRIDE} 0 %"
)
MISSED_POLLS = Trouble(TroubleKind.MISSED_POLLS, _NOTICE, "the drive missed its latest polls", "missed polls")
MODULE_SILENT = replace(NO_ANSWER, text="the module does not answer; check its power and the line")
MODULE_MISSES = replace(MISSED_POLLS, text="the module missed its latest polls")
OWN = frozenset({TroubleKind.STOP_PENDING, TroubleKind.STOP_LATCHED})
"""Troubles that the daemon itself knows of: what becomes of a line or a drive changes nothing about them."""
SHARED = frozenset({TroubleKind.SILENCE, TroubleKind.NOT_HOMED, TroubleKind.STANDS_BY_OVERRIDE})
"""Troubles of which several axes have one cause, or which are said once for all; so is a line that is down."""
TELL_OF_THE_PAST = frozenset({"loop_opened"})
"""Faults that say what has happened and are seen in one reading only; the others say what is so while they stand."""
COUNTER_SET = "drive_reset"
"""The fault whose name says best why the position is lost, where no fault hides motion."""


def line_troubles(*, up: bool, problem: str = "") -> tuple[Trouble, ...]:
    """Return what is wrong with a line; empty when it is up.

    Args:
        up: whether its drives are polled.
        problem: why it is not up; empty when that is not known.
    """
    text = f"{ON_DEAD_LINE.text}: {problem}" if problem else ON_DEAD_LINE.text
    return () if up else (Trouble(TroubleKind.LINE_DOWN, _WRONG, text, ON_DEAD_LINE.short),)


def daemon_troubles(health: DaemonHealth | None) -> tuple[str, ...]:
    """Return in words what is to be seen to of a daemon itself; empty where that is nothing, or nothing is known."""
    if health is None:
        return ()
    return (*disk_troubles(health.not_kept), *certificate_troubles(health.certificate, health.t))


def disk_troubles(not_kept: Sequence[str]) -> tuple[str, ...]:
    """Return in words what is wrong with the state directory of a daemon; empty while all of it can be written.

    Args:
        not_kept: the files that cannot be written, each with the reason, as in a `DaemonHealth`.
    """
    if not not_kept:
        return ()
    more = f", and {len(not_kept) - 1} more" if len(not_kept) > 1 else ""
    return (f"not kept over a restart, {not_kept[0]}{more}: make room in state_dir, or mend its disk",)


def certificate_soon_ns(certificate: CertificateHealth) -> int:
    """Return from when on the end of a certificate is to be spoken of, UTC in ns since 1970."""
    return certificate.ends - SOON_DAYS * _DAY_NS


def certificate_troubles(certificate: CertificateHealth | None, t: int, remedy: str | None = None) -> tuple[str, ...]:
    """Return in words that a certificate ends soon or has ended, and what to do; empty while neither is so.

    Args:
        certificate: the one in use, as in a `DaemonHealth`; None where there is none.
        t: the present, UTC in ns since 1970, by the clock of the program that uses it.
        remedy: what to do, where the certificate is none that `ldcnd pki` makes.
    """
    if certificate is None or t < certificate_soon_ns(certificate):
        return ()
    whose = "the authority" if certificate.authority else "the certificate of"
    if remedy is None:
        remedy = (
            "`ldcnd pki init` begins a new site, whose logins replace all of this one"
            if certificate.authority
            else f"`ldcnd pki renew SITE {certificate.name}`, put its file in place, and restart what uses it"
        )
    ended = t >= certificate.ends
    consequence = ", and what connects anew is refused" if ended else ""
    return (f"{whose} {certificate.name} {certificate_end(certificate, t)}{consequence}: {remedy}",)


def certificate_end(certificate: CertificateHealth, t: int) -> str:
    """Return in words until when a certificate is good, seen from an instant, UTC in ns since 1970."""
    end = dt.datetime.fromtimestamp(certificate.ends // 10**9, dt.UTC).strftime("%Y-%m-%d %H:%M UTC")
    if t >= certificate.ends:
        return f"has ended on {end}"
    days = -((t - certificate.ends) // _DAY_NS)  # one that has begun counts
    return f"ends on {end}, within {f'{days} days' if days > 1 else 'a day'}"
