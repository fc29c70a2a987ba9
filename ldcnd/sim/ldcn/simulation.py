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
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S
from ldcnd.drives.simulated_line import SimulatedFaultConfig, SimulatedLineConfig
from ldcnd.sim.chain import Delivery
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.ldcn.chain import MODELS, OLD_NAMES, Analog, ChainSpec, Line, ModuleSpec, TimedEvent
from ldcnd.sim.ldcn.io import IoWiring
from ldcnd.sim.ldcn.power import Condition
from ldcnd.sim.ldcn.quirks import (
    AnalogEnd,
    CommandBuffer,
    ExcludedOptions,
    HalfPoint,
    LimitInPath,
    ModuleSettings,
    PathOverflow,
    PathWithoutServo,
    PositionErrorClearing,
    RelativeTo,
    ResetInMotion,
    UnknownBaud,
)
from ldcnd.sim.plant import MotorPlant

MOST_DRIFT_PPM = 30_000.0
"""Beyond any crystal: with the 3.3 % by which the printed divisor misses 57600, a drive no longer follows that rate."""
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


class Quirks(Frozen):
    """How one module behaves where manuals and data sheets leave room; what is left out is as the model has it."""

    version: int | None = Field(default=None, ge=0, le=255)
    """Second byte of its identity."""
    clock_hz: int | None = Field(default=None, ge=10_000_000, le=20_000_000)
    """Its clock, PIC-SERVO up to version 5; servo cycle and rates follow it. 20 MHz when left out."""
    phase_s: float | None = Field(default=None, ge=0, lt=SERVO_CYCLE_S)
    """Phase of its servo cycles, in seconds; drawn from the seed when left out."""
    drift_ppm: float | None = Field(default=None, ge=-MOST_DRIFT_PPM, le=MOST_DRIFT_PPM)
    """How much longer its servo cycles and its bits are than nominal; drawn from the seed when left out."""
    reply_latency_s: float | None = Field(default=None, ge=0, le=10)
    """Added between the end of the servo cycle and the reply."""
    reset_dead_s: float | None = Field(default=None, ge=0, le=10)
    """How long it is deaf after Hard Reset and power-up; 0.001. A host that takes a port for drained as soon as it has
written needs 0: a terminal does not wait for the line."""
    always_obeys_global_reset: bool | None = None
    """Whether Hard Reset to FF is obeyed in any group, or only in group FF."""
    yields_to_host: bool | None = None
    """Whether it drops its reply as soon as the host sends."""
    command_buffer: CommandBuffer | None = None
    """Effect of a new packet on a command that has not been executed yet."""
    address_in_latched: bool | None = None
    """Whether it receives the host's packets once it has an address, whatever the level of its address input."""
    unknown_baud: UnknownBaud | None = None
    """Effect of an unlisted code of Set Baud Rate on PIC-SERVO SC."""
    undefined_status_bits: int | None = Field(default=None, ge=0, le=255)
    """Set in a PIC-I/O's status byte, of which only bit 1 is defined."""
    undefined_level_bits: int | None = Field(default=None, ge=0, le=15)
    """The upper half of a PIC-I/O's second input byte."""
    synch_output_once: bool | None = None
    """Whether a PIC-I/O applies stored outputs once, or with each Synch Output."""
    counter_cleared_by_mode: bool | None = None
    """Whether Set Timer Mode sets a PIC-I/O's counter to 0."""
    stop_clears_velocity: bool | None = None
    """Whether stopping smoothly or abruptly sets the velocity register to 0."""
    position_error_clearing: PositionErrorClearing | None = None
    """Event that clears the position error bit: Clear Sticky Bits only, or closing the loop, too."""
    sense_counts_per_a: float | None = Field(default=None, ge=0)
    """A/D counts per ampere of motor current, PIC-SERVO."""
    encoder_counts_per_s: float | None = Field(default=None, ge=0)
    """Faster encoder transitions are lost; the model's rate when left out, 0 for no limit."""
    analog_end: AnalogEnd | None = None
    """Whether a motion to an analog target begins to stop at the exact value only, or also behind it."""
    peak_current_a: float | None = Field(default=None, ge=0)
    """The motor current cannot exceed it, Logosol; 0 for no limit."""
    overload_s: float | None = Field(default=None, gt=0)
    """How long a Logosol drive limits its current without a pause before it trips."""
    deadband_at_zero: bool | None = None
    """Whether deadband compensation is also added to an output of 0."""
    il_times_256: bool | None = None
    """Whether the integral sum is bounded by 256 times IL or by IL."""
    velocity_sign: Literal[-1, 1] | None = None
    """Sign of the velocity item while the motor runs forward; the model's when left out."""
    relative_to: RelativeTo | None = None
    """Command position to which a relative goal is added, PIC-SERVO SC: that of the load or of the start."""
    reset_in_motion: ResetInMotion | None = None
    """Effect of Reset Position on the goal of a move that is under way."""
    home_shifts: bool | None = None
    """Whether Reset Position also shifts the captured home position."""
    aux_after_reset: bool | None = None
    """Whether auxiliary bit 4 is set after a reset, PIC-SERVO SC."""
    path_overflow: PathOverflow | None = None
    """Effect of path points that exceed the buffer."""
    half_point: HalfPoint | None = None
    """Effect of an odd byte after path points."""
    path_without_servo: PathWithoutServo | None = None
    """Behaviour of path mode while the servo is off."""
    path_takes_points_in_motion: bool | None = None
    """Whether path points are taken during another motion, too."""
    path_starts_empty: bool | None = None
    """Whether a start with an empty buffer begins a path with the first point that comes."""
    path_restarts: bool | None = None
    """Whether another start goes on to the next point at once."""
    path_cleared_by_stop: bool | None = None
    """Whether Stop Motor clears the path points that are left."""
    path_cleared_by_fault: bool | None = None
    """Whether the servo being switched off by an error does."""
    path_counts_point_under_way: bool | None = None
    """Whether the number of points left includes the one under way."""
    path_ends_with_buffer: bool | None = None
    """Whether PATH_MODE falls when the last point begins, or when it ends."""
    path_rate_at_load: bool | None = None
    """Whether the fast path option counts when a point is loaded, or when it begins."""
    path_move_done: bool | None = None
    """Whether MOVE_DONE is set during a path."""
    path_slew: bool | None = None
    """Whether auxiliary bit 4 is set during a path."""
    path_ignores_divisor: bool | None = None
    """Whether the servo rate divisor of a CMC leaves its path as it is."""
    path_ended_by_enable: bool | None = None
    """Whether Stop Motor with the enable bit alone ends a path."""
    excluded_options: ExcludedOptions | None = None
    """Effect of options of I/O Control that exclude each other, PIC-SERVO SC."""
    gains_keep_multiplier: bool | None = None
    """Whether Set Gain without a step multiplier leaves that as it is, PIC-SERVO SC."""
    steps_hz: float | None = Field(default=None, ge=-1_000_000, le=1_000_000)
    """A pulse train at the step input of PIC-SERVO SC, negative in reverse."""
    limit_in_path: LimitInPath | None = None
    """Effect of limit protection on a path, PIC-SERVO SC."""
    advanced_sticky: bool | None = None
    """Whether a CMC keeps its advanced features when a later Stop Motor lacks their bit."""
    items_before_advanced: bool | None = None
    """Whether a CMC sends status items 6 and 7 before its advanced features are on."""


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
    behaviour: Quirks = Quirks()
    """Behaviour where the manuals allow variants."""
    conditions: tuple[Condition, ...] = ()
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
        if version is not None and version not in profile.versions:
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
        given = self.behaviour.model_dump(exclude_none=True)
        reverse, forward = self.travel_counts or ENDLESS_TRAVEL_COUNTS
        travel = MotorPlant(reverse_limit_counts=reverse, forward_limit_counts=forward, seed=seed)

        def adjust(settings: ModuleSettings) -> ModuleSettings:
            return replace(settings, **given)

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


class SimulatedEventConfig(Frozen):
    """Something that happens to one module at a given time."""

    at_s: float = Field(ge=0)
    """Seconds after the line was opened first."""
    module: int = Field(ge=1, le=31)
    """Its place in the chain, from 1 on, in the order of addresses."""
    begins: Condition | None = None
    """Fault condition that starts."""
    ends: Condition | None = None
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
        what: Condition | Line | Analog | None = self.begins or self.ends
        if self.line is not None:
            what = Line(self.line)
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
    event: tuple[SimulatedEventConfig, ...] = ()
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


class SimulatedLdcnLineConfig(SimulatedChainConfig, SimulatedLineConfig):
    """A simulated line of modules."""

    module: tuple[SimulatedModuleConfig, ...] = Field(min_length=1, max_length=31)
    """In daisy-chain order."""
