"""What the host knows of the registers of an LDCN/NMC drive: none of them can be read back.

Sources: LS-182AP manual, "Power-up and Reset Conditions", "Set Gain", "Load Trajectory"; PIC-SERVO manual, 4.5, 5.2.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict

from ldcnd.drivers import driver
from ldcnd.drivers.driver import Register
from ldcnd.drivers.ldcn.limit_pins import INPUTS
from ldcnd.drivers.ldcn.profiles import Profile
from ldcnd.drivers.ldcn.trajectory import Trajectory
from ldcnd.model.axes import Provenance

GAIN_NAMES = ("kp", "kd", "ki", "il", "ol", "cl", "el", "sr", "deadband")
TRAJECTORY_NAMES = ("position", "velocity", "acceleration", "pwm_or_target")
LIMIT_PINS = "io_control"
BYTES_WITH_DEADBAND = 14


class RegisterBook:
    """The registers of one drive, each with where its value comes from.

    A register that is being written is unknown until the drive has acknowledged it.
    """

    def __init__(self, profile: Profile) -> None:
        names = list(GAIN_NAMES)
        if not profile.current_limit:
            names.remove("cl")
        if profile.gain_bytes < BYTES_WITH_DEADBAND:
            names.remove("deadband")
        names += TRAJECTORY_NAMES
        if profile.limit_outputs:
            names.append(LIMIT_PINS)
        self._registers = {name: Register(name, None, Provenance.UNKNOWN) for name in names}

    def all(self) -> tuple[Register, ...]:
        """Return every register the drive has, in the order of the manual."""
        return tuple(self._registers.values())

    def value(self, name: str) -> int | None:
        """Return what a register holds, or None when that is unknown or there is none of that name."""
        register = self._registers.get(name)
        return register.value if register else None

    def written(self, name: str) -> bool:
        """Tell whether this daemon wrote a register since the drive was reset or taken over."""
        register = self._registers.get(name)
        return register is not None and register.provenance is Provenance.WRITTEN_AND_ACKNOWLEDGED

    def reset(self) -> None:
        """The drive was reset: everything is 0 but the servo rate divisor and the pins, says the manual."""
        self._set(dict.fromkeys(self._registers, 0) | {"sr": 1, LIMIT_PINS: INPUTS}, Provenance.ASSUMED)

    def assume(self, values: Mapping[str, int]) -> None:
        """The drive was taken over as it is: these are what somebody must have written, nothing else is known."""
        self.doubt(self._registers)
        self._set(values, Provenance.ASSUMED)

    def doubt(self, names: Iterable[str]) -> None:
        """Something is about to change these registers, or may have."""
        for name in names:
            if name in self._registers:
                self._registers[name] = Register(name, None, Provenance.UNKNOWN)

    def wrote(self, values: Mapping[str, int]) -> None:
        """The drive has acknowledged these values."""
        self._set(values, Provenance.WRITTEN_AND_ACKNOWLEDGED)

    def _set(self, values: Mapping[str, int], provenance: Provenance) -> None:
        for name, value in values.items():
            if name in self._registers:
                self._registers[name] = Register(name, int(value), provenance)


def gain_values(gains: driver.Gains) -> dict[str, int]:
    """Return what Set Gain writes."""
    return asdict(gains)


def trajectory_values(trajectory: Trajectory) -> dict[str, int]:
    """Return what Load Trajectory writes: the fields that are present."""
    values = {name: getattr(trajectory, name) for name in TRAJECTORY_NAMES}
    return {name: value for name, value in values.items() if value is not None}
