"""Open questions of the SmartStep manual: assumptions as switches, with the confidence of each default.

The manual lost its figures and has misprints. A profile says how one drive is taken to behave; each switch that rests
on inference is an assumption with a name, a default, and a way to verify it on the drive.
Source: manual, all chapters; where it is silent, public manuals of related drives.
"""

from dataclasses import dataclass, replace
from enum import Enum, StrEnum

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.parameters import AssumptionInfo


class Confidence(Enum):
    """Where a fact comes from, strongest first."""

    STATED = "S"
    """The manual says so."""
    CORRECTED = "S*"
    """The manual says so through an evident misprint."""
    RELATED = "X"
    """A public manual of a related drive says so."""
    INFERRED_HIGH = "I-high"
    INFERRED_MEDIUM = "I-med"
    INFERRED_LOW = "I-low"
    RECOLLECTED = "M"
    """No source was found; a hint for people, never a reason to refuse."""
    OPEN = "?"


class Verification(StrEnum):
    """The result of a test of an assumption on the drive."""

    ASSUMED = "assumed"
    VERIFIED = "verified"
    CONTRADICTED = "contradicted"


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


@dataclass(frozen=True, slots=True)
class TriggerMap:
    """The bits of the trigger condition word, found on a bench; there is no default.

    Attributes:
        trace1: object code of trace 1's data, `trace2` that of trace 2's, `io` that of the I/O data.
        rising: enable bit of the rising edge, `falling` that of the falling edge.
    """

    trace1: int
    trace2: int
    io: int
    rising: int
    falling: int


@dataclass(frozen=True, slots=True)
class Assumption:
    """One uncertain item.

    Attributes:
        key: the profile field that switches it, or a name of its own where no switch is possible.
        confidence: of the default.
    """

    key: str
    question: str
    confidence: Confidence
    verification: Verification = Verification.ASSUMED


ASSUMPTIONS: tuple[Assumption, ...] = (
    Assumption("framing", "does the adapter make 7E1 characters, or ldcnd", Confidence.STATED),
    Assumption("wiring", "four wires; does a drive on two hear itself", Confidence.STATED),
    Assumption("echo", "does the host hear its own characters", Confidence.INFERRED_HIGH),
    Assumption(
        "first_character_s", "0.2 s run from the command's CR to the first reply character", Confidence.INFERRED_MEDIUM
    ),
    Assumption("string_checksum", "the header alone is covered", Confidence.INFERRED_MEDIUM),
    Assumption("string_count_unit", "the count counts bytes of memory", Confidence.INFERRED_HIGH),
    Assumption("trace_chunk_bytes", "the longest string is not given", Confidence.OPEN),
    Assumption("trace_word_layout", "bit 15 is the I/O bit, the value has 15 bits", Confidence.INFERRED_MEDIUM),
    Assumption("trace_byte_order", "the high byte comes first", Confidence.INFERRED_HIGH),
    Assumption("trigger_word", "0000H means no trigger; other bits unknown", Confidence.INFERRED_HIGH),
    Assumption("command_pulse_gear", "numerator over denominator", Confidence.INFERRED_MEDIUM),
    Assumption("encoder_counts_per_rev", "8000, the divisor of the printed speed formula", Confidence.INFERRED_HIGH),
    Assumption("trace_full_scale", "8701H and 8702H take settings", Confidence.INFERRED_LOW),
    Assumption("alarm_91_92", "91 and 92 are warnings unless /ALM is active", Confidence.INFERRED_MEDIUM),
    Assumption("run_active_low", "RUN is on while its bit is 0", Confidence.INFERRED_MEDIUM),
    Assumption("reset_active_low", "RESET is on while its bit is 0", Confidence.INFERRED_MEDIUM),
    Assumption("alarm_output_high", "/ALM is 1 in alarm", Confidence.INFERRED_MEDIUM),
    Assumption("eeprom_changes_ram", "does an EEPROM write change the RAM value at once", Confidence.OPEN),
    Assumption("unit_digit", "Pn000.2 is bits 11 to 8", Confidence.INFERRED_HIGH),
    Assumption("switches_rule", "switch 6 off: switches overrule parameters", Confidence.RECOLLECTED),
    Assumption("atomic_counter", "a string reference reads both counter halves at one instant", Confidence.OPEN),
    Assumption("untriggered_start", "an untriggered trace starts at point 0", Confidence.INFERRED_HIGH),
    Assumption("alarm_history_order", "history entry 0 is the newest", Confidence.INFERRED_MEDIUM),
)


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
    """

    framing: Framing = Framing.SEVEN_EVEN
    wiring: Wiring = Wiring.FOUR_WIRE
    echo: Echo = Echo.NONE
    first_character_s: float = RESPONSE_S
    gap_s: float = 0.06
    quiet_s: float = 0.005
    attempts: int = 3
    eeprom_write: EepromWrite = EepromWrite.ALLOW
    string_checksum: StringChecksum = StringChecksum.AUTO
    string_count_unit: CountUnit = CountUnit.BYTES
    trace_chunk_bytes: int = 200
    trace_verify: bool = True
    trace_word_layout: TraceWordLayout = TraceWordLayout.MSB_IO
    trace_byte_order: ByteOrder = ByteOrder.BIG
    trigger_map: TriggerMap | None = None
    command_pulse_gear: CommandPulseGear = CommandPulseGear.NUM_DEN
    encoder_counts_per_rev: int = 8000
    run_active_low: bool = True
    reset_active_low: bool = True
    alarm_output_high: bool = True
    assumptions: tuple[Assumption, ...] = ASSUMPTIONS

    @property
    def trigger_word(self) -> TriggerWordSource:
        """Where the drive's own trigger comes from."""
        return TriggerWordSource.CONFIGURED if self.trigger_map else TriggerWordSource.NONE

    def verified(self, key: str, verification: Verification) -> "SmartStepProfile":
        """Return this profile with the result of a test on the drive.

        Raises:
            ConfigError: no assumption has this key.
        """
        if all(assumption.key != key for assumption in self.assumptions):
            known = ", ".join(assumption.key for assumption in self.assumptions)
            raise ConfigError(f"there is no assumption {key!r}; there are {known}", value=key)
        assumptions = tuple(
            replace(each, verification=verification) if each.key == key else each for each in self.assumptions
        )
        return replace(self, assumptions=assumptions)

    def is_verified(self, key: str) -> bool:
        """Tell whether a test on the drive has confirmed what this profile says about an assumption."""
        return any(each.key == key and each.verification is Verification.VERIFIED for each in self.assumptions)


SMARTSTEP = SmartStepProfile()


def assumption_info(profile: SmartStepProfile, assumption: Assumption) -> AssumptionInfo:
    """Describe one assumption and what the profile assumes."""
    return AssumptionInfo(
        key=assumption.key,
        question=assumption.question,
        confidence=assumption.confidence.value,
        verification=assumption.verification.value,
        setting=_setting(profile, assumption.key),
    )


def _setting(profile: SmartStepProfile, key: str) -> str | None:
    value = getattr(profile, key, None)
    if value is None:
        return None
    return str(value.value if isinstance(value, Enum) else value)
