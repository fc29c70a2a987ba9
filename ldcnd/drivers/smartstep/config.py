"""What the configuration file says about SmartStep lines and units, beside what every line and axis has."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from ldcnd.drivers.smartstep.parameters import PARAMETERS, PN000, find_parameter
from ldcnd.drivers.smartstep.profiles import (
    ByteOrder,
    CommandPulseGear,
    CountUnit,
    EepromWrite,
    Framing,
    SmartStepProfile,
    StringChecksum,
    TraceWordLayout,
    TriggerMap,
    Verification,
    Wiring,
)
from ldcnd.model.frozen import Frozen
from ldcnd.model.samples import MonitorName

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
            trigger_map=TriggerMap(**bits.model_dump()) if bits else None,
        )


MODEL = "smartstep"
"""The one drive model of the family."""

MOTION_KEYS = ("velocity", "acceleration", "limits", "gains", "reference", "home", "pwm", "tracking", "identity")
"""Keys of an axis that only a drive with commands for motion has."""
SLOW_RATES = {"position": 1.0, "velocity": 2.0, "state": 1.0, "adc": 0.0}
"""What is asked for unless the file says otherwise: one word takes about 40 ms."""


class SmartStepLineConfig(Frozen):
    """How a line of SmartSteps is wired."""

    framing: Framing = Framing.SEVEN_EVEN
    """7e1, or 8n1-soft-parity for adapters that cannot make seven bits and parity."""
    wiring: Wiring = Wiring.FOUR_WIRE
    """4-wire as in the manual; 2-wire needs accept_two_wire."""
    accept_two_wire: bool = False
    """Two wires are known to be risky: a drive may take its own replies for commands."""
    echo: Literal["none", "expect"] = "none"
    """Whether the adapter returns what the host sends; on two wires it may."""

    @model_validator(mode="after")
    def _wires(self) -> Self:
        if self.wiring is Wiring.TWO_WIRE and not self.accept_two_wire:
            raise ValueError("wiring 2-wire is not described in the manual; set accept_two_wire = true to use it")
        if self.echo == "expect" and self.wiring is Wiring.FOUR_WIRE:
            raise ValueError("there is no echo on four wires")
        return self


class SmartStepUnitConfig(Frozen):
    """How one unit is read and written, and how it is taken to behave where its manual leaves room."""

    monitors: Mapping[MonitorName, float] = {}
    """Monitors to publish, with their rates in Hz."""
    eeprom_write: EepromWrite = EepromWrite.ALLOW
    """deny forbids it; allow: EEPROM is written when a request names it."""
    eeprom_budget: int = Field(default=9000, ge=0, le=10_000)
    """Writes of the drive's EEPROM, all parameters together, until further ones are refused; it endures 10,000."""
    planned_response_s: float = Field(default=0.02, ge=0, le=5)
    """How long it takes to answer as a rule, for the plan; the manual promises 0.2 s, which would leave no room."""
    first_character_s: float = Field(default=0.3, gt=0, le=5)
    """The longest wait for a reply; the manual says 0.2 s."""
    encoder_counts_per_rev: int = Field(default=8000, gt=0)
    """Pulses of the feedback counter in one turn."""
    run_active_low: bool = True
    """RUN is on while its input bit is 0."""
    reset_active_low: bool = True
    """RESET is on while its input bit is 0."""
    alarm_output_high: bool = True
    """/ALM is 1 in alarm."""
    trace: SmartStepTraceConfig = SmartStepTraceConfig()
    """How its recorder is taken to work."""
    verified: Mapping[str, Verification] = {}
    """What a test on the drive has said about the assumptions of its profile, by their keys."""

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, document: object) -> object:
        if isinstance(document, dict) and "settled" in document:
            raise ValueError('settled: the key is called verified now, and its value "bench_verified" is "verified"')
        if isinstance(document, dict) and document.get("eeprom_write") == "confirm":
            raise ValueError('eeprom_write: "confirm" never differed from "allow"; use "allow" or "deny"')
        return document

    @model_validator(mode="after")
    def _rates(self) -> Self:
        for name, rate in self.monitors.items():
            if not 0 <= rate <= 100:  # noqa: PLR2004 - a word takes 29 ms at least
                raise ValueError(f"monitors.{name}: {rate} Hz is not 0 to 100")
        return self


class SimulatedEventConfig(Frozen):
    """What happens to a simulated drive at an instant."""

    at_s: float = Field(ge=0)
    """Seconds after the line began."""
    run: bool | None = None
    """RUN is switched."""
    pulse_rate: float | None = None
    """The pulse input changes, command units a second."""
    alarm: int | None = Field(default=None, ge=0, le=WORD)
    """An alarm or a warning comes."""
    reset: bool = False
    """RESET is pressed."""
    power: bool | None = None
    """It is switched off or on."""


class SimulatedVariantConfig(Frozen):
    """How a simulated drive behaves where the manual leaves room; the defaults are the assumptions of the driver."""

    response_s: float = Field(default=0.01, ge=0, le=5)
    """From a command to the first character of its reply; the manual allows 0.2."""
    string_checksum: StringChecksum = StringChecksum.HEADER
    """What the checksum of a string reply covers."""
    string_count_unit: CountUnit = CountUnit.BYTES
    """What the count of a string reference counts."""
    longest_string_bytes: int = Field(default=1000, ge=2, le=1000)
    """More is an error in number of bytes."""
    trace_word_layout: TraceWordLayout = TraceWordLayout.MSB_IO
    """Where the signal's bit and the value sit in a word of the trace memory."""
    trace_byte_order: ByteOrder = ByteOrder.BIG
    """Which half of a word comes first in a string."""
    command_pulse_gear: CommandPulseGear = CommandPulseGear.NUM_DEN
    """By which way of gearing traced command pulses become the motor's speed."""
    trigger_map: TriggerMapConfig | None = None
    """The bits of the trigger condition; invented ones when missing."""
    full_scale_settable: bool = True
    """8701H and 8702H take settings."""
    eeprom_changes_ram: bool = False
    """A write to EEPROM also changes the value in use."""
    hears_itself: bool = False
    """It takes its own replies for commands."""
    run_active_low: bool = True
    """RUN is on at level 0."""
    reset_active_low: bool = True
    """RESET is on at level 0."""
    alarm_output_high: bool = True
    """/ALM is 1 in alarm."""


class SimulatedUnitConfig(Frozen):
    """One simulated SmartStep."""

    number: int = Field(ge=0, le=15)
    """Its unit number."""
    run: bool = False
    """RUN is on."""
    pulse_rate: float = 0.0
    """Command units a second that come in from the start."""
    stored: Mapping[str, Annotated[int, Field(ge=0, le=WORD)]] = {}
    """Parameters in EEPROM, by number such as Pn102; the others have factory values."""
    worn: int = Field(default=0, ge=0, le=10_000)
    """Writes that its EEPROM has taken already; after 10,000 in all nothing is stored any more."""
    gain_switch: int = Field(default=4, ge=0, le=15)
    """Position of the gain rotary switch."""
    switches: int = Field(default=0x20, ge=0, le=0x3F)
    """Function selection switches, switch 1 in bit 0."""
    history: tuple[Annotated[int, Field(ge=0, le=WORD)], ...] = Field(default=(), max_length=10)
    """Alarm codes of its history, the newest first."""
    event: tuple[SimulatedEventConfig, ...] = ()
    """What happens to it as time goes on."""
    variant: SimulatedVariantConfig = SimulatedVariantConfig()
    """How it behaves where the manual leaves room."""

    @field_validator("stored")
    @classmethod
    def _listed(cls, values: Mapping[str, int]) -> Mapping[str, int]:
        for name in values:
            found = find_parameter(name)
            if found not in PARAMETERS or found is PN000:
                raise ValueError(f"{name} is no parameter that can be stored; the unit number is `number`")
        return values


class SimulatedSmartStepsConfig(Frozen):
    """A file of `ldcnd sim --smartstep`."""

    unit: tuple[SimulatedUnitConfig, ...] = Field(min_length=1, max_length=16)
    """The drives of the line."""
    wiring: Wiring = Wiring.FOUR_WIRE
    """2-wire for its hazards."""
    framing: Framing = Framing.SEVEN_EVEN
    """How the host makes characters; a pseudo-terminal carries no parity bit unless the host makes it."""


FILLED_IN = {"velocity": 1.0, "acceleration": 1.0}


def as_axis(document: object) -> object:
    """Return an axis as the file has it, completed where the drive is a SmartStep.

    Such a drive takes no motion over its line, so keys for it are refused; what every axis must have is filled with
    values that nothing reads.

    Raises:
        ValueError: a key for motion.
    """
    if not isinstance(document, dict) or document.get("model") != MODEL:
        return document
    for key in MOTION_KEYS:
        if key in document and document[key] != FILLED_IN.get(key):  # a capture's configuration was completed before
            raise ValueError(f"{key}: a SmartStep takes no motion over its line; remove it")
    rates = document.get("rates", {})
    slow = {**SLOW_RATES, **rates} if isinstance(rates, dict) else rates
    return {**document, **FILLED_IN, "rates": slow}
