"""The configuration file: TOML, validated whole before anything is opened."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, SerializeAsAny, ValidationError, model_validator

from ldcnd.config.interlocks import InterlockConfig, check_interlocks
from ldcnd.config.ports import PortConfig, check_ports
from ldcnd.config.quantities import with_units
from ldcnd.config.sequences import check_sequences
from ldcnd.config.simulated import SimulatedLine, simulator
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.number_text import NotANumber
from ldcnd.contract.sequences import NamedPosition, SequenceConfig
from ldcnd.drives import known
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.toml import NAME_CHARACTERS, Name, Variants, complaints, read_toml, refuse_duplicates
from ldcnd.net.zenoh_settings import ZenohSettings

Bus = Annotated[SerializeAsAny[BusConfig], Variants(known.bus_config, known.bus_configs)]


class ZenohConfig(Frozen):
    """Zenoh session over which the daemon meets its clients."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints to listen on; the default is this machine only, or what `config_file` says."""
    connect: tuple[str, ...] = ()
    """Endpoints (routers, other daemons) to connect to."""
    config_file: Path | None = None
    """A Zenoh configuration to start from, for TLS and access control; a relative name counts from the rig's file."""

    @model_validator(mode="before")
    @classmethod
    def _endpoints_of_file(cls, document: object) -> object:
        """Leave it to the file where to listen, unless that is said here."""
        if isinstance(document, dict) and document.get("config_file"):
            return {"listen": (), **document}
        return document

    def session(self) -> ZenohSettings:
        """Return how the daemon joins the network."""
        return ZenohSettings(mode="peer", listen=self.listen, connect=self.connect, config_file=self.config_file)


class DaemonConfig(Frozen):
    """How the daemon's process runs."""

    uvloop: bool = False
    """Use uvloop's event loop, if it is installed: less work for each exchange."""
    hold_cpu_awake: bool = False
    """Keep the processor out of deep idle states: quicker turn-around for more power; needs /dev/cpu_dma_latency."""


class CapturesConfig(Frozen):
    """The captures of lines on which something has gone wrong: a drive's fault, a loss, a line that acts too late."""

    directory: Path | None = None
    """Directory for captures; `captures` in `state_dir` if that is set, else nothing is written."""
    files: int = Field(default=20, ge=1, le=10_000)
    """Maximum number; the oldest are deleted."""
    total_mb: int = Field(default=200, ge=1, le=100_000)
    """Maximum disk space."""


class TelemetryConfig(Frozen):
    """How telemetry leaves."""

    encoding: Literal["msgpack", "json"] = "msgpack"
    """Encoding of samples: json can be read by every Zenoh tool; msgpack is smaller."""


class HeartbeatConfig(Frozen):
    """A wire that changes its level while the daemon works, for a relay outside; exactly one of port, gpio and file."""

    port: str | None = None
    """A serial port that carries nothing else; best a name below /dev/serial/by-id."""
    signal: Literal["rts", "dtr"] = "rts"
    """Output of the port that carries the signal."""
    gpio: str | None = Field(default=None, pattern=r"^gpiochip[0-9]+:[0-9]+$")
    """A line of a GPIO chip, as "gpiochip0:17"; needs the extra `gpio`."""
    file: Path | None = None
    """A file of the kernel that takes 0 and 1, such as the brightness of an LED that drives a pin."""
    half_period_ms: float = Field(default=50.0, ge=5.0, le=1000.0)
    """Time between two changes."""
    silence_ms: float = Field(default=500.0, ge=50.0, le=60_000.0)
    """Maximum time without any reply before a line holds the level; more than the longest pause of its polls."""
    lines: tuple[Name, ...] = ()
    """The lines that must work; all if none is named."""

    @model_validator(mode="after")
    def _one_wire(self) -> Self:
        if sum(each is not None for each in (self.port, self.gpio, self.file)) != 1:
            raise ValueError("a heartbeat needs exactly one of port, gpio and file")
        return self


class RigConfig(Frozen):
    """A whole rig: the configuration of `ldcnd run`."""

    rig: Name
    """Second chunk of every key; unique on the site."""
    zenoh: ZenohConfig = ZenohConfig()
    """Zenoh session over which the daemon meets its clients."""
    daemon: DaemonConfig = DaemonConfig()
    """How the daemon's process runs."""
    telemetry: TelemetryConfig = TelemetryConfig()
    """How telemetry leaves."""
    authority: Literal["open", "leased"] = "open"
    """Whether a lease is needed to move anything; readers and stops never need one."""
    state_dir: Path | None = None
    """Directory in which the daemon keeps what must outlive it: latched stops, the wear of EEPROMs, faults of axes, and
    with start = "adopt" their references; without it a latched stop ends with the daemon, and EEPROM is not written."""
    captures: CapturesConfig = CapturesConfig()
    """Captures that the daemon writes by itself."""
    heartbeat: HeartbeatConfig | None = None
    """A wire that changes its level while the daemon works."""
    bus: tuple[Bus, ...] = Field(min_length=1)
    """The lines."""
    interlock: tuple[InterlockConfig, ...] = Field(default=(), max_length=100)
    """What motions and outputs require of the machine; software, and no safety function."""
    position: tuple[NamedPosition, ...] = Field(default=(), max_length=500)
    """Named positions; `ldcnd position teach` writes them from where the axes stand."""
    sequence: tuple[SequenceConfig, ...] = Field(default=(), max_length=100)
    """Sequences; `ldcnd sequence run` carries one out as a client, the daemon does nothing with them."""
    port: tuple[PortConfig, ...] = Field(default=(), max_length=20)
    """Terminals on which existing host software shares a line."""
    sim: tuple[SimulatedLine, ...] = ()
    """Simulated lines, used by ports of the form sim:NAME."""

    @property
    def captures_dir(self) -> Path | None:
        """Where captures are written, if anywhere."""
        return self.captures.directory or (self.state_dir / "captures" if self.state_dir else None)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        refuse_duplicates("bus", [bus.name for bus in self.bus])
        refuse_duplicates("axis", [name for bus in self.bus for name in bus.names])
        check_interlocks(self.interlock, self.bus)
        check_sequences(self.position, self.sequence, self.bus)
        refuse_duplicates("port", [port.name for port in self.port])
        check_ports(self.port, self.bus)
        refuse_duplicates("sim", [line.name for line in self.sim])
        ports = [bus.port for bus in self.bus]
        refuse_duplicates("port", ports)
        self._check_heartbeat()
        lines = {line.name: line for line in self.sim}
        for bus in self.bus:
            if not bus.simulated:
                continue
            if bus.simulated not in lines:
                names = ", ".join(sorted(lines)) or "none"
                raise ValueError(f"port {bus.port!r}: no [[sim]] of that name; there are: {names}")
            simulator().refuse_other_drives(bus, lines[bus.simulated])
        return self

    def _check_heartbeat(self) -> None:
        if self.heartbeat is None:
            return
        for bus in self.bus:
            if bus.port == self.heartbeat.port:
                raise ValueError(f"heartbeat.port is the port of bus {bus.name}; use one that carries nothing else")
        known = [bus.name for bus in self.bus]
        for name in self.heartbeat.lines:
            if name not in known:
                raise ValueError(f"heartbeat.lines: there is no bus {name!r}; there are: {', '.join(known)}")


def put_together(rig: RigConfig) -> RigConfig:
    """Return a configuration whose parts come from others, validated as a file is: `model_copy` asks nothing again.

    Raises:
        ConfigError: its parts cannot work together; says which, and why.
    """
    try:
        # without what was not given: beside some keys others must not stand
        return RigConfig.model_validate(rig.model_dump(exclude_unset=True))
    except ValidationError as error:
        raise ConfigError("; ".join(complaints(error, RigConfig, whole=f"rig {rig.rig}"))) from error


def of_one_line(rig: RigConfig, name: str) -> tuple[RigConfig, tuple[str, ...]]:
    """Return a rig with one of its lines and what needs nothing else, and in words what keeps watch over others, too.

    Raises:
        ConfigError: there is no such line.
    """
    line = next((bus for bus in rig.bus if bus.name == name), None)
    if line is None:
        lines = ", ".join(bus.name for bus in rig.bus)
        raise ConfigError(f"rig {rig.rig} has no bus {name!r}", value=name, remedy=f"one of {lines}")
    line_of = {part: bus.name for bus in rig.bus for part in bus.names}
    positions = {each.name: each for each in rig.position}
    crossing: list[str] = []

    def is_own(lines: Iterable[str], watch: str = "") -> bool:
        needed = sorted({*lines})
        if watch and name in needed and len(needed) > 1:
            crossing.append(f"{watch} needs {' and '.join(needed)}")
        return needed in ([], [name])

    def lines_of(named: Iterable[str]) -> Iterable[str]:
        return (line_of[each] for each in named)

    beat = rig.heartbeat
    parts = {
        "bus": (line,),
        "sim": tuple(each for each in rig.sim if each.name == line.simulated),
        "interlock": tuple(each for each in rig.interlock if is_own(lines_of(each.names), f"interlock {each.name}")),
        "position": tuple(each for each in rig.position if is_own(lines_of(each.axes))),
        "sequence": tuple(each for each in rig.sequence if is_own(lines_of(each.names(positions)))),
        "port": tuple(each for each in rig.port if each.bus == name),
        "heartbeat": beat if beat and is_own(beat.lines or [bus.name for bus in rig.bus], "heartbeat") else None,
    }
    return rig.model_copy(update=parts), tuple(crossing)


def single_line(rig: RigConfig, name: str) -> RigConfig:
    """Return the rig that one line is by itself: `<rig>_<line>`, with a state directory of its own below the rig's.

    What needs other lines is left out.

    Raises:
        ConfigError: there is no such line, an interlock or the heartbeat watches this line and another one, or the name
            becomes too long.
    """
    own, crossing = of_one_line(rig, name)
    if crossing:
        raise ConfigError(
            f"line {name} cannot be served by itself: {'; '.join(crossing)}", remedy="serve all lines in one process"
        )
    alone = f"{rig.rig}_{name}"
    if len(alone) > NAME_CHARACTERS:
        raise ConfigError(f"{alone} is too long for a rig's name", value=len(alone), limit=NAME_CHARACTERS)
    state_dir = rig.state_dir / name if rig.state_dir else None
    return put_together(own.model_copy(update={"rig": alone, "state_dir": state_dir}))


def example(name: str) -> Path:
    """Return a configuration that ldcnd brings along: a wheel has copies of them, a checkout has them beside it."""
    package = Path(__file__).parents[1]
    folder = package / "examples"
    return (folder if folder.is_dir() else package.parent / "config") / name


def load_config(path: Path) -> RigConfig:
    """Read and validate a rig's configuration.

    Raises:
        ConfigError: the file cannot be read, is not TOML, or cannot work; names file, keys, what is wrong, what is
            allowed.
    """
    try:
        rig = read_toml(path, RigConfig, with_units)
    except NotANumber as error:
        raise ConfigError(f"{path}: {error}") from error
    if rig.zenoh.config_file is None:
        return rig
    zenoh = rig.zenoh.model_copy(update={"config_file": path.parent / rig.zenoh.config_file})
    return rig.model_copy(update={"zenoh": zenoh})
