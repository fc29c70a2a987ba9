"""How one drive is taken to behave where its manual leaves room.

The manual lost its figures and has misprints. Each field of a profile stands for a place where it is silent or
contradicts itself; the comment at the field says where the default comes from. `ldcnd doctor verify` compares what
bears on traces with the drive; the values of its traces are uncertain until then.
Source: manual, all chapters; where it is silent, public manuals of related drives.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Self

from pydantic import Field, field_validator, model_validator

from ldcnd.contract.frozen import Frozen
from ldcnd.contract.samples import MonitorName


class Framing(StrEnum):
    """How characters are made."""

    SEVEN_EVEN = "7e1"
    SOFT_PARITY = "8n1-soft-parity"


class Wiring(StrEnum):
    """Pairs of the line; the manual describes four wires only (1.1)."""

    FOUR_WIRE = "4-wire"
    TWO_WIRE = "2-wire"


class Echo(StrEnum):
    """Whether the host receives its own characters; recognised by count only, never by content."""

    NONE = "none"
    EXPECT = "expect"


class EepromWrite(StrEnum):
    """Whether EEPROM may be written where a request names it; it endures 10,000 writes (manual 2.2, note)."""

    DENY = "deny"
    ALLOW = "allow"


class StringChecksum(StrEnum):
    """The range of a string reply's checksum; it stands before the data."""

    AUTO = "auto"
    HEADER = "header"
    ALL = "all"
    TRAILER = "trailer"
    """The header's own, and a second one after the data."""


class CountUnit(StrEnum):
    """The unit of the count of a string reference."""

    BYTES = "bytes"
    WORDS = "words"
    CHARS = "chars"


class TraceWordLayout(StrEnum):
    """Place of the I/O bit and the value in a trace memory word."""

    MSB_IO = "msb-io"
    LSB_IO_SHIFT = "lsb-io-shift"
    LSB_IO_MASK = "lsb-io-mask"
    RAW = "raw"


class ByteOrder(StrEnum):
    """Half of a word that comes first in a string."""

    BIG = "big"
    LITTLE = "little"


class TriggerWordSource(StrEnum):
    """Where the trigger of a trace comes from; the bit positions of the drive's are lost from the manual (4, 7))."""

    NONE = "none"
    CONFIGURED = "configured"
    HOST = "host"
    """The host polls, and starts the trace when the condition is met."""


class CommandPulseGear(StrEnum):
    """Gearing of command pulses to motor speed; the two printed formulas contradict the table."""

    NUM_DEN = "num/den"
    DEN_NUM = "den/num"
    NONE = "none"


WORD = 0xFFFF


class TriggerMap(Frozen):
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

    word_layout: TraceWordLayout = TraceWordLayout.MSB_IO  # the figure of manual 4 (9) is lost
    """Place of the signal's bit and the value in a word of the trace memory; raw leaves words as they are."""
    byte_order: ByteOrder = ByteOrder.BIG  # manual 4 (9) is silent; words of commands have the high byte first
    """Half of a word that comes first in a string."""
    string_checksum: StringChecksum = StringChecksum.AUTO  # manual 2.2: its place is given, not what it covers
    """Bytes that the checksum of a string reply covers; auto takes every variant until the drive shows which."""
    string_count_unit: CountUnit = CountUnit.BYTES  # manual 2.2 says "data count"; 1000 addresses hold 500 points
    """Unit of the count in a string reference."""
    chunk_bytes: int = Field(default=200, ge=2, le=1000)  # manual 2.2 gives no longest string
    """How much of the memory is read at once, even; 2 ms of the line for each byte."""
    verify: bool = True
    """Read everything until two readings agree: the checksum may not cover it."""
    command_pulse_gear: CommandPulseGear = CommandPulseGear.NUM_DEN  # manual 4, "Unit conversion", has it both ways
    """Gearing of command pulses to motor speed."""
    trigger_map: TriggerMap | None = None  # the figure of manual 4 (7) is lost
    """The bits of the trigger condition; without them the host watches for the trigger."""
    verified: bool = False
    """Whether the layout was compared with the drive, see `ldcnd doctor verify`; values are uncertain until then."""

    @field_validator("chunk_bytes")
    @classmethod
    def _whole_words(cls, value: int) -> int:
        if value % 2:
            raise ValueError("chunk_bytes is even: a word of the trace memory has two bytes")
        return value


RESPONSE_S = 0.3
"""A drive answers within 0.2 s (manual 2.1), taken as command CR to first reply character, plus 0.1 s of margin."""


class SmartStepUnitConfig(Frozen):
    """How one unit is used, and taken to behave where its manual leaves room."""

    monitors: Mapping[MonitorName, float] = {}
    """Monitors to publish, with their rates in Hz."""
    audit_s: float = Field(default=45.0, ge=0, le=86_400)
    """Seconds in which each parameter is read once, to find foreign changes and resets; 0 never."""
    eeprom_write: EepromWrite = EepromWrite.ALLOW
    """Permission to write EEPROM: deny forbids it; with allow a request that names it writes it."""
    eeprom_budget: int = Field(default=9000, ge=0, le=10_000)
    """Writes of the drive's EEPROM, all parameters together, until further ones are refused; it endures 10,000."""
    planned_response_s: float = Field(default=0.02, ge=0, le=5)
    """Time to an answer as a rule, for the plan; the 0.2 s of the manual would leave no room."""
    first_character_s: float = Field(default=RESPONSE_S, gt=0, le=5)
    """The longest wait for a reply; the manual says 0.2 s."""
    encoder_counts_per_rev: int = Field(default=8000, gt=0)  # divides in manual 4, "Unit conversion"
    """Pulses of the feedback counter in one turn."""
    run_active_low: bool = True  # manual 3, 8005H, gives bits, not their levels; this one and the next two are inferred
    """RUN is on at 0."""
    reset_active_low: bool = True
    """RESET is on at 0."""
    alarm_output_high: bool = True
    """/ALM is 1 in alarm."""
    inp_active_low: bool | None = None  # neither the manual nor its relatives tell it
    """INP is on at 0; not known without it."""
    bkir_active_low: bool | None = None  # likewise
    """BKIR is on at 0; not known without it."""
    trace: SmartStepTraceConfig = SmartStepTraceConfig()
    """How its recorder is taken to work."""

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, document: object) -> object:
        if isinstance(document, dict) and document.get("eeprom_write") == "confirm":
            raise ValueError('eeprom_write: "confirm" never differed from "allow"; use "allow" or "deny"')
        return document

    @model_validator(mode="after")
    def _rates(self) -> Self:
        for name, rate in self.monitors.items():
            if not 0 <= rate <= 100:  # noqa: PLR2004 - a word takes 29 ms at least
                raise ValueError(f"monitors.{name}: {rate} Hz is not 0 to 100")
        return self


@dataclass(frozen=True, slots=True)
class SmartStepProfile:
    """How one drive is taken to behave.

    Attributes:
        gap_s: the longest silence inside a reply.
        quiet_s: silence before each command.
        attempts: how often a repeatable command is sent in all; like `gap_s` and `quiet_s` it is for the line's owner.
        unit: what is configured of it.
    """

    framing: Framing = Framing.SEVEN_EVEN  # manual 2.1; soft parity for adapters that cannot make it
    wiring: Wiring = Wiring.FOUR_WIRE  # manual 1.1 has no other; on two wires a drive may take its replies for commands
    echo: Echo = Echo.NONE  # not in the manual: on four wires the host's receiver is on the other pair
    gap_s: float = 0.06  # manual 2.1 gives no such time, nor the next one
    quiet_s: float = 0.005
    attempts: int = 3
    unit: SmartStepUnitConfig = field(default_factory=SmartStepUnitConfig)

    @property
    def trigger_word(self) -> TriggerWordSource:
        """Where the drive's own trigger comes from."""
        return TriggerWordSource.CONFIGURED if self.unit.trace.trigger_map else TriggerWordSource.NONE

    def with_trace(self, **assumed: object) -> "SmartStepProfile":
        """Return it with other assumptions about its traces."""
        return self.with_unit(trace=self.unit.trace.model_copy(update=assumed))

    def with_unit(self, **assumed: object) -> "SmartStepProfile":
        """Return it with other assumptions about the drive."""
        return replace(self, unit=self.unit.model_copy(update=assumed))


SMARTSTEP = SmartStepProfile()
