"""The configuration of a simulated LDCN/NMC line and its events, as it is written in TOML.

Shared by `[[sim]]` of a rig and by the files of `ldcnd sim`. Defaults are those of `MODELS` and of `MotorPlant`: what
is left out here is left to them.
"""

from dataclasses import replace
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from ldcnd.contract.frozen import Frozen
from ldcnd.drives.ldcn.pic_io import LINES
from ldcnd.drives.ldcn.profiles import PIC_IO, Support, identify
from ldcnd.sim.chain import Delivery
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.ldcn.chain import MODELS, OLD_NAMES, Analog, ChainSpec, ModuleSpec, OutsideLevel, TimedEvent
from ldcnd.sim.ldcn.io import IoWiring
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.line_config import FaultyLineConfig, SimulatedFaultConfig
from ldcnd.sim.plant import MotorPlant

ENDLESS_TRAVEL_COUNTS = (-(1 << 30), 1 << 30)


def _known_module(model: str) -> str:
    name = OLD_NAMES.get(model, model)
    if name not in MODELS:
        raise ValueError(f"no such simulated module; known are {', '.join(MODELS)}")
    return name


ModuleName = Annotated[str, AfterValidator(_known_module)]
"""A module as in `ldcnd sim --chain`."""
LineNumber = Annotated[int, Field(ge=1, le=LINES)]
Byte = Annotated[int, Field(ge=0, le=255)]
CountRange = tuple[int, int]


def _rising(span: CountRange | None) -> CountRange | None:
    if span is not None and span[0] >= span[1]:
        raise ValueError(f"the first number must be below the second, not {span[0]} and {span[1]}")
    return span


class PlantConfig(Frozen):
    """The machine on a shaft; what is left out is a small servo motor, 3000 1/min at 24 V."""

    counts_per_rev: int | None = Field(default=None, gt=0)
    """Encoder counts of a revolution; 2000 when left out."""
    supply_v: float | None = Field(default=None, gt=0, le=100)
    """Voltage at full duty; 24."""
    resistance_ohm: float | None = Field(default=None, gt=0)
    """Resistance of the winding, in ohms; 1.2."""
    torque_nm_per_a: float | None = Field(default=None, gt=0)
    """Torque constant, and back EMF constant in V s/rad; 0.0767."""
    inertia_kg_m2: float | None = Field(default=None, gt=0)
    """Inertia of motor and load, in kg m2; 5e-5."""
    viscous_nm_s: float | None = Field(default=None, gt=0)
    """Viscous friction per rad/s; 1e-5."""
    friction_nm: float | None = Field(default=None, ge=0)
    """Coulomb friction, also at standstill; 0.004."""
    stop_margin_counts: int | None = Field(default=None, ge=0)
    """Distance of the hard stops behind the limit switches; 2000."""
    index_at_counts: int | None = None
    """Position at which an index pulse begins, in counts; 700."""
    index_spacing_counts: int | None = Field(default=None, gt=0)
    """Distance from one index pulse to the next, in counts; a revolution when left out."""
    index_width_counts: int | None = Field(default=None, gt=0)
    """How long a pulse is; 4. Firmware samples it once per servo cycle and may miss it."""
    pot_span_counts: Annotated[CountRange | None, AfterValidator(_rising)] = None
    """The potentiometer turns from 0 to full scale over this range."""
    pot_noise: float | None = Field(default=None, ge=0, le=1)
    """Standard deviation of its reading, as a share of full scale."""
    load_nm: float | None = None
    """Torque of a hanging load, positive when it pulls forward; 0."""
    delay_s: float | None = Field(default=None, ge=0, le=0.1)
    """Dead time from a change of the output to the torque: the amplifier and the motor's inductance; 0."""
    backlash_counts: float | None = Field(default=None, ge=0)
    """Lost motion between the motor and the encoder, which sits on the load; 0."""
    motor_reversed: bool | None = None
    """Whether the motor's leads are swapped: a positive output turns it in reverse. Then no position loop holds."""
    phase_lost: bool | None = None
    """Whether it is a brushless motor behind Hall sensors with one phase open: no torque in two thirds of a turn."""
    pole_pairs: int | None = Field(default=None, ge=1, le=100)
    """Electrical turns in a revolution of such a motor; 4."""
    encoder_disconnected: bool | None = None
    """Whether the counter stands still while the shaft turns, and the drive does not notice."""
    coupling_grip: float | None = Field(default=None, ge=0, le=1)
    """Share of the motor's way that reaches the encoder and the load; below 1 the coupling slips; 1."""
    limits_swapped: bool | None = None
    """Whether each limit switch is wired to the input of the other one."""


class IoConfig(Frozen):
    """Wiring of a PIC-I/O."""

    low: tuple[LineNumber, ...] = ()
    """Lines held low from outside; the others are pulled up."""
    wires: tuple[tuple[LineNumber, LineNumber], ...] = ()
    """Pairs of a line and the line that it drives while it is an output."""
    inverted_wires: tuple[tuple[LineNumber, LineNumber], ...] = ()
    """The same, driven to the opposite level: of the two sensors of a cylinder one sees what the other does not."""
    adc: tuple[Byte, Byte, Byte] = (0, 0, 0)
    """Values of the three A/D inputs, 0 to 255 for 0 to 5 V."""
    pulses_hz: float = Field(default=0.0, ge=0, le=4_000_000)
    """A square wave at I/O 10, for the counter."""

    def wiring(self) -> IoWiring:
        """Return what the simulator builds."""
        wires = {driven: driver for driver, driven in self.wires}
        inverted = {driven: driver for driver, driven in self.inverted_wires}
        return IoWiring(frozenset(self.low), wires, self.adc, self.pulses_hz, inverted)

    @model_validator(mode="after")
    def _one_driver(self) -> Self:
        driven = [line for _, line in (*self.wires, *self.inverted_wires)]
        for line in driven:
            if driven.count(line) > 1:
                raise ValueError(f"wires, inverted_wires: line {line} is driven by more than one line")
        return self


class SimulatedModuleConfig(Frozen):
    """One simulated module and the machine on its shaft."""

    model: ModuleName
    """Module name as in `ldcnd sim --chain`."""
    travel_counts: Annotated[CountRange | None, AfterValidator(_rising)] = None
    """Positions of the limit switches, in counts from the power-up position; endless when left out."""
    plant: PlantConfig = PlantConfig()
    """Constants of the machine."""
    behaviour: ModuleSettings = ModuleSettings()
    """Behaviour where the manuals allow variants."""
    conditions: tuple[FaultCondition, ...] = ()
    """Faults around the drive at power-up."""
    start_up: Byte | None = None
    """The byte of Hard Reset with which a PIC-SERVO SC was configured earlier; left out, its EEPROM is erased."""
    io: IoConfig | None = None
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
        travel = MotorPlant(reverse_limit_counts=reverse, forward_limit_counts=forward, seed=seed)

        def adjust(settings: ModuleSettings) -> ModuleSettings:
            return settings.model_copy(update=given)

        plant = replace(travel, **self.plant.model_dump(exclude_none=True))
        wiring = self.io.wiring() if self.io else IoWiring()
        return ModuleSpec(
            self.model,
            plant,
            adjust=adjust,
            conditions=frozenset(self.conditions),
            wiring=wiring,
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

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        if sum(each is not None for each in (self.begins, self.ends, self.power, self.line, self.adc)) != 1:
            raise ValueError("an event needs exactly one of begins, ends, power, line, adc")
        if (self.line is None) is not (self.level is None):
            raise ValueError("line and level belong together")
        if (self.adc is None) is not (self.value is None):
            raise ValueError("adc and value belong together")
        return self

    @property
    def concerns_terminals(self) -> bool:
        """Whether it happens to a PIC-I/O."""
        return self.line is not None or self.adc is not None

    def spec(self, starts_at_s: float) -> TimedEvent:
        """Return what the simulator plays."""
        what: FaultCondition | OutsideLevel | Analog | None = self.begins or self.ends
        if self.line is not None:
            what = OutsideLevel(self.line)
        elif self.adc is not None and self.value is not None:
            what = Analog(self.adc, self.value)
        present = self.begins is not None or self.power == "on" or self.level == "high"
        return TimedEvent(starts_at_s + self.at_s, self.module, what, present=present)


class SimulatedChainConfig(Frozen):
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
