"""The configuration of SmartStep lines and units, beside what every line and axis has."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator
from typing_extensions import override

from ldcnd.contract.frozen import Frozen
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.axis_config import AxisConfig, RatesConfig
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.smartstep.packet import HIGHEST_UNIT
from ldcnd.drives.smartstep.profiles import (
    Echo,
    Framing,
    SmartStepProfile,
    SmartStepUnitConfig,
    Wiring,
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

    @property
    def read_hz(self) -> Mapping[TelemetryItem, float]:
        """How often each item is read, in Hz: two positions prove that it stands, so none is left out of its state."""
        return {
            TelemetryItem.STATE: self.state,
            TelemetryItem.VELOCITY: self.velocity or self.state,
            TelemetryItem.POSITION: self.position or self.state,
        }

    @property
    @override
    def proven_hz(self) -> float:
        return min(self.read_hz.values())

    @property
    @override
    def slowest(self) -> str:
        return " and ".join(item for item, rate_hz in self.read_hz.items() if rate_hz == self.proven_hz)


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
        line = self.smartstep
        return SmartStepProfile(framing=line.framing, wiring=line.wiring, echo=Echo(line.echo), unit=axis.smartstep)
