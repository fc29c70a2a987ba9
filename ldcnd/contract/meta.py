"""The description of a rig for clients without prior knowledge: served under `meta/`."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Literal

from pydantic import Field

from ldcnd.contract.commands import Effect, Verb
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.health import LineCounters
from ldcnd.contract.plan import PollPriority
from ldcnd.contract.samples import SAMPLE_ITEMS, PastFault, Sample, TelemetryItem
from ldcnd.contract.units import Dimension

API = 1
"""Version of keys and payloads: it grows with a change that a program of before does not survive."""


class DaemonInfo(Frozen):
    """The daemon that serves a rig: `meta/daemon`."""

    rig: str
    """The rig id, second chunk of every key."""
    version: str
    """Version of ldcnd."""
    api: int
    """Version of keys and payloads; within one, fields, verbs and error codes are only added."""
    instance: str
    """Names this run of the daemon, as in its liveliness token."""
    started: int
    """Instant at which the daemon started, UTC in ns since 1970."""
    encoding: str
    """How telemetry is encoded."""
    axes: tuple[str, ...]
    """The configured axes."""
    buses: tuple[str, ...]
    """The configured lines."""


class CommandInfo(Frozen):
    """One command: what to send and what comes back."""

    verb: str
    """Last chunk of the key."""
    key: str
    """Key of the request: `@cmd/<axis>/<verb>`, or `@cmd/_/<verb>` when it concerns the rig."""
    summary: str
    """Effect of the request."""
    effect: Effect | None = None
    """What the command may do to the rig; null from a daemon of an earlier version."""
    needs_lease: bool | None = None
    """Whether the command needs a lease where leases are required; null from a daemon of an earlier version."""
    request_schema: str
    """Name of the payload's schema under `meta/schema/`."""
    reply_schema: str
    """Name of the reply's schema under `meta/schema/`."""


class CommandList(Frozen):
    """All commands and all error codes: `meta/commands`."""

    commands: tuple[CommandInfo, ...]
    """The commands and queries."""
    errors: tuple[str, ...]
    """Every code that an error reply can carry."""
    encodings: tuple[str, ...]
    """How payloads may be encoded; the reply uses the query's."""


class ModuleInfo(Frozen):
    """Something that answers on a line, axis or not."""

    address: int
    """Node address."""
    title: str
    """Its title in the profile."""
    model: str | None
    """Model name as in the configuration; null for an unknown device: it is never moved."""
    device_id: int
    """Device id reported by the module."""
    version: int
    """Firmware version reported by the module."""
    axis: str | None
    """The axis that it is; null for a module that is only kept on the line."""
    name: str | None = None
    """Name under which an I/O module is served; null for others."""
    outputs: tuple[str, ...] = ()
    """Names of the lines of an I/O module that are configured as outputs; no other line can be driven."""
    status: int | None
    """Latest status byte of a module that is no axis; null while it does not answer, and for axes."""


class BusInfo(LineCounters[int]):
    """One line: `meta/buses/<bus>`."""

    bus: str
    """Its name."""
    port: str
    """Port to which the line is connected."""
    baud: int
    """The rate in use."""
    up: bool
    """Its drives are polled."""
    problem: str
    """Why it is not up; empty while it is."""
    remarks: tuple[str, ...]
    """What was noteworthy when it came up; what is wrong now is said of its axes."""
    started_by: Literal["reset", "adoption"] | None = None
    """Whether the drives were reset, so that positions count from 0, or taken over as they were; null while down."""
    modules: tuple[ModuleInfo, ...] = ()
    """Modules found on the line, by address; empty while that is not known."""
    replies: int
    """Intact replies."""
    wire_busy_s: float
    """Seconds for which bytes were on the wire."""
    poll_p99_s: float
    """99 % of all polls were complete within this time after they were due, in seconds."""
    command_p99_s: float
    """The same for commands, from queueing."""
    stop_p50_s: float
    """Half of all stops had their reply within this time, in seconds; the bound is in `meta/budget`."""
    stop_p99_s: float
    """99 % of all stops had their reply within this time, in seconds."""
    stop_longest_s: float
    """The longest time from queueing a stop to its reply."""


class Provenance(StrEnum):
    """The source of the daemon's copy of a register that cannot be read back."""

    WRITTEN_AND_ACKNOWLEDGED = "written_and_acknowledged"
    """This daemon wrote it and the drive acknowledged."""
    RESET = "reset"
    """The drive was reset, and its manual says what is in it then."""
    READ_BACK = "read_back"
    """The drive has shown it."""
    ASSUMED = "assumed"
    """From the configuration, for a drive that was taken over as it is; not confirmed."""
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
    why: str = ""
    """The evidence for the value, or the reason why it is not known."""


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


def sample_units(unit: str) -> dict[str, str]:
    """Return the units in which the telemetry items of an axis give their values, by item.

    Args:
        unit: the axis unit.
    """
    in_unit: dict[str, str] = dict.fromkeys((TelemetryItem.POSITION, TelemetryItem.LATCH, TelemetryItem.STATE), unit)
    return {**in_unit, TelemetryItem.VELOCITY: f"{unit}/s"}


class AxisInfo(Frozen):
    """The description of an axis: served on `meta/axes/<axis>`."""

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
    """The identity that the drive reported; null while it has not answered."""
    unit: str
    """Unit of all its values; "count" when no scale is configured."""
    sample_units: dict[str, str] = Field(default_factory=dict)
    """The unit in which each telemetry item gives its values; others come from a daemon of before, or of after."""
    counts_per_unit: float | None
    """Encoder counts per unit; null when no scale is configured and the axis works in counts."""
    units: Mapping[Dimension, Mapping[str, str]] = {}
    """Units in which people read and type its positions, velocities and accelerations, each with how many of the units
    of the network it is, as a ratio of whole numbers; the first is shown. On the network that is `unit`, that a second
    and that a second squared."""
    g_velocity: float | None = None
    """Velocity at which 1 g acts at the radius of a rotor, in units a second; null without a radius."""
    direction: str
    """Sign between counts and units: forward or reverse."""
    modulo: float | None = None
    """A rotary axis: positions repeat after this distance, in axis units; null for others."""
    limits: AxisLimits
    """Software limits in axis units."""
    limit_stop: Literal["high", "low"] | None = None
    """Level of the limit switch inputs at which the drive stops a motion towards the switch; null when it does not."""
    approach: float | None = None
    """Signed distance over which moves come to their goal, in axis units; null without an approach from one side."""
    home_velocity: float | None = None
    """Search velocity of a `home` that names none, in units a second, positive forward; null when not configured."""
    group: str | None = None
    """Its group: axes that `move_together` starts in the same servo cycle; null when it is in none."""
    capabilities: tuple[Verb, ...]
    """The commands it takes."""
    items: tuple[str, ...]
    """The telemetry items it publishes."""
    adc_full_scale: int | None
    """Counts of the A/D converter at full scale; null without one."""
    monitors: tuple[str, ...] = ()
    """The monitors it publishes below `monitor/`."""
    trace_channels: tuple[str, ...] = ()
    """The channels that a trace can record."""
    priority: PollPriority = "normal"
    """How its polls fare while its line cannot carry all of them."""
    gains_for: Mapping[str, str] = {}
    """The set of gains that each kind of motion has of its own; empty where all motions have the same gains."""
    registers: tuple[RegisterInfo, ...] = ()
    """The contents of the drive's write-only registers, as far as they are known to the daemon."""
    past_faults: tuple[PastFault, ...] = ()
    """The latest faults, oldest first; with a `state_dir` also those before the daemon was started."""

    @property
    def meaning(self) -> tuple[str, float | None, str, float | None]:
        """What a number in units of the axis means: unit, scale, direction and turn."""
        return self.unit, self.counts_per_unit, self.direction, self.modulo

    def describes(self, sample: Sample) -> bool:
        """Tell whether the values of a sample are in the units of this description: a restart may bring others."""
        told = getattr(sample, "unit", None)  # a state of a daemon of before has none
        item = SAMPLE_ITEMS.get(type(sample))
        return told is None or item is None or told == sample_units(self.unit).get(item, told)
