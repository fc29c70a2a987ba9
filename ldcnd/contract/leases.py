"""Control of axes: leases, and who holds them."""

from typing import Annotated

from pydantic import ConfigDict, Field

from ldcnd.contract.commands import About, Command, Effect
from ldcnd.contract.frozen import Frozen

SHORTEST_LEASE_S = 0.2
"""Seconds that a lease lasts at least."""


class LeaseReply(Frozen):
    """A lease that holds."""

    lease: str
    """Lease that every command has to carry."""
    client: str
    """Who holds it."""
    axes: tuple[str, ...]
    """The axes it covers."""
    lease_s: float
    """Its duration from the daemon's receipt of this request, in seconds, unless renewed."""


class Acquire(Command[LeaseReply]):
    """Take control of axes, or of the whole rig."""

    verb = "acquire"
    about = About.RIG

    client: str = Field(min_length=1, max_length=64)
    """The requester: a name for people, shown to others and in the log."""
    axes: tuple[str, ...] = ()
    """Axes, or groups of them, to control; none means all."""
    lease_s: float = Field(default=1.0, ge=SHORTEST_LEASE_S, le=60)
    """Duration of the lease, in seconds; it must be renewed before its end."""
    force: bool = False
    """Take control from its present holder; that is logged."""
    replaces: tuple[Annotated[str, Field(max_length=64)], ...] = Field(default=(), max_length=128)
    """Leases of the requester. Those that cover a wanted axis end, and what moves under them goes on under the new one.
    A held lease that is not named is refused, also to the same client: a lease belongs to who has its token."""


class LeaseRequest(Frozen):
    """Renew or release a lease."""

    lease: str
    """Lease that the reply to acquire named."""


class Renew(LeaseRequest, Command[LeaseReply]):
    """Keep a lease for its duration from now on."""

    model_config = ConfigDict(title="LeaseRequest")

    verb = "renew"
    about = About.RIG


class Release(Command[LeaseReply]):
    """Give a lease back; an axis that still moves does what its policy for the loss of a client says."""

    verb = "release"
    about = About.RIG

    lease: str
    """Lease that the reply to acquire named."""
    leave_running: bool = False
    """Let what moves go on to its own end, without a holder of control; no further motion of its command begins."""


class Holder(Frozen):
    """Who controls an axis."""

    axis: str
    """The axis."""
    client: str | None
    """The client in control; null without one."""


class HolderList(Frozen):
    """Who controls what: the reply to `@cmd/_/holders`."""

    required: bool
    """Whether a lease is needed to move anything."""
    holders: tuple[Holder, ...]
    """Every axis."""


class ListHolders(Command[HolderList]):
    """Query who controls what."""

    verb = "holders"
    about = About.RIG
    effect = Effect.QUESTION


class GuestSentAway(Frozen):
    """The program has gone: the reply to `@cmd/_/send_guest_away`."""

    port: str
    """Name of the port; it is served on."""
    axes: tuple[str, ...]
    """Axes that the program controlled; one that still moves does what its policy for the loss of a client says."""


class SendGuestAway(Command[GuestSentAway]):
    """Close the terminal or the connection of the program at a port, and end its control."""

    verb = "send_guest_away"
    about = About.RIG

    port: str
    """Name of the port."""
    client: str | None = Field(default=None, max_length=64)
    """The requester, for events and log."""


COMMANDS: tuple[type[Command[Frozen]], ...] = (
    Acquire,
    Renew,
    Release,
    ListHolders,
    SendGuestAway,
)
"""The commands of this file."""
