"""What an interlock requires of an axis, a line or a module: whether it holds now, and how that is instead."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from ldcnd.axis.axis import AxisService
from ldcnd.axis.rest import REST_COUNTS
from ldcnd.axis.status import AxisStatus
from ldcnd.config.interlocks import Requirement
from ldcnd.contract.errors import Remedy, step
from ldcnd.contract.samples import AxisState, LinkState, Unseen
from ldcnd.contract.units import Dimension
from ldcnd.daemon.modules import ModuleService, level_word

NOT_HOMED = "is not homed"
HUNTING = 0.1
"""Share of its speed by which a servo may be faster than its profile, between two readings."""


@dataclass(frozen=True, slots=True)
class Lack:
    """A requirement that does not hold, or is not known to.

    Attributes:
        of: what it is required of.
        text: how that is instead.
        wanted: how it is required to be; where it is not known, what is to be so first.
        because: why it is not known, in words that are the same for all of which that is so.
        sets: the module and the levels of its output that have it hold, if writing it may.
        axis: the axis that a way out is about.
        way: what has it hold, if a command of that axis does.
        is_unknown: its line has not been read since, or not for long enough: that passes by itself.
    """

    of: str
    text: str
    wanted: str
    because: str = ""
    sets: tuple[ModuleService, Mapping[str, bool]] | None = None
    axis: str | None = None
    way: Remedy | None = None
    is_unknown: bool = False


def in_words(lacks: Iterable[Lack]) -> str:
    """Return all that is lacking; what is not known for one cause is said once."""
    alike: dict[str, list[Lack]] = {}
    for each in lacks:
        alike.setdefault(each.because or f"{each.of} {each.text}", []).append(each)
    texts = []
    for group in alike.values():
        names, first = list(dict.fromkeys(each.of for each in group)), group[0]
        text = f"{', '.join(names)} {first.text if len(names) == 1 else 'are not known'}"
        texts.append(f"{text}: {first.because}" if first.because else text)
    return "; ".join(texts)


@dataclass(frozen=True, slots=True)
class Asked:
    """What a requirement is asked for.

    Attributes:
        levels: of the outputs that are to be written, by name, None to let go of one: they count as they will be.
        watched: a motion is only watched: an output that is being written counts with its last reading, as long as
            that is not too old.
    """

    levels: Mapping[str, bool | None] = field(default_factory=dict)
    watched: bool = False


NOW = Asked()
WATCHED = Asked(watched=True)


def lack_of_module(module: ModuleService, now_s: float, age_s: float) -> Lack | None:
    """Return how a module does not answer; None when it does."""
    of = f"module {module.name}"
    return None if now_s - module.read_at_s <= age_s else Lack(of, "does not answer", f"{of} answers")


def lack_of_line(module: ModuleService, each: Requirement, now_s: float, age_s: float, asked: Asked) -> Lack | None:
    """Return how an input or output is not as required; None when it is."""
    name, what, wanted = (each.input, "input", each.value) if each.input else (each.output, "output", each.value)
    assert name is not None  # noqa: S101 - a requirement names one of the four
    of, word = f"{what} {name}", _word(what, wanted)
    if now_s - module.read_at_s > age_s:
        because = f"module {module.name} does not answer"
        return Lack(of, "is not known", f"module {module.name} answers", because, is_unknown=True)
    is_recent = now_s - module.proven_at_s(name) <= age_s
    value = asked.levels.get(name, module.values[name] if is_recent else None)
    if asked.watched and value is None and (unread := module.unread.get(name)):
        value = unread.before if now_s - unread.read_at_s <= age_s else None
    if value is wanted:
        return None
    text = "is not known" if value is None else f"is {_word(what, not wanted)}"
    if what == "input":
        return Lack(of, text, f"{of} is {word}", is_unknown=value is None)
    if value is None and (why := module.why_unknown(name)):
        return Lack(of, text, f"{of} is known", why)
    return Lack(of, text, f"{of} is {word}", sets=(module, {name: wanted}), is_unknown=value is None)


def lack_of_axis(
    axis: AxisService, each: Requirement, now_s: float, age_s: float, may_home: Callable[[AxisService], bool]
) -> Lack | None:
    """Return how an axis is not as required; None when it is.

    Args:
        axis: the axis.
        each: what is required.
        now_s: now, in loop time.
        age_s: how old its last reading may be.
        may_home: tells whether a search for its reference would begin now.
    """
    if not (text := _is_instead(axis, each, now_s, age_s)):
        return None
    name, status = axis.config.name, axis.tracker.status
    way: Remedy | None = None
    off = step("power", 'send power {"on": false}', on=False)
    if (each.standstill or each.below is not None) and _unproven(status):
        if status.motion_hidden_by:
            resets = "look whether it stands, then {}"
            way = Remedy(f"{{}}, {resets}", off, step("reset")) if status.energised else Remedy(resets, step("reset"))
        elif status.unseen is Unseen.UNDER_POWER:
            waits = f"{{}} and wait until it stands, for {status.rest.unseen_s:g} s"
            way = Remedy(f"{{}}, or {waits}", step("home"), off) if may_home(axis) else Remedy(waits, off)
    elif text == NOT_HOMED and may_home(axis):
        way = Remedy("{} and wait until it is homed", step("home"))
    return Lack(f"axis {name}", text, f"axis {name} {_required(status, each)}", axis=name, way=way)


def _is_instead(axis: AxisService, each: Requirement, now_s: float, age_s: float) -> str:
    """Return how an axis is that is required to be another way; empty when it is as required."""
    tracker = axis.tracker
    status, reading = tracker.status, tracker.reading
    if reading is None or not tracker.proof.holds or status.link is LinkState.DOWN:
        return "is not known: its drive does not answer"
    if now_s - (tracker.proven_at_s if each.is_of_state else tracker.read_at_s) > age_s:
        return "is not known: it was read longer ago than the interlock allows"
    # a counter that stands still beside a shaft that turns looks like rest, as a jam does
    if (each.standstill or each.below is not None) and (unproven := _unproven(status)):
        return unproven
    if each.standstill and not (status.rest.rests is True and not is_commanded(status)):
        return "does not stand, or is not known to"
    if each.below is not None and (speed := speed_of(axis)) >= each.below:
        now, limit = (status.scale.text(value, Dimension.VELOCITY) for value in (speed, each.below))
        return f"may be at {now}, which is not below {limit}"
    in_range = (each.min, each.max) != (None, None)
    if (each.homed or in_range) and (not status.referenced or status.position_lost):
        return NOT_HOMED
    if in_range:
        here = status.scale.shown_at(reading.position_counts)
        if (each.min is not None and here < each.min) or (each.max is not None and here > each.max):
            return f"is at {status.scale.text(here, Dimension.POSITION)}, which is not {_range(status, each)}"
    return ""


def _unproven(status: AxisStatus) -> str:
    """Return why readings do not prove how fast a shaft is; empty where they do."""
    if fault := status.motion_hidden_by:
        return f"may move: after fault {fault} its encoder does not prove that it stands"
    if status.rest_unproven_by:
        return "may move: its encoder is yet to show that it has followed its motion"
    if status.unseen is Unseen.UNDER_POWER:
        return "may turn: its encoder is yet to count in a motion of this daemon"
    if status.unseen:
        seconds = f"{status.rest.unseen_s:g} s"
        return f"may coast: nothing has shown yet that it stands; it does once it has not counted for {seconds}"
    return ""


def _required(status: AxisStatus, each: Requirement) -> str:
    """Return in words how an axis is required to be."""
    parts = ["stands"] if each.standstill else []
    parts += [] if each.below is None else [f"is below {status.scale.text(each.below, Dimension.VELOCITY)}"]
    parts += ["is homed"] if each.homed else []
    if (each.min, each.max) != (None, None):
        parts.append(f"is {_range(status, each)}")
    return " and ".join(parts) or "answers"


def _range(status: AxisStatus, each: Requirement) -> str:
    """Return in words where an axis is required to be; either end may be open."""
    low, high = (None if end is None else status.scale.text(end, Dimension.POSITION) for end in (each.min, each.max))
    if low and high:
        return f"between {low} and {high}"
    return f"at least {low}" if low else f"at most {high}"


def _word(what: str, value: bool) -> str:  # noqa: FBT001 - of a line
    return str(value).lower() if what == "input" else level_word(value)


def is_commanded(status: AxisStatus) -> bool:
    """Tell whether a motion of this daemon is under way."""
    return status.command is not None and status.state.is_motion


def speed_of(axis: AxisService) -> float:
    """Return how fast an axis is at most, in units a second.

    What a drive shows is whole counts in a servo cycle. Of a slow motion its command says more, once two positions show
    that it is not faster any more.
    """
    tracker, told = axis.tracker, axis.gate.told
    status, reading, (earlier, earlier_at_s) = tracker.status, tracker.reading, tracker.earlier
    if reading is None:
        return math.inf
    counts = abs(reading.velocity_counts_per_s) + reading.velocity_resolution_counts_per_s
    told_s = max(told.at_s, status.effective_from_s)
    if is_commanded(status) and tracker.read_at_s < told_s:  # nothing shows yet what the drive makes of it
        counts = max(told.most_counts_per_s, counts if status.state is AxisState.STOPPING else 0.0)
    elif is_commanded(status) and status.state is not AxisState.STOPPING:
        counts = max(told.counts_per_s, counts)
        if earlier and (earlier_at_s >= told_s or not told.replaced_counts_per_s):
            way, took_s = abs(reading.position_counts - earlier.position_counts), tracker.read_at_s - earlier_at_s
            if way <= told.counts_per_s * (1 + HUNTING) * took_s + REST_COUNTS:
                counts = told.counts_per_s
    elif status.at_rest:
        counts = 0.0
    if status.following and status.following.leeway.coasts:  # as fast as it was seen to move last, until it is again
        counts = max(counts, status.following.seen.speed_counts_per_s)
    return counts / abs(status.scale.counts_per_unit)
