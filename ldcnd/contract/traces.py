"""Traces: what can be recorded of an axis against time, what starts it, and what comes out.

A trace is published as a header on `tele/<axis>/trace`, again whenever its phase changes, and as chunks of samples on
`tele/<axis>/trace/<n>` once it is complete. The last trace stays there for `get`.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

from ldcnd.contract.commands import AxisCommand, Capability, Command, CommandReply, Verb
from ldcnd.contract.frozen import LARGEST_INTEGER, Frozen
from ldcnd.contract.samples import Sample

MOST_CHANNELS = 8
MOST_SAMPLES = 10_000
LONGEST_WAIT_S = 3600.0
ARMING_S = 30.0
"""Maximum time to arm a trace, in seconds: a slow drive needs some twenty exchanges before it begins."""
ENDING_S = 10.0
"""Maximum time of a slow drive to leave its trace, in seconds."""


class TriggerKind(StrEnum):
    """Condition at which a trigger fires."""

    RISING = "rising"
    """The channel comes from below the level and reaches it; a signal goes from 0 to 1."""
    FALLING = "falling"
    """The channel comes from the level or above and drops below it; a signal goes from 1 to 0."""
    EITHER = "either"
    """Rising or falling through the level."""
    CHANGE = "change"
    """The channel differs from its previous sample; the level is not used."""
    ABOVE = "above"
    """The channel is at the level or above it, from the first sample on."""
    BELOW = "below"
    """The channel is below the level, from the first sample on."""


class TraceTrigger(Frozen):
    """The condition for which a trace waits."""

    channel: str
    """One of the recorded channels."""
    kind: TriggerKind
    """Condition at which it fires."""
    level: float | None = None
    """Level in the channel's unit; every channel but a signal needs one. On an axis with a modulo each turn has it."""


class TracePhase(StrEnum):
    """How far a trace is."""

    FILLING = "filling"
    """Samples from before the trigger are gathered; until there are enough, no trigger counts."""
    WAITING = "waiting"
    """Armed; the trigger has not come, as far as the daemon can see."""
    RECORDING = "recording"
    """Samples are being taken."""
    UPLOADING = "uploading"
    """The drive has finished; its memory is being read."""
    COMPLETE = "complete"
    """All chunks are there."""
    ABORTED = "aborted"
    """Ended by trace_abort; there are no samples."""
    TIMED_OUT = "timed_out"
    """The trigger did not come, or the drive did not finish; there are no samples."""
    FAILED = "failed"
    """The line or the drive failed; there are no samples."""


class TraceSource(StrEnum):
    """Who takes the samples."""

    HOST = "host"
    """The daemon polls the drive: every sample has a time of its own."""
    DRIVE = "drive"
    """The drive's own recorder: samples are equally spaced by the drive's clock."""


class TraceChannel(Frozen):
    """One recorded quantity."""

    name: str
    """Name of the channel, as requested."""
    unit: str
    """Unit of its values; empty for signals, which are 0 or 1."""
    scale: float | None = None
    """Its value for a raw one of 1; null where the raw value is not simply proportional."""
    raw_column: int | None = None
    """Raw column from which it was made."""


class DriveTraceInfo(Frozen):
    """Settings of a drive's recorder and the reading of its memory, so that raw words can be decoded again later."""

    objects: tuple[int, int]
    """Words of 5000H and 5001H."""
    smptms: int
    """5002H, sampling interval in units of CYCLEC."""
    ptrgno: int
    """5003H, pre-trigger points."""
    trgc1: int
    """5004H, trigger condition; 0 is none."""
    trgc2: int
    """5005H, trigger level or I/O selection."""
    trgadr: int | None
    """5006H as read afterwards; null without a trigger."""
    cyclec_us: int
    """8700H."""
    maxtrqc: int
    """8701H, torque in % at data 15,000."""
    osvelcc: int
    """8702H, speed in r/min at data 15,000."""
    gear_numerator: int | None
    """RATB, Pn202; null where command pulses are not traced."""
    gear_denominator: int | None
    """RATA, Pn203; null likewise."""
    encoder_counts_per_rev: int
    """Encoder counts per revolution, as configured."""
    word_layout: str
    """Place that was assumed for the I/O bit and the value in a memory word."""
    byte_order: str
    """Half of a word that was taken to come first."""
    string_checksum: str
    """The bytes that the checksum of a string was found or taken to cover."""
    string_count_unit: str
    """The unit in which the count of a string was taken."""
    trigger_word_source: str
    """Source of the trigger: none, configured (the drive's, bits of 5004H), or host (polled, then started)."""
    command_pulse_gear: str
    """Gearing of command pulses that was assumed."""


class TraceShape(Frozen):
    """What a trace holds, as granted: it may differ from the request."""

    channels: tuple[TraceChannel, ...]
    """The channels recorded, in the order of the columns of `values` in each chunk."""
    interval_s: float = Field(ge=0)
    """Time between two samples; 0 is as fast as the line allows. Actual times are in the chunks."""
    samples: int = Field(ge=0)
    """How many samples there will be; once the trace is complete, how many there are."""
    pre_trigger: int = Field(ge=0)
    """Number of samples before the trigger."""


class TraceHeader(TraceShape, Sample):
    """A trace without its samples; `t` is the instant of offset 0: the trigger, or the first sample without one."""

    trace_id: str
    """The id of the command that requested it."""
    axis: str
    """The axis."""
    source: TraceSource
    """Who took the samples."""
    phase: TracePhase
    """How far it is."""
    uploaded: float | None = Field(default=None, ge=0, le=1)
    """Share of the drive's trace memory that has been read, 0 to 1, while it is uploading; null otherwise."""
    problem: str | None = None
    """Why it was not completed, or why its values are uncertain."""
    trigger: TraceTrigger | None = None
    """The condition for which it waits or has waited."""
    trigger_index: int | None = None
    """The sample at which the trigger was detected."""
    trigger_late_s: float = Field(default=0.0, ge=0)
    """Maximum time between the trigger condition and its detection, in seconds: 2 ms by a drive's recorder; by
    the host, whose trace begins after it, the time from one poll to the first sample."""
    missed: int = 0
    """Polls of a trace by the host that brought no sample."""
    chunks: int = Field(default=0, ge=0)
    """How many chunks there are; 0 until it is complete."""
    raw_columns: tuple[str, ...] = ()
    """Names of the columns of `raw` in each chunk."""
    drive: DriveTraceInfo | None = None
    """Settings of a drive's own recorder, and how its words were read; null for a trace by the host."""


class TraceChunk(Sample):
    """Consecutive samples of a trace; `t` is the instant of the first of them."""

    trace_id: str
    """The trace it belongs to."""
    index: int = Field(ge=0)
    """Its number, from 0."""
    first: int = Field(ge=0)
    """Index of its first sample in the trace."""
    offsets_ns: tuple[int, ...]
    """Instants at which the samples were true, relative to the header's `t`."""
    values: tuple[tuple[float | None, ...], ...]
    """One column for each channel, in its unit; null where the drive did not say."""
    raw: tuple[tuple[int | float | None, ...], ...]
    """One column for each of the header's raw columns: counts, or words of the trace memory."""


class TraceReply(TraceShape, CommandReply):
    """The trace is armed; values are as granted, and may differ from the request."""

    trace_id: str
    """Names the trace in its header and chunks."""
    source: TraceSource
    """Who takes the samples."""


class TraceAbortReply(CommandReply):
    """The trace has ended, and the drive takes settings again."""

    trace_id: str | None
    """The trace that was ended; null for one that another host had left armed in the drive."""


class TakeTrace(AxisCommand[TraceReply]):
    """Record channels of an axis against time; moves nothing."""

    verb = Verb.TRACE
    capability = Capability.TRACES
    answer_s = ARMING_S

    channels: tuple[str, ...] = Field(min_length=1, max_length=MOST_CHANNELS)
    """The channels to record; `meta/axes/<axis>` lists those of the axis."""
    interval_s: Annotated[float, Field(gt=0)] | Literal["fastest"] = "fastest"
    """Time between two samples, in seconds, or "fastest"."""
    samples: int = Field(default=500, ge=2, le=MOST_SAMPLES)
    """How many samples; a drive's own recorder always takes as many as it has room for."""
    pre_trigger: int = Field(default=0, ge=0, le=LARGEST_INTEGER)
    """Number of them before the trigger; ignored without one."""
    full_scale: Mapping[str, Annotated[float, Field(gt=0)]] = {}
    """Largest magnitude expected of a channel, in its unit: a drive's recorder that can resolves it finer. Put back
    after the trace."""
    trigger: TraceTrigger | None = None
    """The condition to wait for; a missing one starts at once."""
    timeout_s: float = Field(default=30.0, gt=0, le=LONGEST_WAIT_S)
    """Longest wait for the trigger, in seconds."""


class AbortTrace(AxisCommand[TraceAbortReply]):
    """End the trace that is under way, or one that was left armed in the drive; its samples are lost."""

    verb = Verb.TRACE_ABORT
    capability = Capability.TRACES
    answer_s = ENDING_S


COMMANDS: tuple[type[Command[Frozen]], ...] = (TakeTrace, AbortTrace)
"""The commands of this file."""
