"""Simulated LDCN/NMC chains built from a specification."""

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from types import MappingProxyType

from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.drives.ldcn.profiles import (
    LS_173AP,
    LS_182AP,
    LS_231,
    PIC_IO,
    PIC_SERVO_CMC,
    PIC_SERVO_SC,
    PIC_SERVO_V1,
    PIC_SERVO_V2,
    PIC_SERVO_V3,
    PIC_SERVO_V4,
    PIC_STEP,
    SK_2310G2,
    Profile,
    Support,
)
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S
from ldcnd.sim.chain import Chain, Delivery
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.io import IoWiring, SimulatedIo, SimulatedOther
from ldcnd.sim.ldcn.machine import MachineConfig, Surroundings
from ldcnd.sim.ldcn.module import SimulatedModule
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.plant import MotorPlant

MOST_DRIFT_PPM = 50.0
"""Crystals of this quality; it makes the servo cycles of the modules slide past each other."""

MODELS = MappingProxyType(
    {
        profile.name: (profile, settings)
        for profile, settings in (
            (LS_182AP, ModuleSettings(version=20, always_obeys_global_reset=True)),
            (LS_173AP, ModuleSettings(version=1, always_obeys_global_reset=True)),
            (PIC_SERVO_V1, ModuleSettings(version=1)),
            (PIC_SERVO_V2, ModuleSettings(version=2)),
            (PIC_SERVO_V3, ModuleSettings(version=3)),
            (PIC_SERVO_V4, ModuleSettings(version=4)),
            (PIC_SERVO_CMC, ModuleSettings(version=5)),
            (PIC_SERVO_SC, ModuleSettings(version=10, always_obeys_global_reset=True, stop_clears_velocity=False)),
            (PIC_IO, ModuleSettings(version=1)),
            (PIC_STEP, ModuleSettings(version=1)),
            (LS_231, ModuleSettings(version=20)),
            (SK_2310G2, ModuleSettings(version=52)),
        )
    }
)
"""By the name of the profile: the dialect, and the default settings of the module."""
OLD_NAMES = MappingProxyType(
    {
        "ls182ap": "ls-182ap",
        "ls173ap": "ls-173ap",
        "picservo-v1": "pic-servo-v1",
        "picservo-v2": "pic-servo-v2",
        "picservo-v3": "pic-servo-v3",
        "picservo-v4": "pic-servo-v4",
        "picservo-sc": "pic-servo-sc",
        "picio": "pic-io",
        "picstep": "pic-step",
    }
)
"""Other spellings, which configurations may still have."""


def model(name: str) -> tuple[Profile, ModuleSettings]:
    """Return the dialect of a module and its default settings.

    Args:
        name: as in `MODELS` or `OLD_NAMES`.

    Raises:
        ValueOutOfRange: there is no such module.
    """
    known = MODELS.get(OLD_NAMES.get(name, name))
    if known is None:
        names = ", ".join(MODELS)
        raise ValueOutOfRange(f"simulated module {name!r} is not one of {names}", value=name, limit=names)
    return known


def _unchanged(settings: ModuleSettings) -> ModuleSettings:
    return settings


@dataclass(frozen=True, slots=True)
class ModuleSpec:
    """One module of a chain.

    Attributes:
        name: as in `MODELS`.
        plant: the machine on its shaft; modules without a motor ignore it.
        settings: None for those of `MODELS`, with phase and drift of the servo cycle drawn from the chain's seed.
        adjust: changes single settings and leaves the others as they are.
        conditions: what is wrong around the drive from the beginning; empty for modules without a motor.
        wiring: what is connected to a PIC-I/O; others ignore it.
        start_up: the byte of Hard Reset with which a PIC-SERVO SC was configured earlier; None for an erased EEPROM.
    """

    name: str
    plant: MotorPlant = field(default_factory=MotorPlant)
    settings: ModuleSettings | None = None
    adjust: Callable[[ModuleSettings], ModuleSettings] = _unchanged
    conditions: frozenset[FaultCondition] = frozenset()
    wiring: IoWiring = field(default_factory=IoWiring)
    start_up: int | None = None


@dataclass(frozen=True, slots=True)
class OutsideLevel:
    """The level of a PIC-I/O's line, 1 to 12, as it is driven from outside; `present` says high."""

    number: int


@dataclass(frozen=True, slots=True)
class Analog:
    """The value of a PIC-I/O's A/D input, 1 to 3."""

    channel: int
    value: int


@dataclass(frozen=True, slots=True)
class Jam:
    """Something that holds a part of the machine at a PIC-I/O."""

    part: str


@dataclass(frozen=True, slots=True)
class TimedEvent:
    """Something that happens to one module by itself.

    Attributes:
        at_s: the instant on the line's clock.
        place: of the module in the chain, from 1 on.
        what: a condition that begins or ends around a drive, something at the terminals of a PIC-I/O; None for the
            module's own supply.
        present: whether the condition or the jam begins, the line goes high, or the supply is switched on.
    """

    at_s: float
    place: int
    what: FaultCondition | OutsideLevel | Analog | Jam | None
    present: bool


@dataclass(frozen=True, slots=True)
class ChainSpec:
    """A chain, in the order in which its modules are given addresses.

    The first one is next to the host with Logosol drives (LS-182AP manual, "Initializing procedure"), and customarily
    furthest from it with PIC-SERVO (manual, 4.1). Nothing on the line shows which: all hear the host at once.

    Attributes:
        baud_check: bytes at another rate than a module's are garbage to it. Without it every module understands the
            host at any rate, for ports without a rate.
        seed: of the modules' phases and drifts.
        events: in any order.
        machine: what stands around the terminals of its PIC-I/Os; see `SimulatedChainConfig` for what it may hold.
    """

    modules: tuple[ModuleSpec, ...]
    baud_check: bool = True
    delivery: Delivery = Delivery.WHOLE
    faults: FaultPlan = field(default_factory=FaultPlan)
    seed: int = 1
    events: tuple[TimedEvent, ...] = ()
    machine: MachineConfig = field(default_factory=MachineConfig)


def build_chain(spec: ChainSpec) -> Chain:
    """Build the modules of a chain, all just powered up at the instant 0 of the line's clock.

    Raises:
        ValueOutOfRange: a module name is unknown, there is no module, or or an event is for none or for one to which it
            cannot happen.
    """
    if not spec.modules:
        raise ValueOutOfRange("a simulated chain needs at least one module", value=0, limit=1, nearest=1)
    dice = random.Random(spec.seed)  # noqa: S311 - reproducible on purpose
    parts = spec.machine.part
    around = [Surroundings([part for part in parts if part.module == place]) for place, _ in enumerate(spec.modules, 1)]
    modules = [_build_module(*each, dice) for each in zip(spec.modules, around, strict=True)]
    for switch in spec.machine.imbalance:
        drive = modules[switch.drive - 1]
        if isinstance(drive, SimulatedDrive):
            around[switch.module - 1].add(switch, drive)
    chain = Chain(modules, spec.faults, baud_check=spec.baud_check, delivery=spec.delivery)
    for event in spec.events:
        if not 1 <= event.place <= len(modules):
            raise ValueOutOfRange(
                f"an event is for module {event.place} of {len(modules)}", value=event.place, limit=len(modules)
            )
        chain.schedule(event.at_s, _happening(event, modules[event.place - 1]))
    return chain


def _happening(event: TimedEvent, module: SimulatedModule) -> Callable[[float], None]:
    match event.what, module:
        case None, _:
            return lambda at_s: module.power(on=event.present, at_s=at_s)
        case FaultCondition() as condition, SimulatedDrive() as drive:
            return lambda at_s: drive.set_condition(condition, present=event.present, at_s=at_s)
        case OutsideLevel(number), SimulatedIo() as io:
            return lambda at_s: io.drive_line(number, high=event.present, at_s=at_s)
        case Analog(channel, value), SimulatedIo() as io:
            return lambda at_s: io.set_adc(channel, value, at_s)
        case Jam(part), SimulatedIo() as io if part in io.around.names:
            return lambda at_s: io.jam(part, jammed=event.present, at_s=at_s)
    if isinstance(event.what, Jam):
        raise ValueOutOfRange(f"module {event.place} has no part {event.what.part}", value=event.place)
    lacking = "motor" if isinstance(event.what, FaultCondition) else "terminals"
    raise ValueOutOfRange(f"module {event.place} has no {lacking} for {event.what}", value=event.place)


def _build_module(spec: ModuleSpec, around: Surroundings, dice: random.Random) -> SimulatedModule:
    profile, default = model(spec.name)
    phase_s, drift_ppm = dice.uniform(0.0, SERVO_CYCLE_S), dice.uniform(-MOST_DRIFT_PPM, MOST_DRIFT_PPM)
    drawn = default.model_copy(update={"phase_s": phase_s, "drift_ppm": drift_ppm})
    settings = spec.adjust(spec.settings or drawn)
    if profile.support is Support.FULL:
        drive = SimulatedDrive(profile, settings, spec.plant)
        for condition in spec.conditions:
            drive.set_condition(condition, present=True, at_s=0.0)
        if spec.start_up is not None and profile.sc_extensions:
            drive.save(spec.start_up)
            drive.restore()
        return drive
    if profile is PIC_IO:
        return SimulatedIo(profile, settings, spec.wiring, around)
    return SimulatedOther(profile, settings)
