"""Where a recorded axis was at an instant: from its recorded positions, by the same computation as in the daemon."""

import statistics
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from mcap.records import Attachment, Channel, Message

from ldcnd.contract.errors import ConfigError, UnknownAxis
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.instants import Coordinates, Reading, instant_of, instants_of, longest_gap_ns, packed
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.samples import InputLevels, InputsSample, PositionSample, TelemetryItem, VelocitySample
from ldcnd.lab.recording.messages import axis_of, model_of
from ldcnd.lab.recording.reading import Recording

_UNKNOWN = (None,) * len(InputLevels.model_fields)


@dataclass(frozen=True, slots=True)
class RecordedReadings:
    """The recorded readings of one axis, in order.

    Attributes:
        readings: as they were.
        gap_ns: nothing is concluded where two of them are farther apart.
        info: the description of the axis.
    """

    readings: Sequence[Reading]
    gap_ns: int
    info: AxisInfo

    @property
    def coordinates(self) -> Coordinates:
        """How counts and positions belong together."""
        return Coordinates(self.info.unit, _counts_per_unit(self.info))

    def at(self, t: int) -> AxisInstant:
        """Return what they prove of an instant, UTC in ns since 1970."""
        return instant_of(self.readings, t, self.gap_ns, self.coordinates)

    def between(self, t: int, until: int) -> Iterator[AxisInstant]:
        """Yield the same of the first instant of a range, of each reading in it, and of its last instant."""
        return instants_of(self.readings, t, until, self.gap_ns, self.coordinates)


def recorded_readings(recording: Recording, axis: str) -> RecordedReadings:
    """Read one axis of a recording.

    Raises:
        ConfigError: the file is no recording, or has no description of the axis.
        UnknownAxis: it has no such axis; names those that it has.
    """
    axes: set[str] = set()
    models: dict[int, type[Frozen]] = {}
    told: dict[str, bytes] = {}
    samples: list[PositionSample] = []
    inputs: list[InputsSample] = []
    speeds = {0.0}
    for record in recording.records():
        if isinstance(record, Attachment):
            told[record.name] = record.data
        elif isinstance(record, Channel):
            name = axis_of(key := record.topic.removeprefix("/"))
            if name is not None:
                axes.add(name)
            if name == axis and (model := model_of(key)) in (PositionSample, InputsSample, VelocitySample):
                models[record.id] = model
        elif isinstance(record, Message) and record.channel_id in models:
            match models[record.channel_id].model_validate_json(record.data, extra="ignore"):
                case PositionSample() as sample:
                    samples.append(sample)
                case InputsSample() as levels:
                    inputs.append(levels)
                case VelocitySample() as velocity:
                    speeds.add(round(abs(velocity.counts_per_s), 3))
    if axis not in axes:
        known = ", ".join(sorted(axes)) or "none"
        raise UnknownAxis(f"{recording.path} has no axis {axis!r}; it has {known}", axis=axis, value=axis)
    try:
        info = AxisInfo.model_validate_json(told[f"axes/{axis}.json"], extra="ignore")
        budget = RigBudget.model_validate_json(told["budget.json"], extra="ignore")
    except (KeyError, ValueError):
        raise ConfigError(f"{recording.path} has no description of axis {axis} that this version understands") from None
    readings = _readings(samples, inputs, info, _resolution(speeds))
    return RecordedReadings(readings, longest_gap_ns(_rate_hz(budget, axis, readings)), info)


def _rate_hz(budget: RigBudget, axis: str, readings: Sequence[Reading]) -> float:
    """Return how often positions were read: as planned, or else as often as they come."""
    polls = (poll for bus in budget.buses for poll in bus.polls if poll.axis == axis)
    planned = [each.rate_hz for poll in polls for each in poll.items if each.item == TelemetryItem.POSITION]
    return min(planned) if planned else 1e9 / statistics.median([b.t - a.t for a, b in pairwise(readings)] or [1e9])


def _resolution(speeds: set[float]) -> float:
    """Return the least difference of two speeds that a drive has reported: all are multiples of its resolution."""
    return min((faster - slower for slower, faster in pairwise(sorted(speeds))), default=0.0)


def _counts_per_unit(info: AxisInfo) -> float:
    return (info.counts_per_unit or 1.0) * (-1 if info.direction == "reverse" else 1)


def _readings(
    samples: Sequence[PositionSample], inputs: Sequence[InputsSample], info: AxisInfo, resolution: float
) -> list[Reading]:
    """Return recorded positions as what was read."""
    changes, per_unit, modulo = [each.t for each in inputs], _counts_per_unit(info), info.modulo or 0.0
    found: list[Reading] = []
    for sample in sorted(samples, key=lambda each: each.t):
        if found and sample.t == found[-1].t:
            found.pop()  # it was published again, as something else changed
        shown = bisect_right(changes, sample.t)
        levels = tuple(getattr(inputs[shown - 1], name) for name in InputLevels.model_fields) if shown else _UNKNOWN
        origin = sample.counts - (sample.value + (sample.turns or 0) * modulo) * per_unit
        rest = packed(levels, sample.quality)
        found.append(Reading(sample.t, sample.t_error_ns, sample.counts, resolution, origin, rest))
    return found
