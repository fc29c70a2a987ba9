"""What happened on a rig, in one order: commands, who had control, faults, and what drives did by themselves."""

from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum

from ldcnd.client.events import latest_events
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.events import (
    ALARM_HISTORY,
    DRIVE_CHANGED,
    INTERLOCK,
    LATCH,
    LINK_BACK,
    LINK_LOST,
    REFERENCE,
    UNSETTLED,
    CommandEvent,
    ReadEvents,
)
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.meta import AxisInfo, DaemonInfo
from ldcnd.contract.samples import PastFault

CONTROL = frozenset({"acquire", "renew", "release", "override_interlock"})
BY_ITSELF = frozenset({ALARM_HISTORY, DRIVE_CHANGED, INTERLOCK, LINK_BACK, REFERENCE, UNSETTLED})
MOST_EVENTS = 1000


class HistoryKind(StrEnum):
    """What kind of thing happened."""

    COMMAND = "command"
    """A command got further."""
    CONTROL = "control"
    """Control was taken, lost or refused, or an interlock was overridden."""
    FAULT = "fault"
    """A fault was seen, or the loss of a line or of an I/O module."""
    DAEMON = "daemon"
    """The daemon was started: of what an earlier run of it has seen only faults and latched stops are known."""
    DRIVE = "drive"
    """A drive did something that no command of the daemon explains; what was lost answers again."""


class HistoryRow(Frozen):
    """One thing that happened."""

    t: int
    """Instant, UTC in ns since 1970."""
    kind: HistoryKind
    """What kind of thing it was."""
    axis: str
    """The axis, the I/O module or the line; empty for what concerns the rig."""
    what: str
    """The verb of the command, of `power` with on or off, or the code of the fault."""
    how: str
    """How far a command has got; empty for what is no command."""
    who: str
    """The client as it calls itself, with its login; empty where there was none."""
    why: str
    """The reason, or what the fault means."""
    code: str | None = None
    """The error code of what was refused or failed."""
    target: float | None = None
    """Where a motion was to come to rest, in axis units."""
    position: float | None = None
    """Where a motion ended, in axis units."""
    last_position: float | None = None
    """Where the axis was read last when a motion ended otherwise; it may have moved on."""
    command_id: str | None = None
    """The command."""
    line: str | None = None
    """The line of the axis: `ldcnd bus wire-log` shows its packets of that moment, as long as they are kept."""
    known_from: int | None = None
    """Instant from which on all events are known, UTC in ns; null in rows of what happens meanwhile."""


def row_of(event: CommandEvent, line: str | None) -> HistoryRow:
    """Return an event as a row."""
    kind = HistoryKind.COMMAND
    if event.verb in CONTROL:
        kind = HistoryKind.CONTROL
    elif event.verb == LATCH:
        kind = HistoryKind.DAEMON
    elif event.verb == LINK_LOST:
        kind = HistoryKind.FAULT
    elif event.verb in BY_ITSELF:
        kind = HistoryKind.DRIVE
    login = f" ({event.login})" if event.login else ""
    return HistoryRow(
        t=event.t,
        kind=kind,
        axis=event.axis,
        what=event.verb if event.on is None else f"{event.verb} {'on' if event.on else 'off'}",
        how="" if kind in (HistoryKind.DAEMON, HistoryKind.DRIVE, HistoryKind.FAULT) else event.status.value,
        who=f"{event.client or ''}{login}".strip(),
        why=event.reason or "",
        code=event.code,
        target=event.target,
        position=event.position,
        last_position=event.last_position,
        command_id=event.command_id,
        line=line,
    )


def _row_of_fault(axis: AxisInfo, fault: PastFault) -> HistoryRow:
    return HistoryRow(
        t=fault.since,
        kind=HistoryKind.FAULT,
        axis=axis.axis,
        what=fault.code,
        how="",
        who="",
        why=fault.text,
        code=fault.code,
        line=axis.bus,
    )


def _row_of_start(daemon: DaemonInfo) -> HistoryRow:
    why = f"ldcnd {daemon.version}, run {daemon.instance}"
    return HistoryRow(t=daemon.started, kind=HistoryKind.DAEMON, axis="", what="started", how="", who="", why=why)


@dataclass(frozen=True, slots=True)
class Beginning:
    """From when on all events are known.

    Attributes:
        t: that instant, UTC in ns since 1970.
        discarded: how many events of this run were before it; 0 when it is the start of the daemon.
    """

    t: int
    discarded: int

    def __str__(self) -> str:
        """Return what became of those before, for people."""
        if self.discarded:
            lost = f"the {self.discarded} events before {clock_time(self.t)} are not kept any more"
        else:
            lost = f"events before {clock_time(self.t)} are not known: this daemon began then"
        return f"{lost}; a recorder keeps them: ldcnd record"


async def beginning(client: RigClient) -> Beginning:
    """Return from when on a daemon knows all events: it keeps those of its own run, and of these the latest."""
    page = await client.ask(ReadEvents(from_number=0, count=1))
    if page.first_number and page.events:
        return Beginning(page.events[0].t, page.first_number)
    return Beginning((await client.daemon()).started, 0)


def clock_time(t_ns: int) -> str:
    """Return an instant as the rows of `ldcnd log` have it."""
    return datetime.fromtimestamp(t_ns / 1e9, UTC).isoformat(timespec="milliseconds")


async def history(
    client: RigClient, known_from: Beginning, axis: str | None = None, since_ns: int = 0
) -> list[HistoryRow]:
    """Return what happened, oldest first, as far as the daemon remembers it.

    Args:
        client: of the rig.
        known_from: from when on that is.
        axis: only of this axis; of all when missing.
        since_ns: none before this instant, UTC in ns since 1970.
    """
    axes = {info.axis: info for info in await client.axes()}
    faults = {name: sample.active for name, sample in (await client.faults()).items()}
    last = {event.command_id: event for event in await latest_events(client, MOST_EVENTS, axis)}  # how each has ended
    rows = [row_of(event, axes[event.axis].bus if event.axis in axes else None) for event in last.values()]
    for name, info in axes.items():
        if axis in (None, name):
            seen = {(fault.code, fault.since): fault for fault in (*info.past_faults, *faults.get(name, ()))}
            rows += [_row_of_fault(info, fault) for fault in seen.values()]
    rows.append(_row_of_start(await client.daemon()))
    rows = sorted((row for row in rows if row.t >= since_ns), key=lambda row: row.t)
    return [row.model_copy(update={"known_from": known_from.t}) for row in rows]
