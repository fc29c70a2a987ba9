"""Channels of a trace, as a request names them, on the two trace memories of a drive: each holds one value and one bit.

Source: manual 4, settings 3 and 7.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from ldcnd.drivers.smartstep.profiles import SmartStepProfile
from ldcnd.drivers.smartstep.trace_scaling import TraceConstants, trigger_level
from ldcnd.drivers.smartstep.trace_setup import (
    DataObject,
    Edge,
    IoObject,
    TriggerObject,
    TriggerWord,
    no_trigger,
    object_word,
    trigger_word,
)
from ldcnd.errors import NotSupported, ValueOutOfRange
from ldcnd.model.traces import TraceTrigger, TriggerKind

MEMORIES = 2
DATA: Mapping[str, DataObject] = MappingProxyType({each.name.lower(): each for each in DataObject})
SIGNALS: Mapping[str, IoObject] = MappingProxyType({each.name.lower(): each for each in IoObject})
CHANNELS = (*DATA, *SIGNALS)

_EDGES: Mapping[TriggerKind, Edge] = MappingProxyType(
    {TriggerKind.RISING: Edge.RISING, TriggerKind.FALLING: Edge.FALLING, TriggerKind.EITHER: Edge.BOTH}
)


@dataclass(frozen=True, slots=True)
class Assignment:
    """Which channel is in which memory.

    Attributes:
        channels: as asked for.
        data: the values of memory 1 and 2, `io` their bits; what was not asked for is filled in.
        used: how many memories hold something that was asked for: 1 or 2.
    """

    channels: tuple[str, ...]
    data: tuple[DataObject, DataObject]
    io: tuple[IoObject, IoObject]
    used: int

    @property
    def objects(self) -> tuple[int, int]:
        """The words of 5000H and 5001H."""
        return object_word(self.data[0], self.io[0]), object_word(self.data[1], self.io[1])

    def memory(self, channel: str) -> int:
        """Return the memory that holds a channel, 0 or 1."""
        if channel in DATA:
            return self.data.index(DATA[channel])
        return self.io.index(SIGNALS[channel])


def assign(axis: str, channels: tuple[str, ...]) -> Assignment:
    """Find room for channels that exist.

    Raises:
        ValueOutOfRange: there is no room for so many.
    """
    data = [DATA[channel] for channel in channels if channel in DATA]
    io = [SIGNALS[channel] for channel in channels if channel in SIGNALS]
    for kind, wanted in (("values", len(data)), ("signals", len(io))):
        if wanted > MEMORIES:
            raise ValueOutOfRange(
                f"axis {axis}: {wanted} {kind} at once; the drive traces {MEMORIES}",
                axis=axis,
                value=wanted,
                limit=MEMORIES,
            )
    used = max(len(data), len(io))
    data = (data or [DataObject.TORQUE_REFERENCE]) * MEMORIES
    io = (io or [IoObject.RUN]) * MEMORIES
    return Assignment(channels, (data[0], data[1]), (io[0], io[1]), used)


def trigger_condition(
    axis: str, profile: SmartStepProfile, assignment: Assignment, trigger: TraceTrigger | None
) -> TriggerWord:
    """Return the word of 5004H for a trigger on a recorded channel.

    Raises:
        NotSupported: the drive has no such trigger, or its bits are not known.
    """
    if trigger is None:
        return no_trigger()
    if trigger.kind not in _EDGES:
        raise NotSupported(
            f"axis {axis}: the drive triggers on edges only, not on {trigger.kind.value!r}",
            axis=axis,
            value=trigger.kind.value,
            remedy="use rising, falling or either",
        )
    if trigger.channel in SIGNALS:
        watched = TriggerObject.IO
    else:
        watched = (TriggerObject.TRACE_1, TriggerObject.TRACE_2)[assignment.memory(trigger.channel)]
    return trigger_word(profile, watched, _EDGES[trigger.kind])


def trigger_operand(
    profile: SmartStepProfile, constants: TraceConstants, assignment: Assignment, trigger: TraceTrigger | None
) -> int:
    """Return the word of 5005H: a level in trace data, or the memory whose bit is watched.

    Raises:
        ValueOutOfRange: the level does not fit 16 bits.
    """
    if trigger is None:
        return 0
    if trigger.channel in SIGNALS:
        return assignment.memory(trigger.channel)
    return trigger_level(profile, constants, DATA[trigger.channel], trigger.level)
