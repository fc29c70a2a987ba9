"""Bus budgets of a rig before anything is opened: served on `meta/budget`."""

from typing import Literal

from pydantic import Field

from ldcnd.contract.frozen import Frozen

PollPriority = Literal["high", "normal", "low"]
"""How the polls of an axis fare while its line cannot carry all of them."""


class ItemPlan(Frozen):
    """One telemetry item of one axis."""

    item: str
    """Last chunk of its key."""
    rate_hz: float
    """How often it is read."""
    response_s: float | None
    """Longest time from being due to being read; null when the line is full and there is no bound."""


class PollPlan(Frozen):
    """The periodic exchange of one axis, in which all its items travel, or of another module on the line."""

    axis: str
    """Whose: an axis, an I/O module by its name, or the address of a module without one in words."""
    address: int
    """Its node address."""
    request_bytes: int
    """Length of the request."""
    reply_bytes: int
    """Longest reply."""
    rate_hz: float
    """How often: as often as its fastest item."""
    longest_s: float
    """How long it occupies the line at most."""
    response_s: float | None
    """Longest time from being due to being over; null when the line is full and there is no bound."""
    holds: bool
    """It is always over before its next turn."""
    items: tuple[ItemPlan, ...]
    """The items that it carries."""
    priority: PollPriority = "normal"
    """How it fares while the line cannot carry all polls; what is promised does not depend on it."""


class LineLoad(Frozen):
    """What a line carries, and how soon it stops its drives."""

    load: float
    """Share of the line that polls take when every drive takes as long as it may."""
    mean_load: float
    """The same on average."""
    commands_per_s: float
    """Evenly spaced commands a second that fit in without making a poll miss its turn."""
    stop_wait_s: float
    """Longest time from a stop's arrival to its first bit, while no reply is lost."""
    stop_s: float
    """Time from a stop's arrival to the end of the drive's reply."""
    stop_after_loss_s: float
    """Time from a stop's arrival to the end of the drive's reply when the exchange before it is lost."""

    @property
    def stops(self) -> bool:
        """Whether the line can stop its drives: a stop has an exchange of its own."""
        return self.stop_s > self.stop_wait_s


class BusPlan(LineLoad):
    """One line."""

    bus: str
    """Its name."""
    family: str
    """The drive family on it."""
    baud: int
    """Nominal rate."""
    node_baud: float
    """The rate that the drives' clocks make of it."""
    turnaround_s: float
    """Assumed of the host, between a reply and the next request."""
    adapter_latency_s: float
    """Assumed of the adapter, for each reply."""
    stop_probe_hz: float
    """How often the wait of a stop is measured by a stop probe; counted in the load."""
    holds: bool
    """No poll can come too late."""
    overload: str
    """Reaction if not: refuse or skip."""
    remedies: tuple[str, ...]
    """The smallest changes that would make it hold; empty when it does."""
    polls: tuple[PollPlan, ...]
    """The polls of the line."""


class RigBudget(Frozen):
    """All lines of a rig: `meta/budget`."""

    rig: str
    """The rig id."""
    holds: bool = Field(description="Every line holds.")
    buses: tuple[BusPlan, ...]
    """One plan for each line that is planned."""
