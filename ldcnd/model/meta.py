"""What describes a rig to those who have never heard of it: served under `meta/`."""

from typing import Literal

from ldcnd.model.frozen import Frozen


class DaemonInfo(Frozen):
    """The daemon that serves a rig: `meta/daemon`."""

    rig: str
    """The rig id, second chunk of every key."""
    version: str
    """Version of ldcnd."""
    api: int
    """Version of keys and payloads; fields are only ever added within one."""
    instance: str
    """Names this run of the daemon, as in its liveliness token."""
    started: int
    """When it started, UTC in ns since 1970."""
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
    """Where to ask: `@cmd/<axis>/<verb>`, or `@cmd/_/<verb>` when it concerns the rig."""
    summary: str
    """What it does."""
    request_schema: str
    """Name of the payload's schema under `meta/schema/`."""
    reply_schema: str
    """Name of the reply's schema under `meta/schema/`."""


class CommandList(Frozen):
    """All commands and all error codes: `meta/commands`."""

    commands: tuple[CommandInfo, ...]
    """What can be asked."""
    errors: tuple[str, ...]
    """Every code that an error reply can carry."""
    encodings: tuple[str, ...]
    """How payloads may be encoded; the reply uses the query's."""


class ModuleInfo(Frozen):
    """Something that answers on a line, axis or not."""

    address: int
    """Node address."""
    title: str
    """What it is."""
    model: str | None
    """Model name as in the configuration; null for a device that nobody described: it is never moved."""
    device_id: int
    """As it reports."""
    version: int
    """As it reports."""
    axis: str | None
    """The axis that it is; null for a module that is only kept on the line."""
    status: int | None
    """Latest status byte of a module that is no axis; null while it does not answer, and for axes."""


class BusInfo(Frozen):
    """One line: `meta/buses/<bus>`."""

    bus: str
    """Its name."""
    port: str
    """Where it is connected."""
    baud: int
    """The rate in use."""
    up: bool
    """Its drives are polled."""
    problem: str
    """Why it is not up; empty while it is."""
    remarks: tuple[str, ...]
    """What deserves a look although it is up."""
    started_by: Literal["reset", "adoption"] | None = None
    """Whether the drives were reset, so that positions count from 0, or taken over as they were; null while down."""
    modules: tuple[ModuleInfo, ...] = ()
    """What was found on the line, by address; empty while that is not known."""
    exchanges: int
    """Requests sent since the daemon started, the other counters likewise."""
    replies: int
    """Intact replies."""
    timeouts: int
    """Exchanges without a complete reply."""
    corrupt_replies: int
    """Replies that could not be trusted."""
    rejected_packets: int
    """Packets that a node received damaged and did not execute."""
    resent: int
    """Exchanges sent again."""
    resynchronisations: int
    """How often the line was fenced."""
    stray_bytes: int
    """Bytes that nobody had asked for."""
    losses: int
    """How often the port was lost."""
    wire_busy_s: float
    """Seconds for which bytes were on the wire."""
    poll_p99_s: float
    """99 % of all polls were complete within so many seconds after they were due."""
    command_p99_s: float
    """The same for commands, from queueing."""
    stop_p50_s: float
    """Half of all stops had their reply within so many seconds; the bound is in `meta/plan`."""
    stop_p99_s: float
    """99 % of all stops had their reply within so many seconds."""
    stop_longest_s: float
    """The longest time from queueing a stop to its reply."""
