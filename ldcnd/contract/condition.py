"""The condition of an axis, a line or an I/O module: all that is to be said of it, in words.

Every face shows what this module decides: command line, console, gateways, metrics, notebooks. None has a rule or a
sentence of its own; the console's pages get the result from the console's server.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum, StrEnum
from typing import Protocol

from ldcnd.contract.errors import Remedy, step
from ldcnd.contract.health import AxisHealth, ModuleHealth
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
from ldcnd.contract.troubles import (
    BY_INTERLOCK,
    COASTS,
    COUNTER_SET,
    DAEMON_SILENT,
    ERROR_STOP,
    FLOATS,
    HOMING,
    LATCHED,
    LATCHED_UNREAD,
    MAY_MOVE,
    MISSED_POLLS,
    MODULE_MISSES,
    MODULE_SILENT,
    NEVER_SEEN,
    NO_ANSWER,
    NO_DATA,
    NOT_CONFIRMED,
    NOT_HOMED,
    NOT_IDENTIFIED,
    OLD,
    ON_DEAD_LINE,
    OPENING,
    OVERRIDE,
    OVERRIDE_ZERO,
    POSITION_LOST,
    PUSHED,
    REFERENCE_LOST,
    SLOW,
    TELL_OF_THE_PAST,
    UNCERTAIN,
    UNCOMMANDED,
    UNSEEN,
    Severity,
    Trouble,
    TroubleKind,
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
UNKNOWN_HZ = 1.0
"""Stands for the rate of positions of which nothing is known yet, or which come only when something else is read."""
SILENT_S = 3.0
"""Time without anything from a daemon after which nothing that it said counts as known, seconds; it reports on itself
every second, whatever the rates of its axes. The same in each face."""
FULL_SPEED = 100.0
"""Speed override at which nothing is slowed, percent."""


class Place(StrEnum):
    """Whether the position of an axis says where it is."""

    KNOWN = "known"
    NOT_HOMED = "not_homed"
    """It was never homed, or has lost its reference: the number says by how much it moved at best."""
    OLD = "old"
    """Nothing newer came."""
    UNCERTAIN = "uncertain"
    """It was not read again since a poll was missed, or was read as another one and corrected."""
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
_UNSURE = {Place.OLD: OLD, Place.UNCERTAIN: UNCERTAIN}


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
    def enabled(self) -> bool:
        """Its position loop is closed."""

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


PAGES: Mapping[str, str] = {
    NOT_CONFIRMED.short: "stop_unconfirmed",
    **dict.fromkeys(
        (NO_ANSWER.short, MISSED_POLLS.short, UNCERTAIN.short, Place.NOT_ANSWERING.value, FLOATS), "link_lost"
    ),
    **dict.fromkeys((ON_DEAD_LINE.short, OPENING.short), "bus_down"),
    **dict.fromkeys((NEVER_SEEN.short, NO_DATA, DAEMON_SILENT, OLD.short), "session_failed"),
    **dict.fromkeys((NOT_HOMED.short, REFERENCE_LOST.short, HOMING.short), "not_referenced"),
    **dict.fromkeys((POSITION_LOST, Place.CONTRADICTED.value), "readings_contradict"),
    **dict.fromkeys((ERROR_STOP, OVERRIDE), "wrong_state"),
    **dict.fromkeys((UNCOMMANDED.short, COASTS.short), "drive_changed"),
    MAY_MOVE.short: "position_error",
    **{each.short: "stood_at_once" for each in UNSEEN.values()},
    BY_INTERLOCK: "interlock_violated",
    SLOW: "bus_busy",
}
"""The code of the page that explains what a face says in a few words; other words are those of a code."""
_DRIVEN = frozenset(each for each in AxisState if each.is_motion) - {AxisState.STOPPING}


def explained_as(said: str) -> str:
    """Return the code whose page explains what a face says, however its words are written; others stay as they are."""
    code = re.sub("[^a-z0-9]+", "_", said.lower()).strip("_")
    # a word may have a value behind it: "speed override 30 %"
    pages = (page for words, page in PAGES.items() if f"{code}_".startswith(f"{words.lower().replace(' ', '_')}_"))
    return next(pages, code)


def assess_module(health: ModuleHealth, *, line_up: bool = True, silence: str = "") -> Condition:
    """Return the condition of an I/O module.

    Args:
        health: its last report.
        line_up: its line is up.
        silence: why nothing comes from its daemon; empty while it reports.
    """
    gone = _silent(silence) if silence else None if line_up else ON_DEAD_LINE
    if gone is None and health.link is LinkState.DOWN:
        gone = MODULE_SILENT
    if gone:
        return _unanswered("unknown", (gone,), gone.short)
    troubles = [MODULE_MISSES] if health.link is LinkState.DEGRADED else []
    if health.floating:
        text = f"{', '.join(health.floating)}: was set before the module lost its power, and floats until it is set"
        troubles.append(Trouble(TroubleKind.FLOATING, Severity.NOTICE, text, FLOATS))
    alarm = Alarm(max((trouble.severity for trouble in troubles), default=Severity.FINE))
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
    state_age_s: float | None = None,
    position_quality: Quality | None = None,
    line_up: bool | None = True,
    silence: str = "",
    rate_hz: float | None = None,
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
        state_age_s: age of its state, seconds; None where that is no newer than the position, or not known.
        position_quality: of another instant than the state, perhaps; None where the face has none.
        line_up: its line is up, as far as the face knows; None while its daemon has not reported about it.
        silence: why nothing comes from its daemon; empty while it reports.
        rate_hz: how many positions a second its daemon is asked for, to a face without a report; None while not known.
    """
    if state is None:
        dead = OPENING if line_up is None else ON_DEAD_LINE
        lost = (_silent(silence),) if silence else () if line_up else (dead,)
        return _unanswered("unknown", lost or (NEVER_SEEN,), lost[0].short if lost else NO_DATA)
    word, last = state.state.words, _last_known(state)
    holder = UNKNOWN_HOLDER if silence else state.holder
    control = _control(holder, moves=state.moving is Moving.YES and state.command is not None)
    gone = _unreachable(state, faults, silence=silence, line_up=line_up)
    pending = (NOT_CONFIRMED,) if state.stop_pending else ()
    if gone:
        known = LATCHED if state.was_read else LATCHED_UNREAD
        latched = (known,) if state.stop_latched and not state.stop_pending and not silence else ()
        silent = _unanswered(last, (*pending, gone, *latched), gone.short)
        return replace(silent, holder=holder, control=control, moves=state.state.is_motion)
    longest_s = _longest_s(state, health.rate_wanted_hz if health else rate_hz)
    is_aged = age_s is not None and age_s > longest_s
    place, mark = _place(state, faults, position_quality, is_aged=is_aged)
    troubles = (*pending, *_found(state, faults, health, place), *_overridden(health), *_slowed(state))
    worst = max((trouble.severity for trouble in troubles), default=Severity.FINE)
    alarm = Alarm.INVALID if place in _AGED else Alarm(worst)
    # whose drive misses polls is not read, whenever it was published
    is_heard = state.link is LinkState.UP and state_age_s is not None and state_age_s <= longest_s
    live = is_heard or not is_aged
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
    return Trouble(TroubleKind.SILENCE, Severity.WRONG, why, DAEMON_SILENT)


def _unreachable(state: KnownState, faults: Faults | None, *, silence: str, line_up: bool | None) -> Trouble | None:
    """Return why nothing is known of an axis; None when it answers."""
    if silence:
        return _silent(silence)
    if faults and any(fault.code == "not_identified" for fault in faults.active):
        return NOT_IDENTIFIED
    if state.link is not LinkState.DOWN:
        return None  # a report on its line may be a second older than this
    if line_up is False:
        return ON_DEAD_LINE
    lost = next((fault for fault in faults.active if fault.code == "link_lost"), None) if faults else None
    if lost:
        return replace(NO_ANSWER, text=lost.text)
    return OPENING if line_up is None and not state.was_read else NO_ANSWER


def _longest_s(state: KnownState, rate_hz: float | None) -> float:
    """Return how long what was read of an axis that answers says how it is, seconds."""
    rate_hz = rate_hz or UNKNOWN_HZ
    missed = state.link is LinkState.DEGRADED
    return MISSED_S + MISSED_PERIODS / rate_hz if missed else OLD_S + OLD_PERIODS / rate_hz


def _place(
    state: KnownState, faults: Faults | None, position_quality: Quality | None, *, is_aged: bool
) -> tuple[Place, str]:
    """Return whether the position of an axis that answers says where it is, and its mark."""
    if state.link is LinkState.UP and state.quality is Quality.UNCERTAIN:
        was_set = faults is not None and any(fault.code == COUNTER_SET for fault in faults.active)
        cause = state.motion_hidden_by or (COUNTER_SET if was_set else POSITION_LOST)
        return Place.CONTRADICTED, _words(cause)
    if is_aged or position_quality is Quality.BAD:
        return Place.OLD, OLD.short
    if state.referenced or not state.has_reference:
        is_doubted = position_quality is Quality.UNCERTAIN and state.link is LinkState.UP
        return (Place.UNCERTAIN, UNCERTAIN.short) if is_doubted else (Place.KNOWN, "")
    if state.state is AxisState.HOMING:
        return Place.NOT_HOMED, HOMING.short
    return Place.NOT_HOMED, REFERENCE_LOST.short if state.reference_lost else NOT_HOMED.short


def _found(state: KnownState, faults: Faults | None, health: AxisHealth | None, place: Place) -> tuple[Trouble, ...]:
    """Return what deserves attention on an axis that answers."""
    entries = _first_cause_first(faults) if faults else []
    found = [_of_fault(entry, TroubleKind.FAULT, Severity.WRONG) for entry in entries if entry.stops]
    found += _ended(state, faults, in_fault=bool(found))
    if state.motion_hidden_by and state.moving is Moving.UNKNOWN:
        found.append(MAY_MOVE)
    elif state.unseen and state.moving is Moving.UNKNOWN:
        found.append(UNSEEN[state.unseen])
    if place in _UNSURE:
        found.append(_UNSURE[place])
    if state.has_reference and not state.referenced and place is not Place.CONTRADICTED:  # that is its cause
        lost = REFERENCE_LOST if state.reference_lost else NOT_HOMED
        found.append(HOMING if state.state is AxisState.HOMING else lost)
    if state.stop_latched and not state.stop_pending:
        found.append(LATCHED)
    if state.moving is Moving.YES and state.command is None:
        found += _uncommanded(state)
    if not state.speed_override and state.has_reference:  # as above
        found.append(OVERRIDE_ZERO)
    found += [_of_fault(entry, TroubleKind.WARNING, Severity.NOTICE) for entry in entries if not entry.stops]
    if state.link is LinkState.DEGRADED:
        found.append(MISSED_POLLS)
    elif health:
        found += _slowness(health)
    return tuple(sorted(found, key=lambda trouble: -trouble.severity))


def _uncommanded(state: KnownState) -> tuple[Trouble, ...]:
    """Return what is to be said of an axis that moves, and has no command."""
    if state.state in _DRIVEN:
        return (UNCOMMANDED,) if state.has_reference else ()  # without: its line takes no motion; others move it
    if not state.enabled:  # such as one whose drive has ended its search onto a jam: it had a command
        return (COASTS,)
    return () if state.stop_pending else (PUSHED,)


def _ended(state: KnownState, faults: Faults | None, *, in_fault: bool) -> tuple[Trouble, ...]:
    """Return how a motion ended that leaves an axis in error stop, or that an interlock has ended."""
    if state.state is not AxisState.ERROR_STOP:
        text = f"its motion was ended by interlock {state.interlock}"
        return (Trouble(TroubleKind.INTERLOCK, Severity.NOTICE, text, BY_INTERLOCK),) if state.interlock else ()
    if in_fault:
        return ()
    first = faults.first if faults else None
    if faults and first and first.stops and is_over(first, faults.active, state.link):
        text = f"in error stop because of {over_in_words(first)}: reset it to go on"
    else:
        text = f"in error stop: {state.last_error or 'reset it to go on'}"
    return (Trouble(TroubleKind.ERROR_STOP, Severity.WRONG, text, ERROR_STOP),)


def _overridden(health: AxisHealth | None) -> tuple[Trouble, ...]:
    """Return the rules that do not bind at present."""
    texts = health.overrides if health else ()
    return tuple(Trouble(TroubleKind.OVERRIDDEN, Severity.NOTICE, text, text) for text in texts)


def _slowed(state: KnownState) -> tuple[Trouble, ...]:
    """Return what is to be known and is not wrong."""
    if not (state.has_reference and 0 < state.speed_override < FULL_SPEED):
        return ()
    short = f"{OVERRIDE} {state.speed_override:g} %"
    return (Trouble(TroubleKind.SLOWED, Severity.FINE, f"{short} of every velocity", short),)


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
    return [Trouble(TroubleKind.SLOW, Severity.NOTICE, text, SLOW)]
