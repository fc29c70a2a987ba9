"""The configuration of one line: its port, its rate, and what is on it."""

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from ldcnd.config.axis import AxisConfig
from ldcnd.config.toml import DeviceIdentity, Name, refuse_duplicates
from ldcnd.drivers.ldcn.profiles import CLOCK_HZ, PIC_IO, PROFILES, at_clock
from ldcnd.drivers.ldcn.registers import baud_divisor
from ldcnd.drivers.line import AdoptFallback, StartPolicy
from ldcnd.drivers.smartstep import config as smartstep_config
from ldcnd.drivers.smartstep.config import SmartStepLineConfig
from ldcnd.drivers.smartstep.profiles import Wiring
from ldcnd.errors import ValueOutOfRange
from ldcnd.model.frozen import Frozen
from ldcnd.transport.line_discipline import LONGEST_RTS_DELAY_MS, Rs485

BAUDS = (9600, 19_200, 57_600, 115_200, 230_400)


def _known_module(model: str) -> str:
    if model not in PROFILES:
        raise ValueError(f"no such module; known are {', '.join(PROFILES)}")
    return model


def _known_port(port: str) -> str:
    if port.startswith(("/", "socket://", "sim:")):
        return port
    raise ValueError("a port is a device path, socket://host:port, or sim:NAME")


class ModuleConfig(Frozen):
    """A module that is on a line and is no axis: an I/O module, a drive of a model that ldcnd only identifies."""

    address: int = Field(ge=1, le=127)
    """Its place in the daisy chain, from 1."""
    model: Annotated[str, AfterValidator(_known_module)]
    """The module model."""
    identity: DeviceIdentity | None = None
    """As for an axis."""
    name: Name | None = None
    """Of a PIC-I/O: its inputs are published and its outputs can be set under this name; unique among the axes."""
    outputs: tuple[Annotated[int, Field(ge=1, le=12)], ...] = ()
    """Lines of a PIC-I/O that may be driven; all others stay inputs. Nothing is driven before it is asked for."""
    rate: float = Field(default=5.0, gt=0, le=500)
    """How often a PIC-I/O is asked, in Hz."""

    @model_validator(mode="after")
    def _has_terminals(self) -> Self:
        if (self.name or self.outputs) and self.model != PIC_IO.name:
            raise ValueError(f"name and outputs: a {self.model} has no lines to serve")
        if self.outputs and not self.name:
            raise ValueError("outputs: nobody can set them without a name of the module")
        return self


class GroupConfig(Frozen):
    """Axes that can be started in the same servo cycle and stopped by one packet; an axis is in one group at most."""

    name: Name
    """For people and messages."""
    axes: tuple[Name, ...] = Field(min_length=2, max_length=31)
    """The members."""
    leader: Name | None = None
    """The axis whose drive answers for the group."""


class RecorderConfig(Frozen):
    """The flight recorder of a line: how much of what was on it is kept in memory."""

    seconds: float = Field(default=300.0, ge=1, le=86_400)
    """How far back it reaches."""
    memory_mb: int = Field(default=16, ge=1, le=4096)
    """The oldest packets go sooner when all take more; 16 MB are about 35000 exchanges."""


class Rs485Config(Frozen):
    """Direction control of an RS-485 transmitter by the kernel, which switches RTS around each packet."""

    rts_on_send: bool = True
    """RTS is on while sending and off otherwise; false for ports that are wired the other way round."""
    before_ms: int = Field(default=0, ge=0, le=LONGEST_RTS_DELAY_MS)
    """From switching the transmitter on to the first bit."""
    after_ms: int = Field(default=0, ge=0, le=LONGEST_RTS_DELAY_MS)
    """From the last bit to switching the transmitter off."""
    receive_own: bool = False
    """The receiver stays on while sending: on two wires the host then hears itself, see `echo`."""
    terminate: bool = False
    """Switch on the terminating resistor of a port that has one."""


class BusConfig(Frozen):
    """One line."""

    name: Name
    """For people and messages, and its chunk in `meta/buses`."""
    port: Annotated[str, AfterValidator(_known_port)]
    """A device path, socket://host:port, or sim:NAME."""
    family: Literal["ldcn", "smartstep"] = "ldcn"
    """The drive family on it."""
    smartstep: SmartStepLineConfig = SmartStepLineConfig()
    """How a line of the smartstep family is wired; its rate is always 9600."""
    clock_mhz: float = Field(default=20.0, ge=10.0, le=20.0)
    """Clock of the drives; PIC-SERVO up to version 5 only, all with the same. Servo cycle and rates follow it."""
    baud: int = Field(default=19_200, gt=0, le=BAUDS[-1])
    """The working rate: 9600, 19200, 57600, 115200, 230400, or on LDCN and NMC drives another that a divisor of their
    clock makes, such as 125000; the port has to make it, too."""
    margin_ms: float = Field(default=5.0, gt=0, le=1000)
    """Added to every reply's deadline: host scheduling and adapter latency."""
    rs485: Rs485Config | None = None
    """Have the kernel switch the transmitter; left out where the adapter does it, or it stays on (four wires)."""
    adapter_latency_ms: float = Field(default=1.0, ge=0, le=100)
    """How long the adapter holds replies, for the plan: 1 for FTDI in low-latency mode, 0 for a UART on board if \
`rx_trig_bytes` is 1, else the time of four characters."""
    overload: Literal["refuse", "skip"] | None = None
    """Rates that the line may not be able to keep: refused before anything is opened, or polls skip turns; left out: \
refuse, and skip for smartstep, where the drives' speed only shows on site."""
    stop_probe_hz: float = Field(default=0.5, ge=0, le=20)
    """How often it is measured how long a stop would wait, by a question in its place; ldcn only, 0 for never. \
None where polls would miss their turns for it."""
    order: Literal["deadline", "phase"] = "phase"
    """Between polls that are equally urgent: who is due longest, or whose servo cycle ends first, so that more fit."""
    start: StartPolicy = StartPolicy.RESET
    """Whether the drives are reset at start, or taken over as they are; a line that was lost is always taken over."""
    adopt_fallback: AdoptFallback = AdoptFallback.REFUSE
    """What happens to a line that cannot be taken over when `start` asks for it."""
    divisors: Literal["manual", "alternate"] = "manual"
    """The family of baud rate divisors: 57600 is 3.3 % fast with the manual's, 1.4 % slow with the alternate ones."""
    snapshot: bool = False
    """Positions of all axes may be frozen at one instant; it overwrites the drives' home registers."""
    axis: tuple[AxisConfig, ...] = Field(min_length=1, max_length=31)
    """The drives that are axes."""
    module: tuple[ModuleConfig, ...] = Field(default=(), max_length=30)
    """What is on the line besides the axes."""
    group: tuple[GroupConfig, ...] = Field(default=(), max_length=15)
    """Axes that start and stop together."""
    recorder: RecorderConfig = RecorderConfig()
    """The flight recorder of the line."""

    @field_validator("baud")
    @classmethod
    def _possible_rate(cls, baud: int, known: ValidationInfo) -> int:
        """Refuse a rate that no drive has: one of the list, or on LDCN and NMC what a divisor makes."""
        if baud in BAUDS:
            return baud
        if known.data.get("family") != "ldcn":
            raise ValueError(f"no drive has this rate; known are {', '.join(map(str, BAUDS))}")
        try:
            baud_divisor(baud, clock_hz=round(known.data.get("clock_mhz", 20.0) * 1e6))
        except ValueOutOfRange as error:
            raise ValueError(f"{error.message}; known are {', '.join(map(str, BAUDS))}") from None
        return baud

    @property
    def transmitter(self) -> Rs485 | None:
        """Return how the kernel switches the transmitter, if it does."""
        return Rs485(**self.rs485.model_dump()) if self.rs485 else None

    @property
    def skips(self) -> bool:
        """Whether rates that the line may not be able to keep are let pass."""
        return self.overload == "skip" or (self.overload is None and self.family == "smartstep")

    @property
    def _models(self) -> dict[int, str]:
        """What is on the line, by address."""
        models = {axis.address: axis.model for axis in self.axis}
        return models | {module.address: module.model for module in self.module}

    @model_validator(mode="after")
    def _unique_addresses(self) -> Self:
        addresses = [axis.address for axis in self.axis]
        for address in addresses:
            if addresses.count(address) > 1:
                raise ValueError(f"address {address} is given to more than one axis")
        addresses += [module.address for module in self.module]
        for module in self.module:
            if addresses.count(module.address) > 1:
                raise ValueError(f"address {module.address} of a module is given twice")
        return self

    @model_validator(mode="after")
    def _one_family(self) -> Self:
        is_smartstep = self.family == "smartstep"
        for axis in self.axis:
            if (axis.model == smartstep_config.MODEL) is not is_smartstep:
                raise ValueError(f"axis {axis.name}: a {axis.model} does not belong on a line of family {self.family}")
        if is_smartstep and len(self.axis) > 1 and any(axis.address == 0 for axis in self.axis):
            raise ValueError("unit 0 never releases its transmitter: it must be alone on its line")
        return self

    @model_validator(mode="after")
    def _switched_transmitter(self) -> Self:
        if self.rs485 is None:
            return self
        if not self.port.startswith("/"):
            raise ValueError(f"rs485: only a serial port of this machine has RTS, {self.port} has not; leave it out")
        echo = self.smartstep.echo == "expect"
        if self.smartstep.wiring is Wiring.TWO_WIRE and echo is not self.rs485.receive_own:
            raise ValueError('rs485: on two wires receive_own = true goes with echo = "expect", false with "none"')
        return self

    @property
    def clock_hz(self) -> int:
        """Clock of the drives, in Hz."""
        return round(self.clock_mhz * 1e6)

    @model_validator(mode="after")
    def _reachable_rate(self) -> Self:
        for address, model in self._models.items():
            profile = PROFILES.get(model)
            if profile is None:
                continue
            if self.clock_hz != CLOCK_HZ and not profile.any_clock:
                raise ValueError(f"clock_mhz {self.clock_mhz:g}: {model} at address {address} has a clock of its own")
            top = at_clock(profile, self.clock_hz).top_baud
            if self.baud > top:
                raise ValueError(f"baud {self.baud}: {model} at address {address} reaches {top} at most")
            if profile.baud_keys and self.baud not in BAUDS:
                raise ValueError(f"baud {self.baud}: {model} at address {address} knows {', '.join(map(str, BAUDS))}")
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
