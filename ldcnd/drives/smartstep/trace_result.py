"""Channels of a trace on the two memories of a drive, and the finished trace.

Each memory holds one value and one bit. The layout of a word is not certain, so the words themselves and how they were
read stay with the result, and values are uncertain until the layout was compared with the drive. Pure.
Source: manual 3, monitors 8000H to 8008H; 4, settings 3, 7 and 9, "Unit conversion", notes on the trigger.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType

from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.contract.traces import DriveTraceInfo, TraceChannel, TraceTrigger, TriggerKind
from ldcnd.drives.smartstep.addresses import TraceRegister
from ldcnd.drives.smartstep.monitors import (
    INPUT_SIGNALS,
    OUTPUT_SIGNALS,
    POSITION_DEVIATION,
    REFERENCE_PULSE_SPEED,
    SPEED_FEEDBACK,
    TORQUE_REFERENCE,
    InputSignal,
    Monitor,
    OutputSignal,
)
from ldcnd.drives.smartstep.profiles import (
    SmartStepProfile,
    StringChecksum,
    TraceWordLayout,
    TriggerWordSource,
)
from ldcnd.drives.smartstep.trace_data import (
    FULL_SCALE,
    NO_TRIGGER,
    POINTS,
    DataObject,
    IoObject,
    TraceConstants,
    TracePoint,
    decode_word,
    is_beyond_full_scale,
    object_word,
    period_s,
    scale,
    trigger_level,
    unit_of,
    unwrap,
)
from ldcnd.drives.tracer import SIGNAL_LEVEL, Recorded, level_of

MEMORIES = 2
DATA: Mapping[str, DataObject] = MappingProxyType({each.name.lower(): each for each in DataObject})
SIGNALS: Mapping[str, IoObject] = MappingProxyType({each.name.lower(): each for each in IoObject})
CHANNELS = (*DATA, *SIGNALS)
_VALUE_MONITORS: Mapping[DataObject, Monitor] = MappingProxyType(
    {
        DataObject.TORQUE_REFERENCE: TORQUE_REFERENCE,
        DataObject.SPEED_FEEDBACK: SPEED_FEEDBACK,
        DataObject.COMMAND_PULSE_SPEED: REFERENCE_PULSE_SPEED,
        DataObject.POSITION_DEVIATION: POSITION_DEVIATION,
    }
)
_SIGNAL_MONITORS: Mapping[IoObject, tuple[Monitor, int]] = MappingProxyType(
    {
        IoObject.RUN: (INPUT_SIGNALS, InputSignal.RUN),
        IoObject.RESET: (INPUT_SIGNALS, InputSignal.RESET),
        IoObject.ALM: (OUTPUT_SIGNALS, OutputSignal.ALM),
        IoObject.INP: (OUTPUT_SIGNALS, OutputSignal.INP),
        IoObject.BKIR: (OUTPUT_SIGNALS, OutputSignal.BKIR),
    }
)
EDGES = frozenset({TriggerKind.RISING, TriggerKind.FALLING, TriggerKind.EITHER, TriggerKind.CHANGE})
"""Trigger kinds that a drive has; with both edges it is any change (manual 4 (7))."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """Which channel is in which memory.

    Attributes:
        channels: as requested.
        data: the values of memory 1 and 2, `io` their bits; what was not requested is filled in.
        used: how many memories hold something that was requested: 1 or 2.
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


@dataclass(frozen=True, slots=True)
class ChannelMonitor:
    """The monitor that shows what a channel records; for a signal one bit of it."""

    monitor: Monitor
    bit: int | None = None

    def value_of(self, word: int) -> float:
        """Return what the word of the monitor says of the channel, in its unit; a signal is 0 or 1."""
        return float(self.monitor.value_of(word)) if self.bit is None else float(bool(word & self.bit))


def monitor_of(channel: str) -> ChannelMonitor:
    """Return the monitor of a channel."""
    if channel in DATA:
        return ChannelMonitor(_VALUE_MONITORS[DATA[channel]])
    return ChannelMonitor(*_SIGNAL_MONITORS[SIGNALS[channel]])


def assign(axis: str, channels: tuple[str, ...]) -> Assignment:
    """Find room for channels that exist.

    Raises:
        ValueOutOfRange: there is no room for this number.
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
) -> int:
    """Return the word of 5004H for a trigger on a recorded channel.

    Raises:
        NotSupported: the drive has no such trigger, or its bits are not known.
    """
    if trigger is None:
        return NO_TRIGGER
    kind, bits = trigger.kind, profile.unit.trace.trigger_map
    if kind not in EDGES:
        raise NotSupported(
            f"axis {axis}: the drive triggers on edges only, not on {kind.value!r}",
            axis=axis,
            value=kind.value,
            remedy="use rising, falling or change",
        )
    if kind is TriggerKind.EITHER and trigger.channel not in SIGNALS:
        raise NotSupported(
            f"axis {axis}: with both edges of a value the drive triggers on any change, whatever the level",
            axis=axis,
            value=kind.value,
            remedy="use rising, falling or change",
        )
    if bits is None:
        raise NotSupported(
            "the bits of the trigger condition are not known for this drive",
            remedy="trace without a trigger, or configure smartstep.trace.trigger_map",
        )
    word = bits.io if trigger.channel in SIGNALS else (bits.trace1, bits.trace2)[assignment.memory(trigger.channel)]
    if kind is not TriggerKind.FALLING:
        word |= bits.rising
    if kind is not TriggerKind.RISING:
        word |= bits.falling
    return word


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
    return trigger_level(profile, constants, DATA[trigger.channel], level_of(trigger))


@dataclass(frozen=True, slots=True)
class TraceMemory:
    """The drive's words read after a trace.

    Attributes:
        rings: the words of each memory that was used, in the order of the memory.
        first: ring index of the oldest point.
        trigger_address: TRGADR; None for an untriggered trace.
        string_checksum: as it was found or taken.
        trigger_word_source: where the trigger condition came from.
    """

    rings: tuple[tuple[int, ...], ...]
    first: int
    trigger_address: int | None
    string_checksum: StringChecksum
    trigger_word_source: TriggerWordSource

    def in_order(self) -> tuple[tuple[int, ...], ...]:
        """Return the words in order of time."""
        return tuple(unwrap(ring, self.first) for ring in self.rings)


def granted_channels(
    profile: SmartStepProfile, constants: TraceConstants, assignment: Assignment
) -> tuple[TraceChannel, ...]:
    """Describe the channels of a trace."""
    raw = profile.unit.trace.word_layout is TraceWordLayout.RAW
    channels = []
    for name in assignment.channels:
        data = DATA.get(name)
        if data is None or raw:
            unit, factor = "", None
        else:
            unit, factor = unit_of(data), scale(profile, constants, data)
        channels.append(TraceChannel(name=name, unit=unit, scale=factor, raw_column=assignment.memory(name)))
    return tuple(channels)


def raw_columns(assignment: Assignment) -> tuple[str, ...]:
    """Name the raw columns."""
    return tuple(f"trace {memory + 1} word" for memory in range(assignment.used))


def recorded(
    profile: SmartStepProfile,
    constants: TraceConstants,
    assignment: Assignment,
    settings: Mapping[TraceRegister, int],
    memory: TraceMemory,
    first_s: tuple[float, float],
) -> Recorded:
    """Put a trace together.

    Args:
        profile: how the drive is taken to behave.
        constants: what scales the values.
        assignment: which channel is in which memory.
        settings: of the recorder.
        memory: what was read.
        first_s: the first sample was taken between these instants, in loop time.
    """
    words = memory.in_order()
    points = tuple(tuple(decode_word(word, profile.unit.trace.word_layout) for word in column) for column in words)
    zero = settings[TraceRegister.PTRGNO]
    interval_s = period_s(settings[TraceRegister.SMPTMS], constants.cyclec_us)
    return Recorded(
        offsets_ns=tuple(round((k - zero) * interval_s * 1e9) for k in range(POINTS)),
        zero_from_s=first_s[0] + zero * interval_s,
        zero_until_s=first_s[1] + zero * interval_s,
        values=tuple(
            _column(profile, constants, DATA.get(name), points[assignment.memory(name)]) for name in assignment.channels
        ),
        raw=words,
        trigger_index=None if memory.trigger_address is None else zero,
        drive=_info(profile, constants, assignment, settings, memory),
        problems=tuple(_problems(profile, assignment, points)),
    )


def _column(
    profile: SmartStepProfile, constants: TraceConstants, data: DataObject | None, points: tuple[TracePoint, ...]
) -> tuple[float | None, ...]:
    if data is None:
        return tuple(None if point.io is None else float(point.io) for point in points)
    factor = 1.0 if profile.unit.trace.word_layout is TraceWordLayout.RAW else scale(profile, constants, data)
    return tuple(point.value * factor for point in points)


def _problems(
    profile: SmartStepProfile, assignment: Assignment, points: tuple[tuple[TracePoint, ...], ...]
) -> list[str]:
    """Say why values are uncertain: how the words are laid out was not compared with the drive, or cannot be."""
    if profile.unit.trace.word_layout is TraceWordLayout.RAW:
        return ["the words of the trace memory are published as they are, without a layout"]
    problems = []
    if not profile.unit.trace.verified:
        problems.append("the layout of its words is assumed: `ldcnd doctor verify` compares it with the drive")
    for memory, column in enumerate(points):
        if not is_beyond_full_scale(column):
            continue
        if assignment.data[memory] in (DataObject.TORQUE_REFERENCE, DataObject.SPEED_FEEDBACK):
            problems.append(
                f"trace {memory + 1} has values beyond {FULL_SCALE}, so its words are hardly laid out as"
                f" {profile.unit.trace.word_layout.value}"
            )
        elif profile.unit.trace.word_layout is not TraceWordLayout.LSB_IO_MASK:  # which alone has room for 16 bits
            problems.append(f"trace {memory + 1} goes beyond {FULL_SCALE}: what a drive records then is not known")
    return problems


TRIGGER_LATE_S = 0.002
"""A trigger is detected at most so late (manual 4, note 1)."""


def trigger_problem(
    trigger: TraceTrigger, level: float, column: Sequence[float | None], index: int, interval_s: float
) -> str | None:
    """Return what is wrong when the recorded values show no trigger where the drive says that it was.

    A drive whose trace was ended from elsewhere is in its normal mode, too, and says anything. The condition may have
    been met `TRIGGER_LATE_S` before it was detected.

    Args:
        trigger: what the drive waited for.
        level: as it was set in the drive, in the unit of the channel.
        column: the values of its channel.
        index: of the sample at which the trigger was detected.
        interval_s: between two samples.
    """
    # one sample more, so that the edge has both of its sides
    first = max(0, index - math.ceil(TRIGGER_LATE_S / interval_s) - 1)
    near = [value for value in column[first : index + 2] if value is not None]
    if trigger.channel in SIGNALS:
        level = SIGNAL_LEVEL
    edges = list(pairwise(near))
    if index == 0:  # nothing was recorded before the trigger, so only the level after it can be seen
        edges = [(-math.inf, near[0])] if trigger.kind is TriggerKind.RISING else [(math.inf, near[0])]
    rose = any(before < level <= after for before, after in edges)
    fell = any(after < level <= before for before, after in edges)
    changed = any(before != after for before, after in edges)
    met = {
        TriggerKind.RISING: rose,
        TriggerKind.FALLING: fell,
        TriggerKind.EITHER: changed,
        TriggerKind.CHANGE: changed,
    }
    if met.get(trigger.kind, True):
        return None
    return (
        f"the values show no {trigger.kind.value} trigger of {trigger.channel} at sample {index}: the trace was ended"
        " from elsewhere, or the trigger bits or the layout are wrong"
    )


def _info(
    profile: SmartStepProfile,
    constants: TraceConstants,
    assignment: Assignment,
    settings: Mapping[TraceRegister, int],
    memory: TraceMemory,
) -> DriveTraceInfo:
    geared = DataObject.COMMAND_PULSE_SPEED in assignment.data
    return DriveTraceInfo(
        objects=assignment.objects,
        smptms=settings[TraceRegister.SMPTMS],
        ptrgno=settings[TraceRegister.PTRGNO],
        trgc1=settings[TraceRegister.TRGC1],
        trgc2=settings[TraceRegister.TRGC2],
        trgadr=memory.trigger_address,
        cyclec_us=constants.cyclec_us,
        maxtrqc=constants.maxtrqc,
        osvelcc=constants.osvelcc,
        gear_numerator=constants.gear_numerator if geared else None,
        gear_denominator=constants.gear_denominator if geared else None,
        encoder_counts_per_rev=profile.unit.encoder_counts_per_rev,
        word_layout=profile.unit.trace.word_layout.value,
        byte_order=profile.unit.trace.byte_order.value,
        string_checksum=memory.string_checksum.value,
        string_count_unit=profile.unit.trace.string_count_unit.value,
        trigger_word_source=memory.trigger_word_source.value,
        command_pulse_gear=profile.unit.trace.command_pulse_gear.value,
    )
