"""The condition of an axis, a line or an I/O module: all that is to be said of it, in words.

Every face shows what this module decides: command line, console, gateways, metrics, notebooks. None has a rule or a
sentence of its own; the console's pages get the result from the console's server.
"""

import datetime as dt
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, IntEnum, StrEnum, auto
from typing import Protocol

from ldcnd.contract.errors import Remedy, step
from ldcnd.contract.health import AxisHealth, CertificateHealth, DaemonHealth, ModuleHealth
from ldcnd.contract.samples import (
    UNKNOWN_HOLDER,
    AxisState,
    CurrentCommand,
    FaultEntry,
    LinkState,
    Moving,
    PastFault,
    Quality,
    TelemetryItem,
    Unseen,
)

ENOUGH = 0.9
"""Minimum share of the requested rate at which a rate counts as kept."""
EDGE_HZ = 1.0
"""A report is about one second, at whose edges it sees a sample more or less."""
OLD_S = 1.5
"""Age from which a position is old, seconds, besides `OLD_PERIODS`."""
MISSED_S = 0.2
"""The same while its drive misses polls: of one that has lost power in motion the last place is soon not its own."""
OLD_PERIODS = 4
"""Periods of a position's rate that may pass besides: a poll may be lost or late."""
MISSED_PERIODS = 2
"""The same while its drive misses polls: one is known to be lost."""
SILENT_S = 3.0
"""Time without anything from a daemon after which nothing that it said counts as known, seconds; each axis gives a sign
of life every second. The same in each face."""
SOON_DAYS = 30
"""Time before the end of a certificate from which it is said, days: most plants have a day of maintenance each month,
and a new certificate wants a restart."""
FULL_SPEED = 100.0
"""Speed override at which nothing is slowed, percent."""


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


class Place(StrEnum):
    """Whether the position of an axis says where it is."""

    KNOWN = "known"
    NOT_HOMED = "not_homed"
    """It was never homed, or has lost its reference: the number says by how much it moved at best."""
    OLD = "old"
    """Nothing newer came."""
    NOT_ANSWERING = "not_answering"
    """The drive, its line or its daemon does not answer, or something else answers in its place."""
    CONTRADICTED = "contradicted"
    """The drive answers, and its readings cannot be true."""


class Alarm(IntEnum):
    """Severity of a condition, as alarm systems count it."""

    NONE = 0
    MINOR = 1
    MAJOR = 2
    INVALID = 3
    """The values are not to be believed."""


@dataclass(frozen=True, slots=True)
class Condition:
    """The condition of an axis.

    Attributes:
        place: whether its position says where it is.
        mark: what goes beside the number where it does not, in a few words; empty where it does.
        state: the state in words, for people.
        live: state and velocity are to be believed.
        moves: a motion is under way, as far as that was seen last.
        alarm: how bad it is.
        troubles: everything that is to be said, the worst first.
        holder: the client in control; None without one, `UNKNOWN_HOLDER` where that is not known.
        control: the same in words; empty where that is not known.
    """

    place: Place
    mark: str
    state: str
    live: bool
    alarm: Alarm
    troubles: tuple["Trouble", ...]
    holder: str | None = UNKNOWN_HOLDER
    control: str = ""
    moves: bool = False

    @property
    def notes(self) -> tuple[str, ...]:
        """Everything that is to be said, in a few words each, and who controls the axis."""
        return tuple(filter(None, (*(trouble.short for trouble in self.troubles), self.control)))

    @property
    def summary(self) -> str:
        """The state and everything that is to be said besides, in one line."""
        return ", ".join(dict.fromkeys((self.state, *(trouble.short for trouble in self.troubles))))

    @property
    def in_full(self) -> str:
        """The same and who controls the axis."""
        return ", ".join(dict.fromkeys((self.state, *self.notes)))

    @property
    def wrong(self) -> tuple["Trouble", ...]:
        """What deserves attention."""
        return tuple(trouble for trouble in self.troubles if trouble.severity is not Severity.FINE)

    def position(self, number: str | None, unit: str, age_s: float | None = None) -> str:
        """Return a position for people: in brackets and with its mark where it does not say where the axis is.

        Args:
            number: its digits; None before the first position.
            unit: the axis unit.
            age_s: its age, which is named where it matters; None when it is not known.
        """
        if number is None:
            return f"? {self.mark}".rstrip()
        if self.place is Place.KNOWN:
            return f"{number} {unit}"
        age = f", {age_s:.0f} s old" if age_s is not None and self.place in _AGED else ""
        return f"({number}) {unit} {self.mark}{age}"


_AGED = frozenset({Place.OLD, Place.NOT_ANSWERING, Place.CONTRADICTED})


class KnownState(Protocol):
    """The known state of an axis: a state sample, or the daemon's own knowledge."""

    @property
    def quality(self) -> Quality:
        """How much its values are worth."""

    @property
    def link(self) -> LinkState:
        """Whether the drive answers."""

    @property
    def was_read(self) -> bool:
        """Its drive was read since its daemon began."""

    @property
    def state(self) -> AxisState:
        """PLCopen state."""

    @property
    def moving(self) -> Moving:
        """Whether it moves."""

    @property
    def motion_hidden_by(self) -> str:
        """The fault behind which readings do not prove that it stands; empty without one."""

    @property
    def unseen(self) -> Unseen | None:
        """Why it may turn though its encoder does not count."""

    @property
    def has_reference(self) -> bool:
        """Whether it can be referenced at all."""

    @property
    def referenced(self) -> bool:
        """The position is valid."""

    @property
    def reference_lost(self) -> bool:
        """It was, and is not any more."""

    @property
    def stop_latched(self) -> bool:
        """A stop is latched."""

    @property
    def stop_pending(self) -> bool:
        """The drive has not confirmed a stop."""

    @property
    def command(self) -> "CurrentCommand | object | None":
        """The command under way."""

    @property
    def last_error(self) -> str | None:
        """How the last command ended, other than done."""

    @property
    def interlock(self) -> str:
        """The interlock that has ended it and what that lacks; empty where none has."""

    @property
    def speed_override(self) -> float:
        """Percent of every velocity."""

    @property
    def holder(self) -> str | None:
        """The client in control; None without one, `UNKNOWN_HOLDER` where that is not known."""


class Faults(Protocol):
    """The faults of an axis: a fault sample, or the daemon's own knowledge."""

    @property
    def active(self) -> Sequence[FaultEntry]:
        """Those that are active now."""

    @property
    def first(self) -> FaultEntry | None:
        """The one that came first."""


_DAY_NS = 86_400 * 10**9
_FLOATS, _NO_DATA, _DAEMON_SILENT, _POSITION_LOST = "outputs float", "no data", "daemon silent", "position lost"
_BY_INTERLOCK, _ERROR_STOP, _OVERRIDE, _SLOW = "ended by interlock", "error stop", "speed override", "slow"
_WRONG, _NOTICE, _FINE = Severity.WRONG, Severity.NOTICE, Severity.FINE
_NOT_CONFIRMED = Trouble(
    TroubleKind.STOP_PENDING,
    _WRONG,
    "a stop is NOT confirmed by the drive: use the machine's emergency stop",
    "stop NOT CONFIRMED by the drive",
)
_NO_ANSWER = Trouble(TroubleKind.NO_ANSWER, _WRONG, "the drive does not answer", "no answer")
_ON_DEAD_LINE = Trouble(TroubleKind.LINE_DOWN, _WRONG, "the line is not up", "line down")
_OPENING = Trouble(TroubleKind.UNKNOWN, _NOTICE, "its daemon has just begun to open its line", "line is being opened")
_NOT_IDENTIFIED = Trouble(
    TroubleKind.NOT_IDENTIFIED,
    _WRONG,
    "what answers is not known to be its drive: only what stops it is sent",
    "not identified",
)
_NEVER_SEEN = Trouble(TroubleKind.UNKNOWN, _NOTICE, "nothing was received from it yet", "nothing received")
_OLD = Trouble(TroubleKind.OLD, _WRONG, "its position is old: nothing newer came", "old")
_REFERENCE_LOST = Trouble(
    TroubleKind.REFERENCE_LOST,
    _WRONG,
    "has lost its reference: its position is not known before it is homed",
    "reference lost",
)
_NOT_HOMED = Trouble(TroubleKind.NOT_HOMED, _NOTICE, "not homed: its position is not known", "not homed")
_HOMING = Trouble(TroubleKind.NOT_HOMED, _NOTICE, "it is being homed: its position is not known yet", "homing")
_LATCHED = Trouble(TroubleKind.STOP_LATCHED, _NOTICE, "a stop is latched: nothing moves before reset", "stop latched")
_LATCHED_UNREAD = replace(_LATCHED, text="a stop is latched; the drive was not read yet")
_MAY_MOVE = Trouble(
    TroubleKind.HIDDEN,
    _WRONG,
    "it may move: readings do not prove that it stands, because shaft and encoder did not go where they were sent;"
    " switch its motor off, look at the machine, then reset it",
    "may move",
)
_UNSEEN = {
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
_UNCOMMANDED = Trouble(
    TroubleKind.UNCOMMANDED,
    _WRONG,
    "moves, and was started by no client that is connected: halt it, or take control of it",
    "moves without a command",
)
_PUSHED = Trouble(TroubleKind.UNCOMMANDED, _NOTICE, "it moves, and no command is under way", "moves without a command")
_COASTS = Trouble(
    TroubleKind.UNCOMMANDED, _NOTICE, "its motor is off, and it moves: it coasts, or is pushed", "moves with motor off"
)
_OVERRIDE_ZERO = Trouble(
    TroubleKind.STANDS_BY_OVERRIDE, _NOTICE, "the speed override is 0 %: no command moves it", f"{_OVERRIDE} 0 %"
)
_MISSED_POLLS = Trouble(TroubleKind.MISSED_POLLS, _NOTICE, "the drive missed its latest polls", "missed polls")
_MODULE_SILENT = replace(_NO_ANSWER, text="the module does not answer; check its power and the line")
_MODULE_MISSES = replace(_MISSED_POLLS, text="the module missed its latest polls")
OWN = frozenset({TroubleKind.STOP_PENDING, TroubleKind.STOP_LATCHED})
"""Troubles that the daemon itself knows of: what becomes of a line or a drive changes nothing about them."""
SHARED = frozenset({TroubleKind.SILENCE, TroubleKind.NOT_HOMED, TroubleKind.STANDS_BY_OVERRIDE})
"""Troubles of which several axes have one cause, or which are said once for all; so is a line that is down."""
TELL_OF_THE_PAST = frozenset({"loop_opened"})
"""Faults that say what has happened and are seen in one reading only; the others say what is so while they stand."""
_COUNTER_SET = "drive_reset"
"""The fault whose name says best why the position is lost, where no fault hides motion."""
PAGES: Mapping[str, str] = {
    _NOT_CONFIRMED.short: "stop_unconfirmed",
    **dict.fromkeys((_NO_ANSWER.short, _MISSED_POLLS.short, Place.NOT_ANSWERING.value, _FLOATS), "link_lost"),
    **dict.fromkeys((_ON_DEAD_LINE.short, _OPENING.short), "bus_down"),
    **dict.fromkeys((_NEVER_SEEN.short, _NO_DATA, _DAEMON_SILENT, _OLD.short), "session_failed"),
    **dict.fromkeys((_NOT_HOMED.short, _REFERENCE_LOST.short, _HOMING.short), "not_referenced"),
    **dict.fromkeys((_POSITION_LOST, Place.CONTRADICTED.value), "readings_contradict"),
    **dict.fromkeys((_ERROR_STOP, _OVERRIDE), "wrong_state"),
    **dict.fromkeys((_UNCOMMANDED.short, _COASTS.short), "drive_changed"),
    _MAY_MOVE.short: "position_error",
    **{each.short: "stood_at_once" for each in _UNSEEN.values()},
    _BY_INTERLOCK: "interlock_violated",
    _SLOW: "bus_busy",
}
"""The code of the page that explains what a face says in a few words; other words are those of a code."""
_DRIVEN = frozenset(each for each in AxisState if each.is_motion) - {AxisState.STOPPING}


def explained_as(said: str) -> str:
    """Return the code whose page explains what a face says, however its words are written; others stay as they are."""
    code = re.sub("[^a-z0-9]+", "_", said.lower()).strip("_")
    # a word may have a value behind it: "speed override 30 %"
    pages = (page for words, page in PAGES.items() if f"{code}_".startswith(f"{words.lower().replace(' ', '_')}_"))
    return next(pages, code)


def line_troubles(*, up: bool, problem: str = "") -> tuple[Trouble, ...]:
    """Return what is wrong with a line; empty when it is up.

    Args:
        up: whether its drives are polled.
        problem: why it is not up; empty when that is not known.
    """
    text = f"{_ON_DEAD_LINE.text}: {problem}" if problem else _ON_DEAD_LINE.text
    return () if up else (Trouble(TroubleKind.LINE_DOWN, _WRONG, text, _ON_DEAD_LINE.short),)


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


def assess_module(health: ModuleHealth, *, line_up: bool = True, silence: str = "") -> Condition:
    """Return the condition of an I/O module.

    Args:
        health: its last report.
        line_up: its line is up.
        silence: why nothing comes from its daemon; empty while it reports.
    """
    gone = _silent(silence) if silence else None if line_up else _ON_DEAD_LINE
    if gone is None and health.link is LinkState.DOWN:
        gone = _MODULE_SILENT
    if gone:
        return _unanswered("unknown", (gone,), gone.short)
    troubles = [_MODULE_MISSES] if health.link is LinkState.DEGRADED else []
    if health.floating:
        text = f"{', '.join(health.floating)}: was set before the module lost its power, and floats until it is set"
        troubles.append(Trouble(TroubleKind.FLOATING, _NOTICE, text, _FLOATS))
    alarm = Alarm(max((trouble.severity for trouble in troubles), default=_FINE))
    return Condition(Place.KNOWN, "", "answers", live=True, alarm=alarm, troubles=tuple(troubles))


def way_to_rest(state: AxisState) -> Remedy:
    """Return how an axis that moves comes to rest: one that does so by itself is waited for.

    A search for the reference that is halted leaves no reference, and would have to begin anew.
    """
    if state is AxisState.HOMING:
        return Remedy("wait until it is homed")
    return Remedy("wait until it stands") if state is AxisState.STOPPING else Remedy("{} and wait", step("halt"))


def is_over(fault: PastFault, active: Collection[FaultEntry], link: LinkState) -> bool:
    """Tell whether a fault is seen to stand no more: its axis is read, and does not show it."""
    stands = any(each.code == fault.code for each in active)
    return link is LinkState.UP and not stands and fault.code not in TELL_OF_THE_PAST


def over_in_words(fault: PastFault) -> str:
    """Return a fault that stands no more in words: its text says what is so while it stands."""
    return f"{_words(fault.code)}, which is over"


def assess(
    state: KnownState | None,
    faults: Faults | None = None,
    health: AxisHealth | None = None,
    *,
    age_s: float | None = None,
    line_up: bool | None = True,
    silence: str = "",
) -> Condition:
    """Return the condition of an axis.

    Of an axis that does not answer nothing else is said but a stop: what was known of its drive may be over, and a
    latch is its daemon's. How its last command ended is an event, not a state: it is given only where it explains an
    error stop, or where an interlock ended it.

    Args:
        state: its last state; None before the first.
        faults: its last faults; None when they are not known.
        health: its last report; None when there is none.
        age_s: age of its position, seconds; None where the face cannot tell.
        line_up: its line is up, as far as the face knows; None while its daemon has not reported about it.
        silence: why nothing comes from its daemon; empty while it reports.
    """
    if state is None:
        dead = _OPENING if line_up is None else _ON_DEAD_LINE
        lost = (_silent(silence),) if silence else () if line_up else (dead,)
        return _unanswered("unknown", lost or (_NEVER_SEEN,), lost[0].short if lost else _NO_DATA)
    word, last = state.state.words, _last_known(state)
    holder = UNKNOWN_HOLDER if silence else state.holder
    control = _control(holder, moves=state.moving is Moving.YES and state.command is not None)
    gone = _unreachable(state, faults, silence=silence, line_up=line_up)
    pending = (_NOT_CONFIRMED,) if state.stop_pending else ()
    if gone:
        known = _LATCHED if state.was_read else _LATCHED_UNREAD
        latched = (known,) if state.stop_latched and not state.stop_pending and not silence else ()
        silent = _unanswered(last, (*pending, gone, *latched), gone.short)
        return replace(silent, holder=holder, control=control, moves=state.state.is_motion)
    place, mark = _place(state, faults, is_old=_is_old(state, age_s, health))
    troubles = (*pending, *_found(state, faults, health, place), *_overridden(health), *_slowed(state))
    worst = max((trouble.severity for trouble in troubles), default=_FINE)
    alarm = Alarm.INVALID if place in _AGED else Alarm(worst)
    live = place is not Place.OLD
    return Condition(place, mark, word if live else last, live, alarm, troubles, holder, control, state.state.is_motion)


def _last_known(state: KnownState) -> str:
    """Return the state of an axis that does not answer, in words."""
    if not state.was_read:
        return "unknown"
    if state.link is LinkState.DOWN and state.state is AxisState.ERROR_STOP:  # that only says that it is lost
        return "unknown, may move"
    return f"unknown, was {state.state.words}"


def _unanswered(state: str, troubles: tuple[Trouble, ...], mark: str) -> Condition:
    return Condition(Place.NOT_ANSWERING, mark, state, live=False, alarm=Alarm.INVALID, troubles=troubles)


def _silent(why: str) -> Trouble:
    return Trouble(TroubleKind.SILENCE, _WRONG, why, _DAEMON_SILENT)


def _unreachable(state: KnownState, faults: Faults | None, *, silence: str, line_up: bool | None) -> Trouble | None:
    """Return why nothing is known of an axis; None when it answers."""
    if silence:
        return _silent(silence)
    if faults and any(fault.code == "not_identified" for fault in faults.active):
        return _NOT_IDENTIFIED
    if state.link is not LinkState.DOWN:
        return None  # a report on its line may be a second older than this
    if line_up is False:
        return _ON_DEAD_LINE
    lost = next((fault for fault in faults.active if fault.code == "link_lost"), None) if faults else None
    if lost:
        return replace(_NO_ANSWER, text=lost.text)
    return _OPENING if line_up is None and not state.was_read else _NO_ANSWER


def _is_old(state: KnownState, age_s: float | None, health: AxisHealth | None) -> bool:
    rate_hz = (health.rate_wanted_hz if health else 0.0) or 1.0
    missed = state.link is LinkState.DEGRADED
    longest_s = MISSED_S + MISSED_PERIODS / rate_hz if missed else OLD_S + OLD_PERIODS / rate_hz
    return age_s is not None and age_s > longest_s


def _place(state: KnownState, faults: Faults | None, *, is_old: bool) -> tuple[Place, str]:
    """Return whether the position of an axis that answers says where it is, and its mark."""
    if state.link is LinkState.UP and state.quality is Quality.UNCERTAIN:
        was_set = faults is not None and any(fault.code == _COUNTER_SET for fault in faults.active)
        cause = state.motion_hidden_by or (_COUNTER_SET if was_set else _POSITION_LOST)
        return Place.CONTRADICTED, _words(cause)
    if is_old:
        return Place.OLD, _OLD.short
    if state.referenced or not state.has_reference:
        return Place.KNOWN, ""
    if state.state is AxisState.HOMING:
        return Place.NOT_HOMED, _HOMING.short
    return Place.NOT_HOMED, _REFERENCE_LOST.short if state.reference_lost else _NOT_HOMED.short


def _found(state: KnownState, faults: Faults | None, health: AxisHealth | None, place: Place) -> tuple[Trouble, ...]:
    """Return what deserves attention on an axis that answers."""
    entries = _first_cause_first(faults) if faults else []
    found = [_of_fault(entry, TroubleKind.FAULT, _WRONG) for entry in entries if entry.stops]
    found += _ended(state, faults, in_fault=bool(found))
    if state.motion_hidden_by and state.moving is Moving.UNKNOWN:
        found.append(_MAY_MOVE)
    elif state.unseen and state.moving is Moving.UNKNOWN:
        found.append(_UNSEEN[state.unseen])
    if place is Place.OLD:
        found.append(_OLD)
    if state.has_reference and not state.referenced and place is not Place.CONTRADICTED:  # that is its cause
        lost = _REFERENCE_LOST if state.reference_lost else _NOT_HOMED
        found.append(_HOMING if state.state is AxisState.HOMING else lost)
    if state.stop_latched and not state.stop_pending:
        found.append(_LATCHED)
    if state.moving is Moving.YES and state.command is None:
        if state.state not in _DRIVEN:
            found.append(_COASTS if state.state is AxisState.DISABLED else _PUSHED)
        elif state.has_reference:  # without: a drive that takes no motion over its line; others move it
            found.append(_UNCOMMANDED)
    if not state.speed_override and state.has_reference:  # as above
        found.append(_OVERRIDE_ZERO)
    found += [_of_fault(entry, TroubleKind.WARNING, _NOTICE) for entry in entries if not entry.stops]
    if state.link is LinkState.DEGRADED:
        found.append(_MISSED_POLLS)
    elif health:
        found += _slowness(health)
    return tuple(sorted(found, key=lambda trouble: -trouble.severity))


def _ended(state: KnownState, faults: Faults | None, *, in_fault: bool) -> tuple[Trouble, ...]:
    """Return how a motion ended that leaves an axis in error stop, or that an interlock has ended."""
    if state.state is not AxisState.ERROR_STOP:
        text = f"its motion was ended by interlock {state.interlock}"
        return (Trouble(TroubleKind.INTERLOCK, _NOTICE, text, _BY_INTERLOCK),) if state.interlock else ()
    if in_fault:
        return ()
    first = faults.first if faults else None
    if faults and first and first.stops and is_over(first, faults.active, state.link):
        text = f"in error stop because of {over_in_words(first)}: reset it to go on"
    else:
        text = f"in error stop: {state.last_error or 'reset it to go on'}"
    return (Trouble(TroubleKind.ERROR_STOP, _WRONG, text, _ERROR_STOP),)


def _overridden(health: AxisHealth | None) -> tuple[Trouble, ...]:
    """Return the rules that do not bind at present."""
    texts = health.overrides if health else ()
    return tuple(Trouble(TroubleKind.OVERRIDDEN, _NOTICE, text, text) for text in texts)


def _slowed(state: KnownState) -> tuple[Trouble, ...]:
    """Return what is to be known and is not wrong."""
    if not (state.has_reference and 0 < state.speed_override < FULL_SPEED):
        return ()
    short = f"{_OVERRIDE} {state.speed_override:g} %"
    return (Trouble(TroubleKind.SLOWED, _FINE, f"{short} of every velocity", short),)


def _control(holder: str | None, *, moves: bool) -> str:
    if holder is None:
        return "not controlled"
    return f"{'moved' if moves else 'controlled'} by {holder}" if holder else ""


def _first_cause_first(faults: Faults) -> list[FaultEntry]:
    first = faults.first.code if faults.first else None
    return sorted(faults.active, key=lambda entry: entry.code != first)


def _of_fault(entry: FaultEntry, kind: TroubleKind, severity: Severity) -> Trouble:
    return Trouble(kind, severity, f"{entry.code}: {entry.text}", _words(entry.code))


def _words(code: str) -> str:
    return code.replace("_", " ")


def _slowness(health: AxisHealth) -> list[Trouble]:
    """Compare the rate of positions with the configured one."""
    asked = {item.item: item.asked_hz for item in health.items}
    wanted_hz = asked.get(TelemetryItem.POSITION, health.rate_wanted_hz)
    if health.rate_hz + EDGE_HZ >= ENOUGH * wanted_hz:
        return []
    text = f"fewer samples a second than asked for: {health.rate_hz:.1f} of {wanted_hz:.1f}"
    return [Trouble(TroubleKind.SLOW, _NOTICE, text, _SLOW)]
