"""How one drive is taken to behave where its manual leaves room.

The manual lost its figures and has misprints. Each field of a profile stands for a place where it is silent or
contradicts itself; the comment at the field says where the default comes from. `ldcnd doctor verify` compares what
bears on traces with the drive; the values of its traces are uncertain until then.
Source: manual, all chapters; where it is silent, public manuals of related drives.
"""

from dataclasses import dataclass
from enum import StrEnum

from pydantic import Field

from ldcnd.contract.frozen import Frozen


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


RESPONSE_S = 0.3
"""A drive answers within 0.2 s (manual 2.1), taken as command CR to first reply character, plus 0.1 s of margin."""


@dataclass(frozen=True, slots=True)
class SmartStepProfile:
    """How one drive is taken to behave.

    Attributes:
        first_character_s: the longest wait from the end of a command to its reply.
        gap_s: the longest silence inside a reply.
        quiet_s: silence before each command.
        attempts: how often a repeatable command is sent in all; like `gap_s` and `quiet_s` it is for the line's owner.
        trace_chunk_bytes: 2 to 1000, even.
        trace_verify: read each chunk twice; the string checksum may not cover the data.
        trace_verified: the layout, byte order and gear of traces were compared with this drive.
    """

    framing: Framing = Framing.SEVEN_EVEN  # manual 2.1; soft parity for adapters that cannot make it
    wiring: Wiring = Wiring.FOUR_WIRE  # manual 1.1 has no other; on two wires a drive may take its replies for commands
    echo: Echo = Echo.NONE  # not in the manual: on four wires the host's receiver is on the other pair
    first_character_s: float = RESPONSE_S
    gap_s: float = 0.06  # manual 2.1 gives no such time, nor the next one
    quiet_s: float = 0.005
    attempts: int = 3
    eeprom_write: EepromWrite = EepromWrite.ALLOW
    string_checksum: StringChecksum = StringChecksum.AUTO  # manual 2.2: its place is given, not what it covers
    string_count_unit: CountUnit = CountUnit.BYTES  # manual 2.2 says "data count"; 1000 addresses hold 500 points
    trace_chunk_bytes: int = 200  # manual 2.2 gives no longest string
    trace_verify: bool = True
    trace_word_layout: TraceWordLayout = TraceWordLayout.MSB_IO  # the figure of manual 4 (9) is lost
    trace_byte_order: ByteOrder = ByteOrder.BIG  # manual 4 (9) is silent; words of commands have the high byte first
    trigger_map: TriggerMap | None = None  # the figure of manual 4 (7) is lost
    command_pulse_gear: CommandPulseGear = CommandPulseGear.NUM_DEN  # manual 4, "Unit conversion", has it both ways
    encoder_counts_per_rev: int = 8000  # the divisor of the speed formula, manual 4, "Unit conversion"
    trace_verified: bool = False
    run_active_low: bool = True  # manual 3, 8005H, gives bits, not their levels; this one and the next two are inferred
    reset_active_low: bool = True
    alarm_output_high: bool = True

    @property
    def trigger_word(self) -> TriggerWordSource:
        """Where the drive's own trigger comes from."""
        return TriggerWordSource.CONFIGURED if self.trigger_map else TriggerWordSource.NONE


SMARTSTEP = SmartStepProfile()
