"""The configuration of simulated SmartSteps and their events, as it is written in TOML.

Shared by `[[sim]]` of a rig and by the files of `ldcnd sim --smartstep`.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from ldcnd.contract.frozen import Frozen
from ldcnd.drives.smartstep.monitors import function_switches
from ldcnd.drives.smartstep.parameters import PARAMETERS, PN000, find_parameter, parameter_at
from ldcnd.drives.smartstep.profiles import WORD, Framing, Wiring
from ldcnd.drives.toml import refuse_duplicates
from ldcnd.sim.line_config import FaultyLineConfig
from ldcnd.sim.smartstep.unit import SimulatedUnit
from ldcnd.sim.smartstep.variant import SimulatedVariant, SimulatedVariantConfig


class SmartStepEventConfig(Frozen):
    """An event of a simulated drive at an instant."""

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


class SimulatedUnitConfig(Frozen):
    """One simulated SmartStep."""

    number: int = Field(ge=0, le=15)
    """Its unit number."""
    run: bool = False
    """RUN is on."""
    pulse_rate: float = 0.0
    """Command units a second that come in from the start."""
    stored: Mapping[Annotated[str, Field(title="parameter number")], Annotated[int, Field(ge=0, le=WORD)]] = {}
    """Parameters in EEPROM, by number such as Pn102; the others have factory values."""
    worn: int = Field(default=0, ge=0, le=10_000)
    """Writes that its EEPROM has taken already; after 10,000 in all nothing is stored any more."""
    gain_switch: int = Field(default=4, ge=0, le=15)
    """Position of the gain rotary switch."""
    switches: int = Field(default=0x20, ge=0, le=0x3F)
    """Function selection switches, switch 1 in bit 0."""
    history: tuple[Annotated[int, Field(ge=0, le=WORD)], ...] = Field(default=(), max_length=10)
    """Alarm codes of its history, the newest first."""
    event: tuple[SmartStepEventConfig, ...] = ()
    """Scheduled events."""
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


class SimulatedSmartStepLineConfig(FaultyLineConfig):
    """A simulated line of SmartSteps."""

    unit: tuple[SimulatedUnitConfig, ...] = Field(min_length=1, max_length=16)
    """The drives of the line."""

    @model_validator(mode="after")
    def _different_units(self) -> Self:
        refuse_duplicates("unit", [str(unit.number) for unit in self.unit])
        return self


class SimulatedSmartStepsConfig(Frozen):
    """A file of `ldcnd sim --smartstep`."""

    unit: tuple[SimulatedUnitConfig, ...] = Field(min_length=1, max_length=16)
    """The drives of the line."""
    wiring: Wiring = Wiring.FOUR_WIRE
    """2-wire for its hazards."""
    framing: Framing = Framing.SEVEN_EVEN
    """How the host makes characters; a pseudo-terminal carries no parity bit unless the host makes it."""


def simulated_units(settings: Sequence[SimulatedUnitConfig], now_s: float) -> list[SimulatedUnit]:
    """Return the drives that a configuration describes; their events count from now on."""
    return [_unit(each, now_s) for each in settings]


def _unit(settings: SimulatedUnitConfig, now_s: float) -> SimulatedUnit:
    variant = SimulatedVariant(**settings.variant.model_dump())
    stored = {PN000: settings.number << 8}
    for name, value in settings.stored.items():
        stored[parameter_at(int(name.lower().removeprefix("pn"), 16))] = value
    unit = SimulatedUnit(variant, stored)
    drive = unit.drive
    drive.memory.worn = settings.worn
    drive.gain_switch = settings.gain_switch
    drive.switches = function_switches(settings.switches)
    drive.alarm_history[: len(settings.history)] = settings.history
    drive.set_run(now_s, on=settings.run)
    drive.set_pulse_rate(settings.pulse_rate, now_s)
    for event in sorted(settings.event, key=lambda each: each.at_s):
        unit.schedule(now_s + event.at_s, partial(_happen, unit, event))
    return unit


def _happen(unit: SimulatedUnit, event: SmartStepEventConfig, at_s: float) -> None:
    if event.power is not None:
        (unit.power_on if event.power else unit.power_off)(at_s)
    if event.reset:
        unit.drive.press_reset(at_s)
    if event.run is not None:
        unit.drive.set_run(at_s, on=event.run)
    if event.pulse_rate is not None:
        unit.drive.set_pulse_rate(event.pulse_rate, at_s)
    if event.alarm is not None:
        unit.drive.provoke(event.alarm, at_s)
