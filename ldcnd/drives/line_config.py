"""The configuration of one line: its port, its rate, and what is on it."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, SerializeAsAny, ValidationInfo, field_validator, model_validator

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.toml import Name, refuse_duplicates
from ldcnd.line.port_url import check_port, is_here
from ldcnd.line.transport import Rs485Config

SIMULATED = "sim:"
"""A port of this kind names a simulated line instead of a device."""
BAUDS = (9600, 19_200, 57_600, 115_200, 230_400)


def _known_port(port: str) -> str:
    if not port.startswith(SIMULATED):
        try:
            check_port(port)
        except ConfigError as error:
            raise ValueError(f"{error.message}; a simulated one is {SIMULATED}NAME") from None
    return port


class GroupConfig(Frozen):
    """Axes that can be started in the same servo cycle and stopped by one packet; an axis is in one group at most."""

    name: Name
    """Name of the group, for people and messages."""
    axes: tuple[Name, ...] = Field(min_length=2, max_length=31)
    """The members."""
    leader: Name | None = None
    """The axis whose drive answers for the group."""


class RecorderConfig(Frozen):
    """The flight recorder of a line: how much of what was on it is kept in memory."""

    seconds: float = Field(default=300.0, ge=1, le=86_400)
    """How far back it reaches."""
    memory_mb: int = Field(default=16, ge=1, le=4096)
    """The oldest packets go sooner when all take more; 16 MB are about 200000 exchanges."""


class InputConfig(Frozen):
    """A named input of an I/O module."""

    line: int = Field(ge=1, le=12)
    """Line of the module."""
    inverted: bool = False
    """Whether a low level makes it true."""
    debounce_ms: float = Field(default=0.0, ge=0, le=10_000)
    """Time for which a level must stay before it counts; an input changing for twice that and two polls, for \
interlocks `within_ms`, is unknown."""


OutputLevel = Literal["high", "low", "keep"]


class OutputLossConfig(Frozen):
    """Level of an output after a loss; an interlock that forbids it leaves the output as it is."""

    client: OutputLevel = "keep"
    """The lease of an axis on the module's line has expired, or was taken by force."""
    bus: OutputLevel = "keep"
    """The module was out of reach; acts when it answers again, until then it holds its outputs."""
    daemon: OutputLevel = "keep"
    """The daemon is shut down; where it is killed the module holds its outputs."""


class OutputConfig(Frozen):
    """An output of an I/O module, and its level in each situation; `keep` writes nothing."""

    line: int = Field(ge=1, le=12)
    """Line of the module."""
    start: OutputLevel = "keep"
    """Level after the reset at the start of the daemon, which lets outputs go first; a module that is taken over \
keeps them, unlisted ones until its first write."""
    reset: OutputLevel = "keep"
    """Level after the module has lost its power or was reset later on."""
    loss: OutputLossConfig = OutputLossConfig()
    """Level after a loss of the client, the line or the daemon."""


class BusConfig(Frozen):
    """One line; its family adds what only its lines have."""

    skips_by_default: ClassVar[bool] = False
    """Whether rates that the line may not be able to keep pass where `overload` is left out."""

    name: Name
    """Name of the line, for people and messages, and its chunk in `meta/buses`."""
    port: Annotated[str, AfterValidator(_known_port)]
    """A device path; hwgrep://PATTERN, a regular expression that fits one adapter that `ldcnd scan` lists;
    socket://host:port or rfc2217://host:port of a serial server; or sim:NAME."""
    family: str
    """The drive family on it, which has keys of its own."""
    baud: int = Field(default=19_200, gt=0, le=BAUDS[-1])
    """The working rate: 9600, 19200, 57600, 115200, 230400, or another that the family's drives can make."""
    margin_ms: float = Field(default=5.0, gt=0, le=1000)
    """Added to every reply's deadline: host scheduling and adapter latency."""
    rs485: Rs485Config | None = None
    """Have the kernel switch the transmitter; left out where the adapter does it, or it stays on (four wires)."""
    adapter_latency_ms: float = Field(default=1.0, ge=0, le=100)
    """How long the adapter holds replies, for the plan: 1 for FTDI in low-latency mode, 0 for a UART on board if \
`rx_trig_bytes` is 1, else the time of four characters."""
    overload: Literal["refuse", "skip"] | None = None
    """Rates that the line may not be able to keep: refused before anything is opened, or polls skip turns; left out: \
refuse, and skip where the drives' speed only shows on site."""
    axis: tuple[SerializeAsAny[AxisConfig], ...] = Field(min_length=1, max_length=31)
    """The drives that are axes."""
    group: tuple[GroupConfig, ...] = Field(default=(), max_length=15)
    """Axes that start and stop together."""
    recorder: RecorderConfig = RecorderConfig()
    """The flight recorder of the line."""

    @field_validator("baud")
    @classmethod
    def _possible_rate(cls, baud: int, known: ValidationInfo) -> int:
        return cls.possible_rate(baud, known)

    @classmethod
    def possible_rate(cls, baud: int, known: ValidationInfo) -> int:  # noqa: ARG003 - for families
        """Return a rate that a drive of the family can have.

        Raises:
            ValueError: none has it; names the nearest.
        """
        if baud not in BAUDS:
            raise ValueError(f"no drive has this rate; known are {', '.join(map(str, BAUDS))}")
        return baud

    @property
    def module_names(self) -> tuple[str, ...]:
        """Names of modules that are no axes."""
        return ()

    @property
    def inputs(self) -> Mapping[str, tuple[InputConfig, float]]:
        """Inputs of its modules by name, each with the poll rate of its module in Hz."""
        return {}

    @property
    def outputs(self) -> Mapping[str, tuple[OutputConfig, float]]:
        """Outputs of its modules by name, likewise; those without a name of their own are left out."""
        return {}

    @property
    def names(self) -> tuple[str, ...]:
        """What has a name on it: axes, modules, inputs and outputs; unique in a rig."""
        return (*(axis.name for axis in self.axis), *self.module_names, *self.inputs, *self.outputs)

    @property
    def takes_over(self) -> bool:
        """Whether the drives are taken over as they are at the start, so that what an earlier daemon knew may hold."""
        return False

    @property
    def simulated(self) -> str:
        """Name of the simulated line that it is; empty for a real port."""
        return self.port.removeprefix(SIMULATED) if self.port.startswith(SIMULATED) else ""

    @property
    def skips(self) -> bool:
        """Whether rates that the line may not be able to keep are let pass."""
        return self.overload == "skip" or (self.overload is None and self.skips_by_default)

    @property
    def models(self) -> dict[int, str]:
        """The modules on the line, by address."""
        return {axis.address: axis.model for axis in self.axis}

    @model_validator(mode="after")
    def _unique_addresses(self) -> Self:
        addresses = [axis.address for axis in self.axis]
        for address in addresses:
            if addresses.count(address) > 1:
                raise ValueError(f"address {address} is given to more than one axis")
        return self

    @model_validator(mode="after")
    def _switched_transmitter(self) -> Self:
        if self.rs485 and not is_here(self.port):
            raise ValueError(f"rs485: only a serial port of this machine has RTS, {self.port} has not; leave it out")
        return self

    @model_validator(mode="after")
    def _possible_groups(self) -> Self:
        refuse_duplicates("group", [group.name for group in self.group])
        refuse_duplicates("group member", [name for group in self.group for name in group.axes])
        known = [axis.name for axis in self.axis]
        for group in self.group:
            for name in group.axes:
                if name not in known:
                    raise ValueError(f"group {group.name}: no axis {name!r} on this bus; there are {', '.join(known)}")
            if group.leader is not None and group.leader not in group.axes:
                raise ValueError(f"group {group.name}: leader {group.leader!r} is not one of {', '.join(group.axes)}")
        return self
