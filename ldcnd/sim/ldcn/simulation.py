"""The configuration of a simulated LDCN/NMC line and its events, as it is written in TOML.

Shared by `[[sim]]` of a rig and by the files of `ldcnd sim`. Defaults are those of `MODELS` and of `MotorPlant`: what
is left out here is left to them.
"""

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from ldcnd.contract.frozen import Frozen
from ldcnd.drives.ldcn.profiles import PIC_IO, Support, identify
from ldcnd.sim.chain import Delivery
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.ldcn.chain import MODELS, OLD_NAMES, Analog, ChainSpec, Jam, ModuleSpec, OutsideLevel, TimedEvent
from ldcnd.sim.ldcn.io import Byte, IoWiring
from ldcnd.sim.ldcn.machine import LineNumber, MachineConfig
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.line_config import FaultyLineConfig, SimulatedFaultConfig
from ldcnd.sim.plant import MotorPlant, PlantConfig, RisingRange

ENDLESS_TRAVEL_COUNTS = (-(1 << 30), 1 << 30)


def _known_module(model: str) -> str:
    name = OLD_NAMES.get(model, model)
    if name not in MODELS:
        raise ValueError(f"no such simulated module; known are {', '.join(MODELS)}")
    return name


ModuleName = Annotated[str, AfterValidator(_known_module)]
"""A module as in `ldcnd sim --chain`."""


class SimulatedModuleConfig(Frozen):
    """One simulated module and the machine on its shaft."""

    model: ModuleName
    """Module name as in `ldcnd sim --chain`."""
    travel_counts: RisingRange | None = None
    """Positions of the limit switches, in counts from the power-up position; endless when left out."""
    plant: PlantConfig = PlantConfig()
    """Constants of the machine."""
    behaviour: ModuleSettings = ModuleSettings()
    """Behaviour where the manuals allow variants."""
    conditions: tuple[FaultCondition, ...] = ()
    """Faults around the drive at power-up."""
    start_up: Byte | None = None
    """The byte of Hard Reset with which a PIC-SERVO SC was configured earlier; left out, its EEPROM is erased."""
    io: IoWiring | None = None
    """Wiring of a PIC-I/O."""

    @property
    def is_drive(self) -> bool:
        """Whether it has a motor."""
        return MODELS[self.model][0].support is Support.FULL

    @property
    def has_terminals(self) -> bool:
        """Whether it is a PIC-I/O."""
        return MODELS[self.model][0] is PIC_IO

    @model_validator(mode="after")
    def _what_it_can_have(self) -> Self:
        if self.conditions and not self.is_drive:
            raise ValueError(f"conditions: a {self.model} has no motor")
        profile, version = MODELS[self.model][0], self.behaviour.version
        if "version" in self.behaviour.model_fields_set and version not in profile.versions:
            known = identify(profile.device_id, version)
            other = f"that is a {known.name}" if known else "no such device is known"
            raise ValueError(f"behaviour.version: a {self.model} has no version {version}; {other}")
        if self.start_up is not None and not profile.sc_extensions:
            raise ValueError(f"start_up: a {self.model} has no EEPROM")
        if self.io is not None and not self.has_terminals:
            raise ValueError(f"io: a {self.model} has no terminals")
        return self

    def spec(self, seed: int) -> ModuleSpec:
        """Return what the simulator builds.

        Args:
            seed: of the potentiometer's noise.
        """
        given = {name: getattr(self.behaviour, name) for name in self.behaviour.model_fields_set}
        reverse, forward = self.travel_counts or ENDLESS_TRAVEL_COUNTS
        plant = MotorPlant(
            **self.plant.model_dump(), reverse_limit_counts=reverse, forward_limit_counts=forward, seed=seed
        )

        def adjust(settings: ModuleSettings) -> ModuleSettings:
            return settings.model_copy(update=given)

        return ModuleSpec(
            self.model,
            plant,
            adjust=adjust,
            conditions=frozenset(self.conditions),
            wiring=self.io or IoWiring(),
            start_up=self.start_up,
        )


class LdcnEventConfig(Frozen):
    """Something that happens to one module at a given time."""

    at_s: float = Field(ge=0)
    """Seconds after the line was opened first."""
    module: int = Field(ge=1, le=31)
    """Its place in the chain, from 1 on, in the order of addresses."""
    begins: FaultCondition | None = None
    """Fault condition that starts."""
    ends: FaultCondition | None = None
    """Fault condition that ends."""
    power: Literal["on", "off"] | None = None
    """Supply of the module; switched on, the module starts as after a reset."""
    line: LineNumber | None = None
    """Number of a line of a PIC-I/O, which is driven to `level`."""
    adc: int | None = Field(default=None, ge=1, le=3)
    """Number of an A/D input of a PIC-I/O, which takes `value`."""
    level: Literal["high", "low"] | None = None
    """Level from outside, with `line`."""
    value: Byte | None = None
    """Reading of `adc`, 0 to 255 for 0 to 5 V."""
    jams: str | None = None
    """Part of the machine at a PIC-I/O that something holds from now on, wherever it is."""
    frees: str | None = None
    """Part that can move again."""

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        given = (self.begins, self.ends, self.power, self.line, self.adc, self.jams, self.frees)
        if sum(each is not None for each in given) != 1:
            raise ValueError("an event needs exactly one of begins, ends, power, line, adc, jams, frees")
        if (self.line is None) is not (self.level is None):
            raise ValueError("line and level belong together")
        if (self.adc is None) is not (self.value is None):
            raise ValueError("adc and value belong together")
        return self

    @property
    def concerns_terminals(self) -> bool:
        """Whether it happens to a PIC-I/O."""
        return any(each is not None for each in (self.line, self.adc, self.jams, self.frees))

    def spec(self, starts_at_s: float) -> TimedEvent:
        """Return what the simulator plays."""
        what: FaultCondition | OutsideLevel | Analog | Jam | None = self.begins or self.ends
        part = self.jams or self.frees
        if self.line is not None:
            what = OutsideLevel(self.line)
        elif self.adc is not None and self.value is not None:
            what = Analog(self.adc, self.value)
        elif part is not None:
            what = Jam(part)
        present = self.begins is not None or self.jams is not None or self.power == "on" or self.level == "high"
        return TimedEvent(starts_at_s + self.at_s, self.module, what, present=present)


class SimulatedChainConfig(MachineConfig):
    """A simulated line, in the order in which modules are given addresses."""

    seed: int = 1
    """Seed of all random values."""
    module: tuple[SimulatedModuleConfig, ...] = Field(default=(), max_length=31)
    """In daisy-chain order."""
    event: tuple[LdcnEventConfig, ...] = ()
    """Scheduled events."""
    fault: tuple[SimulatedFaultConfig, ...] = ()
    """Faults of the wires."""

    @model_validator(mode="after")
    def _possible_events(self) -> Self:
        for number, event in enumerate(self.event):
            if event.module > len(self.module):
                raise ValueError(f"event[{number}]: there is no module {event.module}, only {len(self.module)}")
            module = self.module[event.module - 1]
            if event.concerns_terminals and not module.has_terminals:
                raise ValueError(f"event[{number}]: module {event.module} is a {module.model} and has no terminals")
            if event.power is None and not event.concerns_terminals and not module.is_drive:
                raise ValueError(f"event[{number}]: module {event.module} is a {module.model} and has no motor")
            part = event.jams or event.frees
            if part and (part, event.module) not in {(each.name, each.module) for each in self.part}:
                raise ValueError(f"event[{number}]: module {event.module} has no part {part}")
        for place in {*(part.module for part in self.part), *(switch.module for switch in self.imbalance)}:
            if place > len(self.module) or not self.module[place - 1].has_terminals:
                raise ValueError(f"part, imbalance: module {place} is no pic-io")
        for switch in self.imbalance:
            if switch.drive > len(self.module) or not self.module[switch.drive - 1].is_drive:
                raise ValueError(f"imbalance: module {switch.drive} is no drive")
        return self

    def spec(
        self, *, baud_check: bool = True, delivery: Delivery = Delivery.WHOLE, starts_at_s: float = 0.0
    ) -> ChainSpec:
        """Return what the simulator builds.

        Args:
            baud_check: bytes at another rate than a module's are garbage to it.
            delivery: how reply bytes reach the host.
            starts_at_s: the instant of the line's clock from which events and faults are counted.
        """
        return ChainSpec(
            tuple(module.spec(self.seed + place) for place, module in enumerate(self.module)),
            baud_check=baud_check,
            delivery=delivery,
            faults=FaultPlan(tuple(fault.spec(starts_at_s) for fault in self.fault), self.seed),
            seed=self.seed,
            events=tuple(event.spec(starts_at_s) for event in self.event),
            machine=MachineConfig(part=self.part, imbalance=self.imbalance),
        )


class SimulationConfig(SimulatedChainConfig):
    """A file of `ldcnd sim --file`."""

    module: tuple[SimulatedModuleConfig, ...] = Field(min_length=1, max_length=31)
    """In daisy-chain order."""
    baud_check: bool = False
    """Bytes at another rate than a module's are garbage to it."""
    delivery: Delivery = Delivery.WHOLE
    """Replies reach the host in one piece, or byte by byte."""


class SimulatedLdcnLineConfig(SimulatedChainConfig, FaultyLineConfig):
    """A simulated line of modules."""

    module: tuple[SimulatedModuleConfig, ...] = Field(min_length=1, max_length=31)
    """In daisy-chain order."""
