"""The configuration of LDCN and NMC lines, beside what every line and axis has."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator
from typing_extensions import override

from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.contract.frozen import Frozen
from ldcnd.drives.axis_config import MovedAxisConfig
from ldcnd.drives.driver import AxisSpec
from ldcnd.drives.ldcn.profiles import CLOCK_HZ, PIC_IO, PROFILES, HomingControl, Support, at_clock
from ldcnd.drives.ldcn.registers import FASTEST_BAUD, baud_divisor, encode_gains
from ldcnd.drives.line_config import BAUDS, BusConfig, GroupConfig, InputConfig, OutputConfig
from ldcnd.drives.network import AdoptFallback, StartPolicy
from ldcnd.drives.toml import DeviceIdentity, Name, refuse_duplicates


def _known_model(model: str) -> str:
    movable = [name for name, profile in PROFILES.items() if profile.support is Support.FULL]
    if model not in movable:
        raise ValueError(f"no such drive model on a line of family ldcn; known are {', '.join(movable)}")
    return model


def _known_module(model: str) -> str:
    if model not in PROFILES:
        raise ValueError(f"no such module; known are {', '.join(PROFILES)}")
    return model


class LdcnAxisConfig(MovedAxisConfig):
    """One LDCN or NMC drive."""

    model: Annotated[str, AfterValidator(_known_model)]
    """The drive model."""
    address: int = Field(ge=1, le=127)
    """Node address: its place in the daisy chain, from 1; `ldcnd scan` says from which end the chain is numbered."""

    @model_validator(mode="after")
    def _gains_fit_the_drive(self) -> Self:
        """Refuse gains that the registers of this model do not take."""
        for gains in filter(None, (self.gains, *self.gain_sets.values())):
            try:
                encode_gains(PROFILES[self.model], gains.registers)
            except (ValueOutOfRange, NotSupported) as error:
                raise ValueError(f"gains of {self.model}: {error.message}") from None
        return self

    @model_validator(mode="after")
    def _has_limit_switches(self) -> Self:
        """Refuse limit switches that the drive cannot stop on."""
        profile = PROFILES[self.model]
        needed = HomingControl.LIMIT1 | HomingControl.LIMIT2
        stops = profile.stops_on_home and profile.homing_sources & needed == needed
        if self.limit_switches == "stop" and not stops:
            raise ValueError(f"limit_switches: {self.model} does not stop on its limit inputs by itself")
        return self

    def spec(self) -> AxisSpec:
        """Return the driver's settings."""
        gains = self.gains.registers if self.gains else None
        limit_stop = self.switch_active == "high" if self.limit_switches == "stop" else None
        return AxisSpec(self.name, self.address, self.model, gains, self.identity, limit_stop)


def _by_name(outputs: object) -> object:
    """Return outputs by name; a line without one of its own is called by its number."""
    if isinstance(outputs, list | tuple):
        return {str(line): {"line": line} for line in outputs}
    return outputs


class ModuleConfig(Frozen):
    """A module that is on a line and is no axis: an I/O module, a drive of a model that ldcnd only identifies."""

    address: int = Field(ge=1, le=127)
    """Its place in the daisy chain, from 1."""
    model: Annotated[str, AfterValidator(_known_module)]
    """The module model."""
    identity: DeviceIdentity | None = None
    """Identity of the module, given in the same way as that of an axis."""
    name: Name | None = None
    """Name of a PIC-I/O: its inputs are published and its outputs can be set under it; unique among the axes."""
    inputs: Mapping[Name, InputConfig] = Field(default={}, max_length=12)
    """Named inputs of a PIC-I/O."""
    outputs: Annotated[Mapping[Name, OutputConfig], BeforeValidator(_by_name)] = Field(default={}, max_length=12)
    """Lines of a PIC-I/O that may be driven, by name, or a list of their numbers; all others stay inputs. None is \
driven before a request or one of its own keys sets it."""
    rate: float = Field(default=5.0, gt=0, le=500)
    """Polling rate of a PIC-I/O, in Hz."""

    @model_validator(mode="after")
    def _has_terminals(self) -> Self:
        named: dict[str, InputConfig | OutputConfig] = {**self.inputs, **self.outputs}
        if (self.name or named) and self.model != PIC_IO.name:
            raise ValueError(f"name, inputs and outputs: a {self.model} has no lines to serve")
        if named and not self.name:
            raise ValueError("inputs and outputs: they can only be used with a name of the module")
        refuse_duplicates("name", [*self.inputs, *self.outputs])
        lines = [each.line for each in self.inputs.values()] + [each.line for each in self.outputs.values()]
        refuse_duplicates("line", [f"{line}" for line in lines])
        for name, each in named.items():
            if name[0].isdigit() and name != f"{each.line}":
                raise ValueError(f"{name}: a name begins with a letter, or is the number {each.line} of its line")
        return self


@dataclass(frozen=True, slots=True)
class LineSpec:
    """The configuration of a line as a whole.

    Attributes:
        start: see `StartPolicy`.
        adopt_fallback: see `AdoptFallback`.
        alternate_divisors: use the other family of baud rate divisors.
        clock_hz: of the modules.
        snapshot: positions may be frozen at one instant, which overwrites the drives' home registers.
        proves_places: find out at a reset which drives stand where they were powered on, see `BringUpReport.placed`.
        modules: what is on the line besides the axes.
        groups: at most one for each axis.
    """

    start: StartPolicy = StartPolicy.RESET
    adopt_fallback: AdoptFallback = AdoptFallback.REFUSE
    alternate_divisors: bool = False
    clock_hz: int = CLOCK_HZ
    snapshot: bool = False
    proves_places: bool = False
    modules: tuple[ModuleConfig, ...] = ()
    groups: tuple[GroupConfig, ...] = ()


class LdcnBusConfig(BusConfig):
    """One LDCN or NMC line."""

    family: Literal["ldcn"] = "ldcn"
    """The drive family on it."""
    clock_mhz: float = Field(default=20.0, ge=10.0, le=20.0)
    """Clock of the drives; PIC-SERVO up to version 5 only, all with the same. Servo cycle and rates follow it."""
    stop_probe_hz: float = Field(default=0.5, ge=0, le=20)
    """How often it is measured how long a stop would wait, by an exchange in its place; 0 for never. \
None where polls would miss their turns for it."""
    order: Literal["deadline", "phase"] = "phase"
    """Between polls that are equally urgent: who is due longest, or whose servo cycle ends first, so that more fit."""
    coalesce_ms: float = Field(default=5.0, ge=0, le=50)
    """How long a reading may wait, while the line is busy with polls, to be processed with those after it: several at \
a time take less processor time. 0 for one at a time."""
    start: StartPolicy = StartPolicy.RESET
    """Whether the drives are reset at start, or taken over as they are; a line that was lost is always taken over."""
    adopt_fallback: AdoptFallback = AdoptFallback.REFUSE
    """Fallback for a line that cannot be taken over when `start` requires it."""
    divisors: Literal["manual", "alternate"] = "manual"
    """The family of baud rate divisors: 57600 is 3.3 % fast with the manual's, 1.4 % slow with the alternate ones."""
    snapshot: bool = False
    """Positions of all axes may be frozen at one instant; it overwrites the drives' home registers."""
    axis: tuple[LdcnAxisConfig, ...] = Field(min_length=1, max_length=31)
    """The drives that are axes."""
    module: tuple[ModuleConfig, ...] = Field(default=(), max_length=30)
    """All modules on the line besides the axes: a line with one that is not configured stays down."""

    @property
    def models(self) -> dict[int, str]:
        """Models on the line, by address."""
        return super().models | {module.address: module.model for module in self.module}

    @property
    @override
    def module_names(self) -> tuple[str, ...]:
        return tuple(module.name for module in self.module if module.name)

    @property
    @override
    def inputs(self) -> Mapping[str, tuple[InputConfig, float]]:
        return {name: (each, module.rate) for module in self.module for name, each in module.inputs.items()}

    @property
    @override
    def outputs(self) -> Mapping[str, tuple[OutputConfig, float]]:
        return {
            name: (each, module.rate)
            for module in self.module
            for name, each in module.outputs.items()
            if not name.isdigit()
        }

    @property
    @override
    def takes_over(self) -> bool:
        return self.start is StartPolicy.ADOPT

    @property
    def clock_hz(self) -> int:
        """Clock of the drives, in Hz."""
        return round(self.clock_mhz * 1e6)

    @classmethod
    @override
    def possible_rate(cls, baud: int, known: ValidationInfo) -> int:
        return baud  # as the divisors of its clock make it, see `_reachable_rate`

    @model_validator(mode="after")
    def _modules_of_their_own(self) -> Self:
        addresses = [axis.address for axis in self.axis] + [module.address for module in self.module]
        for module in self.module:
            if addresses.count(module.address) > 1:
                raise ValueError(f"address {module.address} of a module is given twice")
        return self

    @model_validator(mode="after")
    def _reachable_rate(self) -> Self:
        for address, model in self.models.items():
            profile = PROFILES[model]
            if self.clock_hz != CLOCK_HZ and not profile.any_clock:
                raise ValueError(f"clock_mhz {self.clock_mhz:g}: {model} at address {address} has a clock of its own")
            top = at_clock(profile, self.clock_hz).top_baud
            known = [baud for baud in BAUDS if baud <= top]
            if not profile.any_divisor and self.baud not in known:
                rates = ", ".join(map(str, known))
                raise ValueError(f"baud {self.baud}: of {model} at address {address} only {rates} are known")
            if self.baud > top:
                raise ValueError(f"baud {self.baud}: {model} at address {address} reaches {top} at most")
            # with the usual clock the code that is printed for 230400 makes 208333, which a port reads as noise
            if not profile.baud_keys and self.baud == FASTEST_BAUD and self.clock_hz == CLOCK_HZ:
                raise ValueError(f"baud {self.baud}: no divisor of {model} at address {address} makes it")
        if self.baud not in BAUDS:
            try:
                baud_divisor(self.baud, clock_hz=self.clock_hz)
            except ValueOutOfRange as error:
                raise ValueError(f"baud: {error.message}; known are {', '.join(map(str, BAUDS))}") from None
        return self

    def spec(self) -> LineSpec:
        """Return the network's settings."""
        return LineSpec(
            start=self.start,
            adopt_fallback=self.adopt_fallback,
            alternate_divisors=self.divisors == "alternate",
            clock_hz=self.clock_hz,
            snapshot=self.snapshot,
            proves_places=any(axis.reference == "at_reset" for axis in self.axis),
            modules=self.module,
            groups=self.group,
        )
