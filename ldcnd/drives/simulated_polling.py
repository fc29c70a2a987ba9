"""Average duration of polls that are ordered by servo cycles: simulated, as no formula is known. Pure.

The queue and order of the bus poll simulated drives, with cycles of random phase and drift. The result depends on how
many polls are due at the same time, and so on all rates together.
"""

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from ldcnd.contract.errors import BusError
from ldcnd.drives.cost import Cost
from ldcnd.line.exchange import Exchange, Poller, ReplyVerdict, Timing, next_on_grid
from ldcnd.line.schedule import PhaseOrder, PollQueue
from ldcnd.line.settings import ServoCycle

LEARNING = 10
"""Polls of each drive on average until its cycle is known."""
COUNTED, FEWEST = 20, 200
"""Polls of each drive on average that count, and of all together at least."""
REHEARSALS = 3
"""Number of runs: the wait depends on the random phases, by a tenth of a cycle for 31 drives."""
DRIFT = 50e-6
"""Largest difference of crystals, as a fraction."""
_NOTHING: Exchange[None] = Exchange(0, b"", 0, lambda _: ReplyVerdict.INTACT, lambda _: None, 0.0, repeatable=True)


@dataclass(frozen=True, slots=True)
class PolledDrive:
    """One drive, with its poll.

    Attributes:
        rate_hz: rate of the poll.
        cost: of its poll, with the reply as long as it is on average.
    """

    rate_hz: float
    cost: Cost


@lru_cache(maxsize=64)
def mean_lengths_s(drives: tuple[PolledDrive, ...], cycle: ServoCycle, seed: int = 1) -> Sequence[float]:
    """Return how long the polls of each drive occupy the line on average, in seconds, in the order of the drives.

    Some fifty milliseconds of work for 31 drives; an overloaded line polls without a pause.
    """
    dice = random.Random(seed)  # noqa: S311 - for cycles that are made up
    lengths_s: list[list[float]] = [[] for _ in drives]
    for _ in range(REHEARSALS):
        _rehearse(drives, cycle, dice, lengths_s)
    return tuple(
        math.fsum(own_s) / len(own_s) if own_s else drive.cost.mean_s
        for drive, own_s in zip(drives, lengths_s, strict=True)
    )


def _rehearse(
    drives: tuple[PolledDrive, ...], cycle: ServoCycle, dice: random.Random, lengths_s: Sequence[list[float]]
) -> None:
    """Poll once with cycles of their own; append how long each poll took to the list of its drive."""
    order = PhaseOrder(cycle)
    queue = PollQueue(order.choose)
    pollers = [_Poller(node, drive, cycle, dice) for node, drive in enumerate(drives)]
    for poller in pollers:
        queue.schedule(poller, poller.due_at_s)
    now_s = 0.0
    learning = LEARNING * len(drives)
    for number in range(learning + max(FEWEST, COUNTED * len(drives))):
        while (due := queue.take(now_s)) is None:
            now_s = queue.next_due_s()
        poller = pollers[due.node]
        poller.next_exchange(now_s)
        queue.schedule(poller, poller.due_at_s)
        timing = poller.answer(now_s)
        # as the line does it: the next poll is chosen while this one is under way
        queue.choose_ahead(order.free_at_s(poller.node, timing.true_from_s, poller.reply_s))
        order.observe(poller.node, timing)
        over_s = timing.received_at_s + poller.drive.cost.overhead_s
        # until cycles are known the order is that of chance
        if number >= learning:
            lengths_s[poller.node].append(over_s - now_s)
        now_s = over_s


class _Poller(Poller[None]):
    """A drive that answers at the end of its cycle, and its turns."""

    def __init__(self, node: int, drive: PolledDrive, cycle: ServoCycle, dice: random.Random) -> None:
        self.node = node
        self.drive = drive
        self.due_at_s = 0.0
        self.deadline_at_s = self._period_s = 1.0 / drive.rate_hz
        self.reply_s = drive.cost.reply_s / cycle.stretch  # at the line's nominal rate
        self._cycle_s = cycle.length_s * (1.0 + dice.uniform(-DRIFT, DRIFT))
        self._phase_s = dice.uniform(0.0, cycle.length_s)

    def answer(self, now_s: float) -> Timing:
        """Return the timing of the reply to a request that leaves now."""
        cost = self.drive.cost
        over_s = now_s + cost.request_s
        begins_s = self._phase_s + math.ceil((over_s - self._phase_s) / self._cycle_s) * self._cycle_s
        received_s = begins_s + cost.reply_s
        return Timing(now_s, over_s, received_s - self.reply_s, received_s)

    def next_exchange(self, now_s: float) -> Exchange[None]:
        """See `Poller`; there is no line that a packet would be for."""
        self.due_at_s = next_on_grid(self.due_at_s, self._period_s, now_s)
        self.deadline_at_s = self.due_at_s + self._period_s
        return _NOTHING

    def deliver(self, reply: None, timing: Timing) -> None:
        """See `Poller`; nothing of the reply is needed."""

    def missed(self, error: BusError) -> None:
        """See `Poller`; does not happen here."""
