"""What the configuration file says about the recorder of a SmartStep: how its strings and words are to be read."""

from dataclasses import replace

from pydantic import Field, field_validator

from ldcnd.drivers.smartstep.profiles import (
    ByteOrder,
    CommandPulseGear,
    CountUnit,
    SmartStepProfile,
    StringChecksum,
    TraceWordLayout,
    TriggerMap,
    TriggerWordSource,
)
from ldcnd.model.frozen import Frozen

WORD = 0xFFFF


class TriggerMapConfig(Frozen):
    """The bits of the trigger condition word, found on a bench; the manual's figure of them is lost."""

    trace1: int = Field(ge=0, le=WORD)
    """Object code of trace 1's value."""
    trace2: int = Field(ge=0, le=WORD)
    """Object code of trace 2's value."""
    io: int = Field(ge=0, le=WORD)
    """Object code of the signals."""
    rising: int = Field(gt=0, le=WORD)
    """Enable bit of the rising edge."""
    falling: int = Field(gt=0, le=WORD)
    """Enable bit of the falling edge."""


class SmartStepTraceConfig(Frozen):
    """How the trace of one unit is taken to work where its manual leaves room."""

    word_layout: TraceWordLayout = TraceWordLayout.MSB_IO
    """Where the signal's bit and the value sit in a word of the trace memory; raw leaves words as they are."""
    byte_order: ByteOrder = ByteOrder.BIG
    """Which half of a word comes first in a string."""
    string_checksum: StringChecksum = StringChecksum.AUTO
    """What the checksum of a string reply covers; auto takes every variant until the drive shows which."""
    string_count_unit: CountUnit = CountUnit.BYTES
    """What the count of a string reference counts."""
    chunk_bytes: int = Field(default=200, ge=2, le=1000)
    """How much of the memory is read at once, even; 2 ms of the line for each byte."""
    verify: bool = True
    """Read everything until two readings agree: the checksum may not cover it."""
    command_pulse_gear: CommandPulseGear = CommandPulseGear.NUM_DEN
    """Which way command pulses are geared to motor speed."""
    trigger_map: TriggerMapConfig | None = None
    """The bits of the trigger condition; without them traces have no trigger."""

    @field_validator("chunk_bytes")
    @classmethod
    def _whole_words(cls, value: int) -> int:
        if value % 2:
            raise ValueError("chunk_bytes is even: a word of the trace memory has two bytes")
        return value

    def assumed_of(self, profile: SmartStepProfile) -> SmartStepProfile:
        """Return a drive's profile with these assumptions."""
        bits = self.trigger_map
        return replace(
            profile,
            trace_word_layout=self.word_layout,
            trace_byte_order=self.byte_order,
            string_checksum=self.string_checksum,
            string_count_unit=self.string_count_unit,
            trace_chunk_bytes=self.chunk_bytes,
            trace_verify=self.verify,
            command_pulse_gear=self.command_pulse_gear,
            trigger_word=TriggerWordSource.CONFIGURED if bits else TriggerWordSource.NONE,
            trigger_map=TriggerMap(**bits.model_dump()) if bits else None,
        )
