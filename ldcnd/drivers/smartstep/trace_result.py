"""From the words of a trace memory to a finished trace: in order of time, decoded, scaled, with all assumptions. Pure.

The layout of a word is not certain, so the words themselves and everything that was assumed stay with the result.
Source: manual 4, settings 3 and 9, "Unit conversion".
"""

from collections.abc import Mapping
from dataclasses import dataclass

from ldcnd.drivers.smartstep.addresses import TraceRegister
from ldcnd.drivers.smartstep.doubts import doubt_info
from ldcnd.drivers.smartstep.profiles import (
    SmartStepProfile,
    StringChecksum,
    TraceWordLayout,
    TriggerWordSource,
)
from ldcnd.drivers.smartstep.trace_channels import DATA, Assignment
from ldcnd.drivers.smartstep.trace_memory import POINTS, unwrap
from ldcnd.drivers.smartstep.trace_scaling import TraceConstants, scale, unit_of
from ldcnd.drivers.smartstep.trace_setup import DataObject, period_s
from ldcnd.drivers.smartstep.trace_words import FULL_SCALE, TracePoint, decode_word, is_beyond_full_scale
from ldcnd.drivers.tracer import Recorded
from ldcnd.model.traces import DriveTraceInfo, TraceChannel

BEARING = (
    "string_checksum",
    "string_count_unit",
    "trace_chunk_bytes",
    "trace_word_layout",
    "trace_byte_order",
    "trigger_word",
    "command_pulse_gear",
    "encoder_counts_per_rev",
    "untriggered_start",
)
"""The doubts that bear on a trace."""


@dataclass(frozen=True, slots=True)
class TraceMemory:
    """What was read after a trace.

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


def granted_channels(
    profile: SmartStepProfile, constants: TraceConstants, assignment: Assignment
) -> tuple[TraceChannel, ...]:
    """Describe the channels of a trace."""
    raw = profile.trace_word_layout is TraceWordLayout.RAW
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
    ended_s: tuple[float, float],
) -> Recorded:
    """Put a trace together.

    Args:
        profile: how the drive is taken to behave.
        constants: what scales the values.
        assignment: which channel is in which memory.
        settings: of the recorder.
        memory: what was read.
        ended_s: the last point was taken between these instants, in loop time.
    """
    words = tuple(unwrap(ring, memory.first) for ring in memory.rings)
    points = tuple(tuple(decode_word(word, profile.trace_word_layout) for word in column) for column in words)
    zero = settings[TraceRegister.PTRGNO]
    interval_s = period_s(settings[TraceRegister.SMPTMS], constants.cyclec_us)
    after_s = (POINTS - 1 - zero) * interval_s
    return Recorded(
        offsets_ns=tuple(round((k - zero) * interval_s * 1e9) for k in range(POINTS)),
        zero_from_s=ended_s[0] - after_s,
        zero_until_s=ended_s[1] - after_s,
        values=tuple(
            _column(profile, constants, DATA.get(name), points[assignment.memory(name)]) for name in assignment.channels
        ),
        raw=words,
        trigger_index=None if memory.trigger_address is None else zero,
        drive=_info(profile, constants, assignment, settings, memory),
        doubts=tuple(_doubts(profile, assignment, points)),
    )


def _column(
    profile: SmartStepProfile, constants: TraceConstants, data: DataObject | None, points: tuple[TracePoint, ...]
) -> tuple[float | None, ...]:
    if data is None:
        return tuple(None if point.io is None else float(point.io) for point in points)
    factor = 1.0 if profile.trace_word_layout is TraceWordLayout.RAW else scale(profile, constants, data)
    return tuple(point.value * factor for point in points)


def _doubts(profile: SmartStepProfile, assignment: Assignment, points: tuple[tuple[TracePoint, ...], ...]) -> list[str]:
    """Say what cannot be if the words are laid out as assumed."""
    if profile.trace_word_layout is TraceWordLayout.RAW:
        return []
    return [
        f"trace {memory + 1} has values beyond {FULL_SCALE}, so its words are hardly laid out as"
        f" {profile.trace_word_layout.value}"
        for memory, column in enumerate(points)
        if assignment.data[memory] in (DataObject.TORQUE_REFERENCE, DataObject.SPEED_FEEDBACK)
        and is_beyond_full_scale(column)
    ]


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
        encoder_counts_per_rev=profile.encoder_counts_per_rev,
        word_layout=profile.trace_word_layout.value,
        byte_order=profile.trace_byte_order.value,
        string_checksum=memory.string_checksum.value,
        string_count_unit=profile.string_count_unit.value,
        trigger_word_source=memory.trigger_word_source.value,
        command_pulse_gear=profile.command_pulse_gear.value,
        assumptions=tuple(doubt_info(profile, doubt) for doubt in profile.doubts if doubt.key in BEARING),
    )
