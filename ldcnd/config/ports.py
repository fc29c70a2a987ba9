"""The door to ports for guests: existing host software that shares a line; a rig without `[[port]]` runs without it."""

from collections.abc import Awaitable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Literal, Protocol, Self

from pydantic import Field, model_validator

from ldcnd.contract.commands import Command
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import Drive
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.network import IoDriver
from ldcnd.drives.toml import Name
from ldcnd.line.bus import Bus
from ldcnd.listen_address import parse_listen_address

PORTS = "ldcnd.ports"


class PortConfig(Frozen):
    """A terminal or a TCP address at which a program that speaks the drives' protocol itself uses their line."""

    name: Name
    """The guest's name in events."""
    bus: Name
    """The line; the guest finds its axes and named PIC-I/O modules in the order of their addresses, SmartSteps at their
    unit numbers."""
    link: Path | None = None
    """The link to the terminal that the program opens."""
    listen: str | None = None
    """Instead of `link`, HOST:PORT of a TCP address, as a serial device server has it."""
    rfc2217: bool = False
    """Programs speak RFC 2217 at `listen`, which carries their serial settings, too; without, raw bytes."""
    beyond_loopback: bool = False
    """Accept connections from other machines; every machine that reaches the address can then use the port."""
    access: Literal["read", "control"] = "read"
    """What the guest may do: with "read" it reads, stops and switches motors off; all else is answered and not done.
    With "control" it moves axes as any client does, under a lease in its name."""
    idle_s: float = Field(default=60.0, gt=0, le=86_400)
    """A guest that has sent nothing for so long, in seconds, loses control, as one that has closed its port; one that
    only reads loses it once its axes rest."""
    fresh_ms: float = Field(default=0.0, ge=0, le=1000)
    """A read is answered with a reading that is no older than this, in milliseconds, if there is one that has all it
    asks for; with 0 always with one of its own. Readings from before a command of the guest are none."""
    mode: str = Field(default="0600", pattern=r"^0[0-7]{3}$")
    """Permissions of the terminal, octal."""
    group: str | None = Field(default=None, min_length=1, max_length=32)
    """The group of the terminal, for a mode that lets it in; that of the daemon when missing. The daemon's user must be
    a member."""

    @model_validator(mode="after")
    def _one_way_in(self) -> Self:
        if (self.link is None) is (self.listen is None):
            raise ValueError(f"port {self.name}: give it either link or listen")
        if self.listen is None:
            if self.rfc2217 or self.beyond_loopback:
                raise ValueError(f"port {self.name}: rfc2217 and beyond_loopback are of an address; give it listen")
            return self
        if self.group is not None or self.model_fields_set & {"mode"}:
            raise ValueError(f"port {self.name}: mode and group are of a terminal; give it link, or delete them")
        try:
            address = parse_listen_address(self.listen)
        except ConfigError as error:
            raise ValueError(f"port {self.name}: listen {error.message}; write it like 127.0.0.1:4001") from error
        if not (address.is_loopback or self.beyond_loopback):
            raise ValueError(
                f"port {self.name}: other machines could reach {self.listen}; "
                "listen on 127.0.0.1, or set beyond_loopback = true"
            )
        return self


class ScaleView(Protocol):
    """Coordinates of an axis."""

    @property
    def counts_per_unit(self) -> float:
        """Negative where forward in axis units is backward in counts."""

    @property
    def modulo(self) -> float | None:
        """Length of one turn, in axis units; None for an axis without one."""

    def position(self, counts: float) -> float:
        """Return the position that a count of the drive stands for, in axis units, counted through all turns."""


class StatusView(Protocol):
    """How an axis is, as far as the commands of a guest depend on it."""

    @property
    def scale(self) -> ScaleView:
        """Its coordinates."""

    @property
    def enabled(self) -> bool:
        """Its position loop is closed."""

    @property
    def state(self) -> AxisState:
        """As PLCopen has it."""

    @property
    def referenced(self) -> bool:
        """Its place is known."""

    @property
    def stops(self) -> int:
        """How often all that was sent to it was made void; `GuestHost.carry_out` of a stop counts before it waits."""

    @property
    def stop_latched(self) -> bool:
        """A stop is latched."""

    @property
    def at_rest(self) -> bool:
        """Its readings prove that nothing moves."""

    @property
    def command(self) -> object:
        """What is under way, settling included; None without anything."""

    def is_at(self, command_id: str) -> bool:
        """Tell whether a command is under way."""

    def has_done(self, command_id: str) -> bool:
        """Tell whether the latest command that is over is this one, and was done."""

    @property
    def goes_on(self) -> bool:
        """The end of the profile that its drive shows is not the end of what is under way: another one follows."""

    @property
    def ends_at_s(self) -> float | None:
        """When its profile should end, in loop time; None of a motion without an end."""

    @property
    def target_counts(self) -> int | None:
        """Target of its last motion, counts; None when it had no end or was followed by something else."""


class GuestView(Protocol):
    """A guest as those see it who look after the rig; see `ldcnd.ports.presence.Presence`."""

    @property
    def since_s(self) -> float | None:
        """When the program that is there sent its first byte, in loop time; None without one."""

    @property
    def axes(self) -> frozenset[str]:
        """The axes that it controls."""

    @property
    def packets(self) -> int:
        """How many of its packets it was to get a reply to, since the port is served."""

    @property
    def refused(self) -> int:
        """How many of its commands were answered and not done, likewise."""

    def send_away(self) -> Awaitable[None]:
        """Close its terminal or connection, and end its control.

        Raises:
            OSError: it cannot be done.
        """


class GuestHost(Protocol):
    """What a daemon does for a guest."""

    def show(self, port: str, guest: GuestView | None, problem: str = "") -> None:
        """Show a guest to those who look after the rig, from now on.

        Args:
            port: its port.
            guest: None while that is not served.
            problem: why it is not served.
        """

    def is_up(self) -> bool:
        """Tell whether every module of the line has its address, so that a guest's reading disturbs nothing."""

    def status(self, axis: str) -> StatusView:
        """Return how an axis is."""

    def levels(self, module: str) -> Mapping[str, bool | None]:
        """Return the levels of the named outputs of a module; None while one is not known."""

    def carry_out(self, about: str, command: Command[Frozen]) -> Awaitable[Frozen]:
        """Carry out a command about an axis, or about `RIG_ITSELF`, as of any client.

        Raises:
            LdcndError: as any client would get it.
        """

    def check_rates(self, axis: str, velocity: float, acceleration: float | None) -> None:
        """Refuse a velocity in units a second, or an acceleration, that a motion of an axis from rest cannot have.

        Raises:
            RequestRefused: as that motion would be refused, wherever it leads.
        """

    def is_traced(self, axis: str) -> bool:
        """Tell whether a client's trace of an axis is under way, its upload included."""

    def require_control(self, axis: str, lease: str) -> None:
        """Refuse what a guest sends by itself once it has lost control of the axis; raises LdcndError."""

    def leave(self, lease: str) -> None:
        """End the control of a guest that has gone: its axes and outputs do what their `loss.client` says.

        Raises:
            LdcndError: the lease has ended before.
        """

    def tell(self, about: str, what: str, client: str) -> None:
        """Enter among the events what a guest has begun by itself."""

    def refuse(self, about: str, what: str, client: str) -> None:
        """Enter what was refused to a guest, and why, among the events."""


class Ports(Protocol):
    """What the wing does for a configuration and for a daemon: the functions of `ldcnd.ports.known`."""

    def check(self, port: PortConfig, line: BusConfig) -> None:
        """Refuse a port that the line cannot have; raises ValueError."""

    def serve(
        self, port: PortConfig, bus: Bus, drives: Sequence[Drive], ios: Sequence[IoDriver], host: GuestHost
    ) -> Awaitable[None]:
        """Serve a guest until cancelled; a failure ends its port and nothing else."""


def ports() -> Ports:
    """Load the wing.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        known: Ports = import_module(f"{PORTS}.known")
    except ModuleNotFoundError as error:
        if error.name not in {PORTS, f"{PORTS}.known"}:
            raise
        raise ConfigError(
            f"[[port]] needs {PORTS}, which is not installed", remedy="install all of ldcnd, or delete [[port]]"
        ) from error
    return known


def check_ports(configured: Sequence[PortConfig], lines: Sequence[BusConfig]) -> None:
    """Refuse ports of lines that are not there or cannot have one; raises ValueError."""
    if not configured:
        return
    by_name = {line.name: line for line in lines}
    taken = {line.port: f"bus {line.name}" for line in lines}
    for port in configured:
        place = str(port.link or port.listen)
        if place in taken:
            raise ValueError(f"port {port.name}: {place} is that of {taken[place]} already")
        taken[place] = f"port {port.name}"
        if port.bus not in by_name:
            raise ValueError(f"port {port.name}: there is no bus {port.bus!r}; there are: {', '.join(by_name)}")
        try:
            ports().check(port, by_name[port.bus])
        except ConfigError as error:  # one complaint among others about the file
            raise ValueError(f"{error.message}; {error.remedy}") from error
