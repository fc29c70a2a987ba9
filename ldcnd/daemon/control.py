"""Everything that decides about commands, as one: who may, whether again, what became of it."""

from collections.abc import Callable
from dataclasses import dataclass

from ldcnd.daemon.authority import Authority, random_token
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.command_desk import CommandDesk
from ldcnd.daemon.event_log import EventLog
from ldcnd.daemon.ledger import Ledger
from ldcnd.daemon.rig import Rig
from ldcnd.daemon.rig_desk import RigDesk


@dataclass(frozen=True, slots=True)
class Control:
    """The desks of one rig and their books."""

    authority: Authority
    commands: CommandDesk
    rig: RigDesk
    events: EventLog


def build_control(
    rig: Rig,
    ledger: Ledger,
    events: EventLog,
    clock: Clock,
    next_command_id: Callable[[], str],
    *,
    instance: str,
    leased: bool,
    next_token: Callable[[], str] = random_token,
) -> Control:
    """Set up the desks of a rig whose axes report to this ledger already."""
    authority = Authority(rig.axes, required=leased, next_token=next_token)
    return Control(
        authority,
        CommandDesk(rig, authority, ledger, clock, next_command_id, instance),
        RigDesk(rig, authority, ledger, events, clock),
        events,
    )
