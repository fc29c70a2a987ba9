"""How well a rig is doing, once a second: what a monitoring system watches."""

from enum import StrEnum
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import Field

from ldcnd.contract.frozen import Frozen
from ldcnd.contract.samples import LinkState


class LaneHealth(Frozen):
    """Waiting exchanges and latency of one lane of a line."""

    lane: Literal["stop", "command", "poll", "background"]
    """Stops go before commands, commands before polls, background work comes last."""
    waiting: int = Field(ge=0)
    """Exchanges that wait now; polls are scheduled, not queued, and never counted here."""
    exchanges: int = Field(ge=0)
    """Replies since the daemon started."""
    p50_s: float = Field(ge=0)
    """Half of them came within this time after they were queued (polls: after they were due), in seconds."""
    p99_s: float = Field(ge=0)
    """The same for 99 %."""
    longest_s: float = Field(ge=0)
    """The longest one."""
    total_s: float = Field(default=0.0, ge=0)
    """All of them together."""
    counts: tuple[int, ...] = ()
    """How many took how long: the first counts those of less than 64 us, each further one those of less than twice the
    limit before, the last all others."""


class ItemHealth(Frozen):
    """How often one telemetry item comes."""

    item: str
    """Last chunk of its key."""
    asked_hz: float = Field(ge=0)
    """Its polling rate."""
    granted_hz: float = Field(ge=0)
    """How often it was published in the last period."""


class StopWaitHealth(Frozen):
    """How long a single stop waits for the line, to its first bit: measured by questions in its place."""

    bound_s: float | None = Field(ge=0)
    """Upper bound by the plan while no reply is lost; null where the line has no plan."""
    probes: int = Field(ge=0)
    """How often it was measured since the daemon started."""
    p99_s: float = Field(ge=0)
    """99 % waited no longer."""
    longest_s: float = Field(ge=0)
    """The longest one; after a lost reply it may exceed the bound."""


class AxisHealth(Frozen):
    """How fresh an axis's samples are."""

    axis: str
    """The axis."""
    link: LinkState
    """Whether its drive answers."""
    sample_age_s: float | None = Field(ge=0)
    """Age of the latest position, in seconds; null before the first."""
    rate_wanted_hz: float = Field(ge=0)
    """The configured rate of the position."""
    rate_hz: float = Field(ge=0)
    """How often it was published in the last period."""
    faults: int = Field(ge=0)
    """Faults that stand now."""
    items: tuple[ItemHealth, ...] = ()
    """Its polled items; empty for a drive family that paces itself."""
    overrides: tuple[str, ...] = ()
    """Overridden interlocks that bind it or an output of its line: which, by whom, for how long still; for people."""
    eeprom_writes: int | None = Field(default=None, ge=0)
    """How often its drive's EEPROM was written, ever; null for drives without one and where no ledger is kept."""


class ModuleHealth(Frozen):
    """Whether an I/O module answers, and what it has lost."""

    module: str
    """The module."""
    link: LinkState
    """Whether it answers."""
    floating: tuple[str, ...] = ()
    """Named outputs that were set before it lost its power, and that float until they are set again."""


class GuestHealth(Frozen):
    """A port on the line, and the program that uses it."""

    port: str
    """Its configured name, under which the program holds leases."""
    problem: str = ""
    """Why the port is not served; empty while it is."""
    since: int | None = None
    """Instant of the program's first byte, UTC in ns since 1970; null without a program."""
    axes: tuple[str, ...] = ()
    """The axes that it controls."""
    packets_hz: float = Field(default=0.0, ge=0)
    """Its packets that wanted a reply, each second, in the last period."""
    refused: int = Field(default=0, ge=0)
    """Number of its commands that were answered and not done, since the daemon started; events have the reasons."""


CountT = TypeVar("CountT", bound=int)


class LineCounters(Frozen, Generic[CountT]):
    """Counters of one line since the daemon started."""

    exchanges: CountT
    """Requests sent since the daemon started, the other counters likewise."""
    timeouts: CountT
    """Exchanges without a complete reply."""
    corrupt_replies: CountT
    """Replies that could not be trusted."""
    rejected_packets: CountT
    """Packets that a node received damaged and did not execute."""
    resent: CountT
    """Exchanges sent again."""
    resynchronisations: CountT
    """How often the line was resynchronised."""
    stray_bytes: CountT
    """Bytes that belong to no request."""
    losses: CountT
    """How often the port was lost."""


class BusHealth(LineCounters[Annotated[int, Field(ge=0)]]):
    """One line and its axes: published each second on `meta/health/<bus>`."""

    t: int
    """Instant of the sample, UTC in ns since 1970."""
    seq: int = Field(ge=0)
    """Grows by one with every report."""
    bus: str
    """The line."""
    up: bool
    """Its drives are polled."""
    utilisation: float = Field(ge=0)
    """Share of the last period for which bytes were on the wire, 0 to 1; waiting for drives is not counted."""
    lanes: tuple[LaneHealth, ...]
    """The most urgent first."""
    stop_wait: StopWaitHealth
    """How long a stop would have to wait."""
    axes: tuple[AxisHealth, ...]
    """The axes on the line."""
    modules: tuple[ModuleHealth, ...] = ()
    """Its I/O modules that have a name."""
    guests: tuple[GuestHealth, ...] = ()
    """Its ports that are served."""


class HeartbeatHealth(Frozen):
    """The wire that changes its level while the daemon works."""

    beating: bool
    """Whether it changes now."""
    why: str = ""
    """Why it does not, for a person; empty while it does."""
    changes: int = Field(ge=0)
    """How often it has changed since the daemon started."""


class CertificateHealth(Frozen):
    """A certificate and until when it is good."""

    name: str
    """Its common name, as the login of `ldcnd pki`."""
    ends: int
    """Its end, UTC in ns since 1970."""
    authority: bool = False
    """It is the authority's, which has signed all others of the site."""


class DaemonHealth(Frozen):
    """The daemon's process: published each second on `meta/health`."""

    t: int
    """Instant of the sample, UTC in ns since 1970."""
    seq: int = Field(ge=0)
    """Grows by one with every report."""
    loop_lag_s: float = Field(ge=0)
    """The longest that a timer of the daemon came too late in the last period, in seconds."""
    published: int = Field(ge=0)
    """Samples and events handed to the network since the daemon started; what is lost there, `seq` tells receivers."""
    missed_reports: int = Field(ge=0)
    """Reports that were left out since the daemon started because it was held up for longer than a period."""
    waiting_queries: int = Field(default=0, ge=0)
    """Queries that have no answer yet: questions, commands and stops."""
    dropped: int = Field(default=0, ge=0)
    """Queries that were refused for being too many, and lost changes of clients' presence, since the daemon started."""
    not_kept: tuple[str, ...] = ()
    """Files of the `state_dir` that cannot be written, each with the reason: what they hold is lost with the daemon."""
    certificate: CertificateHealth | None = None
    """The one that ends first of those that the daemon has used since its start; None where it uses none."""
    heartbeat: HeartbeatHealth | None = None
    """The heartbeat; None where none is configured."""
    version: str = ""
    """The version of ldcnd that runs; empty from a daemon of an earlier version."""


class Verdict(StrEnum):
    """Meaning of a finding."""

    FINE = "fine"
    LOOK = "look"
    """Nothing is wrong for certain, but it deserves attention."""
    WRONG = "wrong"
    """It must be put right before the line is used."""


class Finding(Frozen):
    """One thing that was examined."""

    axis: str
    """The drive, or the line where it is no single one."""
    what: str
    """The subject of the check."""
    verdict: Verdict
    """Meaning of the result."""
    text: str
    """The result, for a person."""
    verifies: str | None = None
    """The assumption of the drive's profile that it says something about."""
    remedy: str | None = None
    """Command, or entry of the configuration, that corrects it."""
