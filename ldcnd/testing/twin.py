"""A twin: a simulated rig in the state of one that runs, on which a program is rehearsed before it moves the real one.

What it is good for: the order of things, refusals, durations of profiles, how near to a limit an axis comes. What it is
not: the mechanics on a shaft are those of the configuration's gains, or of an identified plant, so following errors are
only an order of magnitude; temperatures and supplies are none.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from ldcnd.axis.events import LatchRecalled, PlaceKnown
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.parameters import ParameterDump, ReadAllParameters
from ldcnd.contract.samples import AxisState, FaultSample, PositionSample, StateSample
from ldcnd.daemon.daemon import Daemon
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.config import LdcnAxisConfig
from ldcnd.drives.smartstep.addresses import RAM_OFFSET
from ldcnd.drives.smartstep.drive import fault_of
from ldcnd.drives.smartstep.monitors import ALARMS
from ldcnd.sim.plant import PlantConfig
from ldcnd.sim.smartstep.simulation import SimulatedSmartStepLineConfig, SimulatedUnitConfig
from ldcnd.testing.truth import Machine


@dataclass(frozen=True, slots=True)
class RigState:
    """How a rig stands at an instant.

    Attributes:
        axes: descriptions, by name.
        states: by name; an axis that has not published any is missing.
        positions: likewise.
        faults: likewise.
        parameters: of the drives that have them, by name.
        plants: identified machines, by name.
    """

    axes: Mapping[str, AxisInfo]
    states: Mapping[str, StateSample]
    positions: Mapping[str, PositionSample]
    faults: Mapping[str, FaultSample]
    parameters: Mapping[str, ParameterDump] = field(default_factory=dict)
    plants: Mapping[str, PlantConfig] = field(default_factory=dict)


async def read_state(client: RigClient, plants: Mapping[str, PlantConfig] | None = None) -> RigState:
    """Read how a rig stands; nothing of it changes.

    Args:
        client: of the rig.
        plants: machines that were identified, by axis.
    """
    axes = {axis.axis: axis for axis in await client.axes()}
    parameters: dict[str, ParameterDump] = {}
    for name, axis in axes.items():
        if Verb.READ_ALL_PARAMETERS in axis.capabilities:
            parameters[name] = await client.ask(ReadAllParameters(), name)
    return RigState(
        axes, await client.states(), await client.positions(), await client.faults(), parameters, plants or {}
    )


def config_of_twin(config: RigConfig, state: RigState) -> RigConfig:
    """Return the simulated rig that stands as a rig does: gains as the drives hold them, parameters, wear.

    Args:
        config: simulated already, see `simulated_config`.
        state: of the rig.

    Raises:
        ConfigError: the configuration is not of this rig.
    """
    configured = {axis.name for bus in config.bus for axis in bus.axis}
    if configured != set(state.axes):
        raise ConfigError(
            f"the configuration has the axes {', '.join(sorted(configured))}, the rig that runs"
            f" {', '.join(sorted(state.axes))}",
            remedy="give the configuration with which the daemon was started",
        )
    for bus in config.bus:
        for axis in bus.axis:
            there = state.axes[axis.name]
            if axis.meaning != there.meaning:
                given, found = (_in_words(*each) for each in (axis.meaning, there.meaning))
                raise ConfigError(
                    f"axis {axis.name}: the configuration has {given}, the rig that runs {found}",
                    axis=axis.name,
                    remedy="give the configuration with which the daemon was started",
                )
    if unknown := state.plants.keys() - configured:
        raise ConfigError(
            f"a machine was identified for axis {min(unknown)}, and the rig has {', '.join(sorted(configured))}",
            value=min(unknown),
            remedy="name reports of this rig",
        )
    units = {
        (bus.simulated, axis.address): axis.name
        for bus in config.bus
        for axis in bus.axis
        if axis.name in state.parameters
    }
    return config.model_copy(
        update={
            "bus": tuple(
                bus.model_copy(update={"axis": tuple(_axis(axis, state.axes[axis.name]) for axis in bus.axis)})
                for bus in config.bus
            ),
            "sim": tuple(
                line.model_copy(
                    update={
                        "unit": tuple(_unit(unit, units.get((line.name, unit.number)), state) for unit in line.unit)
                    }
                )
                if isinstance(line, SimulatedSmartStepLineConfig)
                else line
                for line in config.sim
            ),
        }
    )


def _axis(axis: object, info: AxisInfo) -> object:
    if not isinstance(axis, LdcnAxisConfig) or axis.gains is None:
        return axis
    held = {each.name: each.value for each in info.registers if each.value is not None}
    known = {name: held[name] for name in Gains.__slots__ if name in held and name in type(axis.gains).model_fields}
    if not held.get(
        "ol"
    ):  # no output: gains have not been sent since the drive was reset, so those of the file are next
        return axis
    return axis.model_copy(update={"gains": axis.gains.model_copy(update=known)})


def _unit(unit: SimulatedUnitConfig, name: str | None, state: RigState) -> SimulatedUnitConfig:
    if name is None:
        return unit
    values = state.parameters[name].values
    stored = {each.parameter: each.stored for each in values if each.parameter != "Pn000"}
    worn = max((each.eeprom_total or 0 for each in values), default=0)
    return unit.model_copy(update={"stored": stored, "worn": worn})


def place(machine_of: Callable[[str], Machine], state: RigState) -> None:
    """Put the shafts where the axes of a rig stand, and give them their machines; before the daemon begins."""
    _load_parameters(machine_of, state)
    for name, position in state.positions.items():
        machine = machine_of(name)
        if not isinstance(machine.config, LdcnAxisConfig):
            _place_unit(machine, position, state.faults.get(name))
            continue
        module = machine.servo
        if plant := state.plants.get(name):
            kept = {key: getattr(module.shaft.plant, key) for key in ("reverse_limit_counts", "forward_limit_counts")}
            module.shaft.become(module.shaft.plant.model_copy(update=plant.model_dump(exclude_unset=True) | kept))
        turns = (position.turns or 0) * (state.axes[name].modulo or 0.0)
        module.shaft.position_counts = (position.value + turns) * machine.config.signed_counts_per_unit


def _place_unit(machine: Machine, position: PositionSample, faults: FaultSample | None) -> None:
    drive = machine.unit.drive
    drive.motor.position = position.counts
    present = {fault.code for fault in faults.active} if faults else set()
    for alarm in ALARMS:
        if fault_of(alarm).code in present:
            drive.provoke(alarm.code, drive.motor.at_s)


def _load_parameters(machine_of: Callable[[str], Machine], state: RigState) -> None:
    """Let RAM differ from EEPROM where it does on the rig."""
    for name, dump in state.parameters.items():
        memory = machine_of(name).unit.drive.memory
        for value in dump.values:
            if value.active != value.stored:
                memory.write(RAM_OFFSET + int(value.parameter.removeprefix("Pn"), 16), value.active)


def recall(daemon: Daemon, state: RigState, now_ns: int) -> None:
    """Begin with what forbids axes of the rig to move, as after a restart of its daemon; before that of the twin runs.

    Args:
        daemon: of the twin.
        state: of the rig.
        now_ns: the time on the twin, UTC in ns since 1970.
    """
    for name, there in state.states.items():
        in_error = there.state is AxisState.ERROR_STOP
        if there.stop_latched or in_error:
            faults = state.faults.get(name)
            first = faults.first.past if in_error and faults and faults.first else None
            daemon.rig.axes[name].tracker.take(LatchRecalled(there.stop_latched, None, in_error, first, now_ns))


def restore(daemon: Daemon, machine_of: Callable[[str], Machine], state: RigState) -> None:
    """Give the axes of a twin, whose lines are up, the references of the rig; no command is needed for it.

    Args:
        daemon: of the twin.
        machine_of: returns the simulated drive of an axis.
        state: of the rig.
    """
    for name, there in state.states.items():
        position = state.positions.get(name)
        if there.referenced and position is not None and Verb.SET_POSITION in state.axes[name].capabilities:
            tracker, counts = daemon.rig.axes[name].tracker, machine_of(name).servo.loop.position
            tracker.take(PlaceKnown(tracker.status.scale.with_position(counts, position.value), resting=True))


def _in_words(unit: str, counts_per_unit: float | None, direction: str, modulo: float | None) -> str:
    scale = "no scale" if counts_per_unit is None else f"{counts_per_unit:g} counts per {unit}"
    return f"{scale}, {direction}, {'no modulo' if modulo is None else f'modulo {modulo:g}'}"
