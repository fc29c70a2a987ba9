"""The configuration and the report of a line as a whole: policies, groups, modules."""

from dataclasses import dataclass
from enum import StrEnum


class StartPolicy(StrEnum):
    """How a line in an unknown state is started."""

    RESET = "reset"
    """The drives are reset: what moves loses its torque, positions count from 0."""
    ADOPT = "adopt"
    """The drives are taken over as they are, moving or not; nothing is sent that could move, stop or reset one."""


class AdoptFallback(StrEnum):
    """What happens when a line cannot be adopted."""

    REFUSE = "refuse"
    """It stays down, and the daemon says why and tries again."""
    RESET = "reset"
    """It is reset, unless a drive moves or is not known to stand."""


@dataclass(frozen=True, slots=True)
class ModuleEntry:
    """A module that is expected on the line and is no axis.

    Attributes:
        address: node address, 1 to 127.
        model: profile name of the family.
        identity: see `AxisSpec`.
        name: of an I/O module that is served; empty for one that is only watched.
        outputs: its lines that may be driven.
        rate_hz: polling rate.
    """

    address: int
    model: str
    identity: tuple[int, int] | None = None
    name: str = ""
    outputs: tuple[int, ...] = ()
    rate_hz: float = 5.0


@dataclass(frozen=True, slots=True)
class GroupSpec:
    """Axes that start and stop together.

    Attributes:
        name: of the group.
        axes: names of its members.
        leader: the member that answers for the group; None for a silent one.
    """

    name: str
    axes: tuple[str, ...]
    leader: str | None = None


@dataclass(frozen=True, slots=True)
class LineSpec:
    """The configuration of a line as a whole.

    Attributes:
        start: see `StartPolicy`.
        adopt_fallback: see `AdoptFallback`.
        alternate_divisors: use the other family of baud rate divisors.
        clock_hz: of the modules.
        snapshot: positions may be frozen at one instant, which overwrites the drives' home registers.
        modules: what is on the line besides the axes.
        groups: at most one for each axis.
    """

    start: StartPolicy = StartPolicy.RESET
    adopt_fallback: AdoptFallback = AdoptFallback.REFUSE
    alternate_divisors: bool = False
    clock_hz: int = 20_000_000
    snapshot: bool = False
    modules: tuple[ModuleEntry, ...] = ()
    groups: tuple[GroupSpec, ...] = ()


@dataclass(frozen=True, slots=True)
class FoundModule:
    """Something that answers on the line, axis or not.

    Attributes:
        address: node address.
        title: what it is, for people.
        model: profile name; None for an unsupported device: then it is never moved.
        device_id: as it reports.
        version: as it reports.
        name: under which an I/O module is served.
        axis: the axis it is; None for a module that is only kept on the line.
        status: its latest status byte; None for an axis, whose state is telemetry.
    """

    address: int
    title: str
    model: str | None
    device_id: int
    version: int
    axis: str | None
    status: int | None
    name: str | None = None
