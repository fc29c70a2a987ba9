"""What an axis can be: its states, how sure the daemon is of them, and what describes it."""

from enum import StrEnum
from typing import Literal

from pydantic import Field

from ldcnd.model.frozen import Frozen
from ldcnd.model.verb import Verb

PollPriority = Literal["high", "normal", "low"]
"""How the polls of an axis fare while its line cannot carry all of them."""


class AxisState(StrEnum):
    """PLCopen axis states."""

    DISABLED = "disabled"
    STANDSTILL = "standstill"
    HOMING = "homing"
    DISCRETE_MOTION = "discrete_motion"
    CONTINUOUS_MOTION = "continuous_motion"
    STOPPING = "stopping"
    ERROR_STOP = "error_stop"


class Moving(StrEnum):
    """Whether the axis moves; unknown is an answer of its own and never means no."""

    YES = "yes"
    NO = "no"
    UNKNOWN = "unknown"


class Quality(StrEnum):
    """How much a sample is worth."""

    GOOD = "good"
    UNCERTAIN = "uncertain"
    """Measured, but with a doubt: the drive missed polls lately, or its scale is not configured."""
    BAD = "bad"
    """Not a measurement any more: the last known value of a drive that does not answer."""


class LinkState(StrEnum):
    """Whether the drive answers."""

    UP = "up"
    DEGRADED = "degraded"
    """It missed its latest polls."""
    DOWN = "down"


class Provenance(StrEnum):
    """How the daemon knows a register that cannot be read back."""

    WRITTEN_AND_ACKNOWLEDGED = "written_and_acknowledged"
    """This daemon wrote it and the drive acknowledged."""
    ASSUMED = "assumed"
    """From the configuration or from what the manual says about a reset; nobody has confirmed it."""
    UNKNOWN = "unknown"
    """Anything may be in it."""


class RegisterInfo(Frozen):
    """One register of a drive that cannot be read back."""

    name: str
    """Its name in the drive's manual."""
    value: int | None
    """Raw value; null when it is unknown."""
    provenance: Provenance
    """How the value is known."""


class AxisLimits(Frozen):
    """Software limits, in axis units; a missing one does not limit."""

    position_min: float | None = None
    """Lowest target of any move."""
    position_max: float | None = None
    """Highest target of any move."""
    velocity: float | None = Field(default=None, gt=0)
    """Highest speed, in units a second."""
    acceleration: float | None = Field(default=None, gt=0)
    """Highest acceleration, in units a second squared."""


class AxisInfo(Frozen):
    """What an axis is: served on `meta/axes/<axis>`."""

    axis: str
    """Its name, the chunk in every key."""
    bus: str
    """The line it is on."""
    address: int = Field(ge=0, le=127)
    """Its node address or unit number on that line."""
    family: str
    """The drive family that speaks for it."""
    model: str
    """The configured drive model."""
    identity: str | None
    """What the drive said it is; null while it has not answered."""
    unit: str
    """Unit of all its values; "count" when no scale is configured."""
    counts_per_unit: float | None
    """Encoder counts per unit; null when no scale is configured and the axis works in counts."""
    direction: str
    """forward or reverse: the sign between counts and units."""
    limits: AxisLimits
    """Software limits in axis units."""
    capabilities: tuple[Verb, ...]
    """The commands it takes."""
    items: tuple[str, ...]
    """The telemetry items it publishes."""
    adc_full_scale: int | None
    """Counts of the A/D converter at full scale; null without one."""
    monitors: tuple[str, ...] = ()
    """The monitors it publishes below `monitor/`."""
    trace_channels: tuple[str, ...] = ()
    """What a trace can record."""
    priority: PollPriority = "normal"
    """How its polls fare while its line cannot carry all of them."""
    registers: tuple[RegisterInfo, ...] = ()
    """What the drive's write-only registers hold, as far as the daemon knows."""
