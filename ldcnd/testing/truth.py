"""What is really so on a simulated rig, whatever the daemon says: where shafts are, how they move, what drives hold."""

from collections.abc import Mapping
from dataclasses import dataclass

from ldcnd.axis.scale import AxisScale
from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.ldcn.config import ModuleConfig
from ldcnd.drives.smartstep.parameters import PARAMETERS
from ldcnd.sim.chain import Chain, Module
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.io import SimulatedIo
from ldcnd.sim.smartstep.cable import SimulatedSmartSteps
from ldcnd.sim.smartstep.drive import SimulatedSmartStep
from ldcnd.sim.smartstep.unit import SimulatedUnit

REST_COUNTS_PER_S = 200.0
"""A closed loop settles and hunts by a few counts: below this speed an axis rests."""


@dataclass(frozen=True, slots=True)
class Truth:
    """One axis as it is at an instant.

    Attributes:
        position: of the shaft, in axis units: what a daemon that knew everything would publish, by the reference that
            the axis had last, and without any from where its drive was first switched on.
        counts: of the encoder, from where the axis stood when its drive was switched on first.
        load_position: of the load, in axis units: behind the encoder by what the coupling has slipped.
        velocity: in axis units a second, positive forward.
        at_rest: whether it stands, but for the hunting of a closed loop.
        energised: whether the motor gets voltage.
        output: of the drive to the motor, -1 to 1 of full; None of a drive that shows none.
        registers: what the drive holds: its gains by the names of the configuration, of a SmartStep its parameters by
            their numbers.
    """

    position: float
    counts: float
    load_position: float
    velocity: float
    at_rest: bool
    energised: bool
    output: float | None
    registers: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class ModuleTruth:
    """One I/O module and what stands at its terminals, at an instant.

    Attributes:
        powered: whether it has its supply.
        inputs: whether each named input is on, by the level of its pin.
        outputs: level of each named output, true for high; None while the module does not drive the line.
        parts: where each door, bolt or other part of the machine is, by the names of the configuration: 0 at its start,
            1 at its end.
    """

    powered: bool
    inputs: Mapping[str, bool]
    outputs: Mapping[str, bool | None]
    parts: Mapping[str, float]


class Terminals:
    """One simulated I/O module under its name.

    Attributes:
        config: of the module.
        chain: the line.
        io: the module.
    """

    def __init__(self, config: ModuleConfig, chain: Chain, place: int) -> None:
        module = chain.modules[place - 1]
        assert isinstance(module, SimulatedIo)  # noqa: S101 - only such a module has a name
        self.config, self.chain, self.io = config, chain, module

    def look(self, now_s: float) -> ModuleTruth:
        """Return what is so at an instant of the line's clock."""
        self.chain.pass_until(now_s)
        io = self.io
        io.catch_up(now_s)
        levels = io.levels

        def level(line: int, of: int) -> bool:
            return bool(of & 1 << line - 1)

        return ModuleTruth(
            powered=io.powered,
            inputs={name: level(each.line, levels) is not each.inverted for name, each in self.config.inputs.items()},
            outputs={
                name: level(each.line, levels) if level(each.line, io.outputs) else None
                for name, each in self.config.outputs.items()
            },
            parts={name: io.around.at(name) for name in io.around.names},
        )


def terminals_of(modules: Mapping[str, Terminals], name: str) -> Terminals:
    """Return a module by its name.

    Raises:
        ValueOutOfRange: there is no such module.
    """
    if name not in modules:
        raise ValueOutOfRange(f"there is no I/O module {name!r}; there are: {', '.join(modules) or 'none'}", value=name)
    return modules[name]


class Machine:
    """One simulated drive and what is on its shaft.

    Attributes:
        axis: its name.
        config: of the axis.
        chain: the line.
        line: the name of the line.
        place: of the drive on the line, from 1 on.
        slipped_counts: how far the load is behind the encoder.
        origin_counts: of the shaft, where the axis is at 0 by its last reference.
    """

    def __init__(self, config: AxisConfig, line: str, chain: Chain, place: int) -> None:
        self.axis = config.name
        self.config = config
        self.chain = chain
        self.line = line
        self.place = place
        self.slipped_counts = 0.0
        self.origin_counts = 0.0

    @property
    def module(self) -> Module:
        """The module of the line."""
        modules = self.chain.modules
        return modules[0 if isinstance(modules[0], SimulatedSmartSteps) else self.place - 1]  # they are one cable

    @property
    def servo(self) -> SimulatedDrive:
        """The drive with its shaft.

        Raises:
            NotSupported: it is none with a shaft that can be reached.
        """
        module = self.module
        if not isinstance(module, SimulatedDrive):
            raise NotSupported(f"axis {self.axis}: the simulated {self.config.model} has no shaft that can be changed")
        return module

    @property
    def unit(self) -> SimulatedUnit:
        """The SmartStep.

        Raises:
            NotSupported: it is none.
        """
        module = self.chain.modules[0]
        if not isinstance(module, SimulatedSmartSteps):
            raise NotSupported(f"axis {self.axis}: a simulated {self.config.model} is no SmartStep")
        return next(unit for unit in module.cable.units if unit.drive.unit == self.config.address)

    def refer(self, scale: AxisScale, now_s: float) -> None:
        """Take the coordinates of an axis whose place is known: they outlive its daemon."""
        if isinstance(self.module, SimulatedDrive):
            self.module.catch_up(now_s)
            self.origin_counts = self.module.shaft.position_counts - self.module.loop.position + scale.origin_counts

    def look(self, now_s: float) -> Truth:
        """Return what is so at an instant of the line's clock."""
        self.chain.pass_until(now_s)  # bytes on their way are the daemon's, in real time too
        module = self.module
        if isinstance(module, SimulatedDrive):
            module.catch_up(now_s)
            return self._of_servo(module)
        return self._of_smartstep(self.unit.drive, now_s)

    def _of_servo(self, drive: SimulatedDrive) -> Truth:
        loop, shaft, scale = drive.loop, drive.shaft, self.config.signed_counts_per_unit
        position = (shaft.position_counts - self.origin_counts) / scale
        speed = shaft.velocity_counts / drive.profile.servo_cycle_s
        energised = drive.stage.drives and (loop.servo_on or loop.pwm != 0)
        gains = loop.gains
        names = ("kp", "kd", "ki", "il", "ol", "cl", "el", "sr", "deadband")
        return Truth(
            position=position,
            counts=shaft.position_counts,
            load_position=position - self.slipped_counts / scale,
            velocity=speed / scale,
            at_rest=abs(speed) < REST_COUNTS_PER_S,
            energised=energised,
            output=loop.pwm / 255 if drive.stage.drives else 0.0,
            registers={name: getattr(gains, name) for name in names},
        )

    def _of_smartstep(self, drive: SimulatedSmartStep, now_s: float) -> Truth:
        drive.advance(now_s)
        motor, scale = drive.motor, self.config.signed_counts_per_unit
        counter = drive.feedback_counter
        position = (counter - 2**32 if counter >= 2**31 else counter) / scale  # it is below 0 where it ran backward
        return Truth(
            position=position,
            counts=motor.position,
            load_position=position,
            velocity=motor.speed / scale,
            at_rest=abs(motor.speed) < REST_COUNTS_PER_S,
            energised=motor.servo_on,
            output=None,
            registers={f"Pn{each.number:03X}": drive.memory.active(each) for each in PARAMETERS},
        )
