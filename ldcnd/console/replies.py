"""Replies of the console that are no public model of the daemon."""

from ldcnd.console.sequences import RunnablesReply
from ldcnd.contract.commands import ErrorReply, StopReply
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.meta import AxisInfo, BusInfo, CommandList, DaemonInfo
from ldcnd.contract.plan import RigBudget


class RigReply(Frozen):
    """One rig, as it described itself when it was last there."""

    name: str
    """The rig id."""
    endpoint: str
    """Through which it is reached."""
    connected: bool
    """Its daemon is there."""
    problem: str | None
    """The problem of the connection, in words."""
    attention: str = ""
    """What is to be seen to of the daemon itself, in words, though it works."""
    daemon: DaemonInfo | None = None
    """None before it was ever there; the others likewise."""
    axes: tuple[AxisInfo, ...] = ()
    """In the order of lines and addresses."""
    buses: tuple[BusInfo, ...] = ()
    """Its lines."""
    plan: RigBudget | None = None
    """The bus budgets of the lines."""
    commands: CommandList | None = None
    """The commands of the rig."""
    can_run: RunnablesReply = RunnablesReply()
    """Its sequences and named positions."""


class EndpointReply(Frozen):
    """One session of the console."""

    endpoint: str
    """Where it connects to."""
    connected: bool
    """It is open; rigs behind it may be away all the same."""
    problem: str | None
    """Why it is not, in words, or what is left out of it."""


class RigsReply(Frozen):
    """`GET /api/rigs`."""

    version: str
    """Of the console."""
    client: str
    """The name under which this browser's commands go."""
    endpoints: tuple[EndpointReply, ...]
    """The sessions of the console."""
    rigs: tuple[RigReply, ...]
    """By name."""
    commissions: bool = False
    """It has a commissioning page."""


class StopsReply(Frozen):
    """`POST /api/stop`."""

    rigs: dict[str, StopReply | ErrorReply]
    """The outcome of the stop, by rig."""


class LinkReply(Frozen):
    """`POST /api/link`."""

    link: str
    """Opens the console in one more browser, once, within ten minutes."""
