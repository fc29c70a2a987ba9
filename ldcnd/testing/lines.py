"""Simulated lines for a rig that has ports: the drives that its configuration names, and a machine on each shaft."""

import math

from ldcnd.config.rig import RigConfig
from ldcnd.config.simulated import SimulatedLineConfig
from ldcnd.contract.commands import HomeMethod
from ldcnd.contract.errors import ConfigError
from ldcnd.drives.ldcn.config import LdcnAxisConfig, LdcnBusConfig
from ldcnd.drives.line_config import SIMULATED, BusConfig
from ldcnd.drives.smartstep.config import SmartStepBusConfig
from ldcnd.sim.ldcn.simulation import (
    ENDLESS_TRAVEL_COUNTS,
    SimulatedLdcnLineConfig,
    SimulatedModuleConfig,
)
from ldcnd.sim.plant import MotorPlant, PlantConfig
from ldcnd.sim.smartstep.simulation import SimulatedSmartStepLineConfig, SimulatedUnitConfig

FITTING_KP = 350
"""The position gain that holds the default machine of the simulator well: gains ten times softer fit one that is ten
times lighter."""
SPARE_SPEED = 1.4
"""How much faster than its limit a machine can be."""
SPARE_TRAVEL = 0.1
"""How far behind a software limit the limit switch is, as a share of the travel."""


def simulated_config(config: RigConfig, *, seed: int | None = None) -> RigConfig:
    """Return a rig with simulated lines in place of ports, and nothing of it outside the process.

    A line that is simulated already stays as it is. The others get the modules of their configuration in the order of
    addresses. The machine on each shaft fits the configured gains and is somewhat faster than the configured limits;
    its limit switches are a little behind the software limits, or where homing expects them. Nothing is kept on the
    disk: `state_dir`, `captures` and the heartbeat are left out, and so are ports for old programs, whose links those
    of the real rig are.

    Args:
        config: the rig.
        seed: of everything that is drawn; that of the lines if missing.

    Raises:
        ConfigError: no simulated drives of a family.
    """
    lines: list[SimulatedLineConfig] = [
        line if seed is None else line.model_copy(update={"seed": seed}) for line in config.sim
    ]
    buses: list[BusConfig] = []
    for bus in config.bus:
        if not bus.simulated:
            lines.append(_line(bus, 1 if seed is None else seed))
            bus = bus.model_copy(update={"port": f"{SIMULATED}{bus.name}", "rs485": None})  # noqa: PLW2901 - the same line
        buses.append(bus)
    return config.model_copy(
        update={
            "bus": tuple(buses),
            "sim": tuple(lines),
            "state_dir": None,
            "heartbeat": None,
            "port": (),
            "captures": type(config.captures)(),
        }
    )


def _line(bus: BusConfig, seed: int) -> SimulatedLineConfig:
    match bus:
        case LdcnBusConfig():
            models = bus.models
            axes = {axis.address: axis for axis in bus.axis}
            return SimulatedLdcnLineConfig(
                name=bus.name,
                seed=seed,
                module=tuple(_module(models[address], axes.get(address)) for address in sorted(models)),
            )
        case SmartStepBusConfig():
            units = tuple(SimulatedUnitConfig(number=axis.address) for axis in bus.axis)
            return SimulatedSmartStepLineConfig(name=bus.name, seed=seed, unit=units)
    raise ConfigError(f"bus {bus.name}: drives of family {bus.family} are not simulated")


def _module(model: str, axis: LdcnAxisConfig | None) -> SimulatedModuleConfig:
    return SimulatedModuleConfig(model=model) if axis is None else SimulatedModuleConfig(
        model=model, travel_counts=_travel(axis), plant=_plant(axis)
    )  # fmt: skip


def _plant(axis: LdcnAxisConfig) -> PlantConfig:
    """Return a machine that is fast enough, and neither too heavy nor too light for the gains."""
    machine = MotorPlant()
    turns_per_s = machine.supply_v / machine.torque_nm_per_a / math.tau
    fastest = axis.limits.velocity or axis.velocity
    needed = SPARE_SPEED * fastest * abs(axis.signed_counts_per_unit) / turns_per_s
    counts_per_rev = max(machine.counts_per_rev, math.ceil(needed))
    kp = axis.gains.kp if axis.gains else FITTING_KP
    finer = counts_per_rev / machine.counts_per_rev
    return PlantConfig(counts_per_rev=counts_per_rev, inertia_kg_m2=machine.inertia_kg_m2 * finer * kp / FITTING_KP)


def _travel(axis: LdcnAxisConfig) -> tuple[int, int] | None:
    """Return where the limit switches are, in counts from where the axis stands when its drive is switched on."""
    low, high = axis.limits.position_min, axis.limits.position_max
    if low is None or high is None:
        return None
    spare, scale = SPARE_TRAVEL * (high - low), axis.signed_counts_per_unit
    first, last = sorted(round(end * scale) for end in (low - spare, high + spare))
    if axis.home and axis.home.method is HomeMethod.REVERSE_LIMIT:  # the names are those of the drive's inputs
        first = round(axis.home.position * scale)
    if axis.home and axis.home.method is HomeMethod.FORWARD_LIMIT:
        last = round(axis.home.position * scale)
    return max(first, ENDLESS_TRAVEL_COUNTS[0]), min(last, ENDLESS_TRAVEL_COUNTS[1])
