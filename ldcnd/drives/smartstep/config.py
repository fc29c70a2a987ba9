"""The configuration of SmartStep lines and units, beside what every line and axis has."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from ldcnd.contract.frozen import Frozen
from ldcnd.contract.samples import MonitorName
from ldcnd.drives.axis_config import AxisConfig, RatesConfig
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.smartstep.packet import HIGHEST_UNIT
from ldcnd.drives.smartstep.profiles import (
    ByteOrder,
    CommandPulseGear,
    CountUnit,
    Echo,
    EepromWrite,
    Framing,
    SmartStepProfile,
    StringChecksum,
    TraceWordLayout,
    TriggerMap,
    Wiring,
)


class SmartStepTraceConfig(Frozen):
    """How the trace of one unit is taken to work where its manual leaves room."""

    word_layout: TraceWordLayout = TraceWordLayout.MSB_IO
    """Place of the signal's bit and the value in a word of the trace memory; raw leaves words as they are."""
    byte_order: ByteOrder = ByteOrder.BIG
    """Half of a word that comes first in a string."""
    string_checksum: StringChecksum = StringChecksum.AUTO
    """Bytes that the checksum of a string reply covers; auto takes every variant until the drive shows which."""
    string_count_unit: CountUnit = CountUnit.BYTES
    """Unit of the count in a string reference."""
    chunk_bytes: int = Field(default=200, ge=2, le=1000)
    """How much of the memory is read at once, even; 2 ms of the line for each byte."""
    verify: bool = True
    """Read everything until two readings agree: the checksum may not cover it."""
    command_pulse_gear: CommandPulseGear = CommandPulseGear.NUM_DEN
    """Gearing of command pulses to motor speed."""
    trigger_map: TriggerMap | None = None
    """The bits of the trigger condition; without them the host watches for the trigger."""
    verified: bool = False
    """Whether the layout was compared with the drive, see `ldcnd doctor verify`; values are uncertain until then."""

    @field_validator("chunk_bytes")
    @classmethod
    def _whole_words(cls, value: int) -> int:
        if value % 2:
            raise ValueError("chunk_bytes is even: a word of the trace memory has two bytes")
        return value

    def assumed_of(self, profile: SmartStepProfile) -> SmartStepProfile:
        """Return a drive's profile with these assumptions."""
        return replace(
            profile,
            trace_word_layout=self.word_layout,
            trace_byte_order=self.byte_order,
            string_checksum=self.string_checksum,
            string_count_unit=self.string_count_unit,
            trace_chunk_bytes=self.chunk_bytes,
            trace_verify=self.verify,
            command_pulse_gear=self.command_pulse_gear,
            trigger_map=self.trigger_map,
            trace_verified=self.verified,
        )


MODEL = "smartstep"
EARLIER = 1.0
"""Velocity and acceleration that captures of earlier versions have."""
MOTION_KEYS = (
    "velocity",
    "acceleration",
    "limits",
    "gains",
    "reference",
    "home",
    "pwm",
    "tracking",
    "settle",
    "identity",
)
"""Keys of an axis that only a drive with commands for motion has."""


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
        # each reply would be compared with what was sent, and be a collision
        if self.echo == "expect" and self.wiring is Wiring.FOUR_WIRE:
            raise ValueError("there is no echo on four wires")
        return self


class SmartStepUnitConfig(Frozen):
    """How one unit is read and written, and how it is taken to behave where its manual leaves room."""

    monitors: Mapping[MonitorName, float] = {}
    """Monitors to publish, with their rates in Hz."""
    audit_s: float = Field(default=45.0, ge=0, le=86_400)
    """Period in which each parameter is read once, in seconds, to find what another program or a reset has changed;
    0 never."""
    eeprom_write: EepromWrite = EepromWrite.ALLOW
    """Permission to write EEPROM: deny forbids it; with allow, EEPROM is written when a request names it."""
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


class SlowRatesConfig(RatesConfig):
    """How often an item is published, in Hz; 0 for never. One word takes about 40 ms."""

    position: float = Field(default=1.0, ge=0, le=2000)
    """Position."""
    velocity: float = Field(default=2.0, ge=0, le=2000)
    """Velocity."""
    adc: float = Field(default=0.0, ge=0, le=2000)
    """It has no analog input."""
    state: float = Field(default=1.0, gt=0, le=2000)
    """The drive's status and state; cannot be switched off, faults come with it."""


def _known_model(model: str) -> str:
    if model != MODEL:
        raise ValueError("no such drive model on a line of family smartstep; known is smartstep")
    return model


class SmartStepAxisConfig(AxisConfig):
    """One SmartStep, which takes no motion over its line."""

    model: Annotated[str, AfterValidator(_known_model)]
    """The drive model: smartstep."""
    address: int = Field(ge=0)
    """The unit number, 0 to 15."""
    rates: SlowRatesConfig = SlowRatesConfig()
    """How often each item is published."""
    smartstep: SmartStepUnitConfig = SmartStepUnitConfig()
    """Settings of a SmartStep only."""

    @model_validator(mode="before")
    @classmethod
    def _without_motion(cls, document: object) -> object:
        """Refuse keys for motion."""
        for key in MOTION_KEYS:
            if isinstance(document, dict) and document.get("model") == MODEL and key in document:
                if key in {"velocity", "acceleration"} and document[key] in {0.0, EARLIER}:
                    document = {name: value for name, value in document.items() if name != key}
                    continue
                raise ValueError(f"{key}: a SmartStep takes no motion over its line; remove it")
        return document

    @field_validator("address")
    @classmethod
    def _is_a_unit(cls, address: int) -> int:
        if address > HIGHEST_UNIT:
            raise ValueError("a SmartStep has a unit number from 0 to 15")
        return address


class SmartStepBusConfig(BusConfig):
    """One line of SmartSteps; its rate is always 9600."""

    skips_by_default: ClassVar[bool] = True

    family: Literal["smartstep"]
    """The drive family on it."""
    smartstep: SmartStepLineConfig = SmartStepLineConfig()
    """How the line is wired."""
    axis: tuple[SmartStepAxisConfig, ...] = Field(min_length=1, max_length=31)
    """The drives that are axes."""

    @model_validator(mode="after")
    def _released_transmitters(self) -> Self:
        if len(self.axis) > 1 and any(axis.address == 0 for axis in self.axis):
            raise ValueError("unit 0 never releases its transmitter: it must be alone on its line")
        return self

    @model_validator(mode="after")
    def _known_echo(self) -> Self:
        echo = self.smartstep.echo == "expect"
        if self.rs485 and self.smartstep.wiring is Wiring.TWO_WIRE and echo is not self.rs485.receive_own:
            raise ValueError('rs485: on two wires receive_own = true goes with echo = "expect", false with "none"')
        return self

    def profile(self, axis: SmartStepAxisConfig) -> SmartStepProfile:
        """Return how one of its drives is taken to behave."""
        line, unit = self.smartstep, axis.smartstep
        profile = SmartStepProfile(
            framing=line.framing,
            wiring=line.wiring,
            echo=Echo(line.echo),
            first_character_s=unit.first_character_s,
            eeprom_write=unit.eeprom_write,
            encoder_counts_per_rev=unit.encoder_counts_per_rev,
            run_active_low=unit.run_active_low,
            reset_active_low=unit.reset_active_low,
            alarm_output_high=unit.alarm_output_high,
        )
        return unit.trace.assumed_of(profile)
