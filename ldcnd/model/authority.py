"""Who may move what: leases, and the envelope that every command can carry."""

from pydantic import Field

from ldcnd.model.frozen import Frozen

SHORTEST_LEASE_S = 0.2
"""Seconds that a lease lasts at least."""


class AcquireRequest(Frozen):
    """Take control of axes, or of the whole rig."""

    client: str = Field(min_length=1, max_length=64)
    """Who asks: a name for people, shown to others and in the log."""
    axes: tuple[str, ...] = ()
    """Which axes, or groups of them; none means all."""
    lease_s: float = Field(default=1.0, ge=SHORTEST_LEASE_S, le=60)
    """For how long, in seconds; it must be renewed before."""
    force: bool = False
    """Take control away from whoever has it; that is logged."""


class LeaseRequest(Frozen):
    """Renew or release a lease."""

    lease: str
    """As the reply to acquire named it."""


class LeaseReply(Frozen):
    """A lease that holds."""

    lease: str
    """To be carried by every command."""
    client: str
    """Who holds it."""
    axes: tuple[str, ...]
    """The axes it covers."""
    lease_s: float
    """It ends so many seconds after the daemon received this request, unless renewed."""


class HoldersRequest(Frozen):
    """Ask who controls what."""


class Holder(Frozen):
    """Who controls an axis."""

    axis: str
    """The axis."""
    client: str | None
    """Who; null when nobody does."""


class HolderList(Frozen):
    """Who controls what: the reply to `@cmd/_/holders`."""

    required: bool
    """Whether a lease is needed to move anything."""
    holders: tuple[Holder, ...]
    """Every axis."""
