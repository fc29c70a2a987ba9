"""Where a recorded axis was at an instant: from its recorded positions, by the same computation as in the daemon."""

import statistics
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from mcap.records import Attachment, Channel, Message

from ldcnd.contract.errors import ConfigError, UnknownAxis
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.instants import (
    Coordinates,
    Course,
    Gap,
    Past,
    Reading,
    course,
    instant_of,
    instants_of,
    longest_gap_ns,
    packed,
)
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.samples import (
    InputLevels,
    InputsSample,
    LinkState,
    PositionSample,
    StateSample,
    TelemetryItem,
    VelocitySample,
)
from ldcnd.lab.recording.messages import axis_of, model_of
from ldcnd.lab.recording.reading import Recording

NEIGHBOURS = 5
"""Readings before and behind one by which it is told how often they come there."""
SLOWED = 1.5
"""So many times longer than planned they are apart where the rate was lowered; late or lost polls are not."""
_TOLD = PositionSample, InputsSample, StateSample, VelocitySample
_UNKNOWN = (None,) * len(InputLevels.model_fields)


@dataclass(frozen=True, slots=True)
class RecordedReadings:
    """The recorded readings of one axis, in order.

    Attributes:
        readings: as they were.
        courses: what the axis was doing, by its recorded states.
        gaps: nothing is concluded where two of them are farther apart.
        info: the description of the axis.
    """

    readings: Sequence[Reading]
    courses: Sequence[Course]
    gaps: Sequence[Gap]
    info: AxisInfo

    @property
    def past(self) -> Past:
        """What is kept of the axis."""
        info = self.info
        coordinates = Coordinates.of(info.unit, _counts_per_unit(info), info.limits.velocity)
        return Past(self.readings, self.courses, self.gaps, coordinates)

    def ends_before(self, t: int) -> bool:
        """Tell whether an instant is later than all that was recorded."""
        return not self.readings or self.readings[-1].t < t

    def at(self, t: int) -> AxisInstant:
        """Return what they prove of an instant, UTC in ns since 1970."""
        return instant_of(self.past, t)

    def between(self, t: int, until: int) -> Iterator[AxisInstant]:
        """Yield the same of the first instant of a range, of each reading in it, and of its last instant."""
        return instants_of(self.past, t, until)


def recorded_readings(recording: Recording, axis: str) -> RecordedReadings:
    """Read one axis of a recording.

    Raises:
        ConfigError: the file is no recording, or has no description of the axis.
        UnknownAxis: it has no such axis; names those that it has.
    """
    axes: set[str] = set()
    models: dict[int, type[Frozen]] = {}
    told: dict[str, bytes] = {}
    samples: list[Frozen] = []
    for record in recording.records():
        if isinstance(record, Attachment):
            told[record.name] = record.data
        elif isinstance(record, Channel):
            name = axis_of(key := record.topic.removeprefix("/"))
            if name is not None:
                axes.add(name)
            if name == axis and (model := model_of(key)) in _TOLD:
                models[record.id] = model
        elif isinstance(record, Message) and record.channel_id in models:
            samples.append(models[record.channel_id].model_validate_json(record.data, extra="ignore"))
    if axis not in axes:
        known = ", ".join(sorted(axes)) or "none"
        raise UnknownAxis(f"{recording.path} has no axis {axis!r}; it has {known}", axis=axis, value=axis)
    try:
        info = AxisInfo.model_validate_json(told[f"axes/{axis}.json"], extra="ignore")
        budget = RigBudget.model_validate_json(told["budget.json"], extra="ignore")
    except (KeyError, ValueError):
        raise ConfigError(f"{recording.path} has no description of axis {axis} that this version understands") from None
    places = [each for each in samples if isinstance(each, PositionSample)]
    inputs = [each for each in samples if isinstance(each, InputsSample)]
    states = sorted((each for each in samples if isinstance(each, StateSample)), key=lambda each: each.t)
    speeds = sorted((each for each in samples if isinstance(each, VelocitySample)), key=lambda each: each.t)
    readings = _readings(places, inputs, states, info, _resolutions(speeds, info))
    return RecordedReadings(readings, _courses(states, info), _gaps(readings, _rate_hz(budget, axis, readings)), info)


def _rate_hz(budget: RigBudget, axis: str, readings: Sequence[Reading]) -> float:
    """Return how often positions were read: as planned, or else as often as they come."""
    polls = (poll for bus in budget.buses for poll in bus.polls if poll.axis == axis)
    planned = [each.rate_hz for poll in polls for each in poll.items if each.item == TelemetryItem.POSITION]
    return min(planned) if planned else 1e9 / statistics.median([b.t - a.t for a, b in pairwise(readings)] or [1e9])


def _gaps(readings: Sequence[Reading], rate_hz: float) -> list[Gap]:
    """Return what is a gap: by the planned rate, or where they come less often, as after a reload, by their own."""
    planned_ns = longest_gap_ns(rate_hz)
    found = [Gap(0, planned_ns)]
    apart_ns = [later.t - earlier.t for earlier, later in pairwise(readings)]
    for number, reading in enumerate(readings):
        near = apart_ns[max(0, number - NEIGHBOURS) : number + NEIGHBOURS]
        longest_ns = longest_gap_ns(1e9 / statistics.median(near)) if len(near) >= NEIGHBOURS else 0
        gap_ns = planned_ns if longest_ns < planned_ns * SLOWED else longest_ns
        if gap_ns != found[-1].longest_ns:
            found.append(Gap(reading.t, gap_ns))
    return found


def _resolutions(speeds: Sequence[VelocitySample], info: AxisInfo) -> Callable[[int], float]:
    """Return what tells the velocity resolution of the drive at an instant, in counts a second.

    A daemon of before did not publish it: all velocities are multiples of it, so it is their least difference.
    """
    told = [(each.t, each.resolution * abs(_counts_per_unit(info))) for each in speeds if each.resolution is not None]
    if not told:
        known = sorted({0.0, *(round(abs(each.counts_per_s), 3) for each in speeds)})
        least = min((faster - slower for slower, faster in pairwise(known)), default=0.0)
        told = [(0, least)]
    times = [t for t, _ in told]
    return lambda t: told[max(0, bisect_right(times, t) - 1)][1]


def _counts_per_unit(info: AxisInfo) -> float:
    return (info.counts_per_unit or 1.0) * (-1 if info.direction == "reverse" else 1)


def _readings(
    samples: Sequence[PositionSample],
    inputs: Sequence[InputsSample],
    states: Sequence[StateSample],
    info: AxisInfo,
    resolution_at: Callable[[int], float],
) -> list[Reading]:
    """Return recorded positions as what was read."""
    changes, per_unit, modulo = [each.t for each in inputs], _counts_per_unit(info), info.modulo or 0.0
    told, stretch = [each.t for each in states], 0
    found: list[Reading] = []
    for sample in sorted(samples, key=lambda each: each.t):
        if found and sample.t == found[-1].t:
            found.pop()  # it was published again, as something else changed
        shown = bisect_right(changes, sample.t)
        levels = tuple(getattr(inputs[shown - 1], name) for name in InputLevels.model_fields) if shown else _UNKNOWN
        origin = sample.counts - (sample.value + (sample.turns or 0) * modulo) * per_unit
        state = states[number - 1] if (number := bisect_right(told, sample.t)) else None
        if state and state.link is LinkState.DOWN:
            stretch += 1
        placed, lost = (state.referenced, state.reference_lost) if state else (False, False)
        rest = packed(levels, sample.quality, referenced=placed, lost=lost, stretch=stretch)
        found.append(Reading(sample.t, sample.t_error_ns, sample.counts, resolution_at(sample.t), origin, rest))
    return found


def _courses(states: Sequence[StateSample], info: AxisInfo) -> list[Course]:
    """Return what the axis was doing, by its states in their order."""
    found: list[Course] = []
    latest = None
    for each in states:
        command = each.command
        does = each.state, command and (command.verb, command.since), each.speed_override
        if does != latest:
            latest = does
            verb = command.verb if command else None
            found.append(course(each.t, each.state, verb, approaches=info.approach is not None))
    return found
