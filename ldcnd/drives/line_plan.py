"""Bus budget of one line: whether it can carry its polls, and the spare capacity. Pure.

A plan holds when every poll is over before its next turn in the worst case, every drive taking as long as it may. The
time of a lost reply is stated separately: no schedule can meet deadlines on a line that loses packets.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ldcnd.contract.plan import LineLoad
from ldcnd.drives.cost import Cost
from ldcnd.drives.response_times import FULL, PeriodicTask, load_of, meets_deadlines, response_times_s, taking_turns_s
from ldcnd.drives.simulated_polling import PolledDrive, mean_lengths_s
from ldcnd.line.settings import ServoCycle

STEPS = 16
"""Bisection steps when a largest value is sought: far finer than any measurement."""


@dataclass(frozen=True, slots=True)
class Poll:
    """A periodic request, of one exchange or a few.

    Attributes:
        axis: its name; the name of an I/O module, or words for a module that has none.
        items: items that it reads in the worst case.
        rate_hz: highest rate.
        cost: with all these items.
        mean_s: with the items that it reads on average.
        exchanges: number that it takes.
        address: of a module that is no axis.
    """

    axis: str
    items: tuple[str, ...]
    rate_hz: float
    cost: Cost
    mean_s: float
    exchanges: int = 1
    address: int | None = None

    @property
    def mean_cost(self) -> Cost:
        """As `cost`, with a reply that is as long as it is on average."""
        return replace(self.cost, reply_s=self.cost.reply_s - (self.cost.mean_s - self.mean_s))

    @property
    def task(self) -> PeriodicTask:
        """As the analysis sees it."""
        return PeriodicTask(1.0 / self.rate_hz, self.cost.longest_s, self.exchanges)


@dataclass(frozen=True, slots=True)
class Urgent:
    """Exchanges that go before polls, in seconds.

    Attributes:
        command_s: longest command exchange.
        stop_s: longest stop exchange.
        recovery_s: from a reply's deadline to the instant at which the line may be used by a stop: the flush.
        margin_s: by which a reply's deadline exceeds its longest time.
        search_s: longest exchange of the search for a lost drive; only while one is missing.
        probe: of the stop lane; None for none.
    """

    command_s: float
    stop_s: float
    recovery_s: float
    margin_s: float
    search_s: float = 0.0
    probe: PeriodicTask | None = None


@dataclass(frozen=True, slots=True)
class LinePlan:
    """Result for one line.

    Attributes:
        polls: its polls.
        responses_s: for each of them, from being due to being over at the latest, without commands.
        figures: what the line carries then.
    """

    polls: tuple[Poll, ...]
    responses_s: tuple[float, ...]
    figures: LineLoad

    @property
    def late(self) -> tuple[Poll, ...]:
        """The polls that can come too late; none when the plan holds."""
        return tuple(
            poll
            for poll, response_s in zip(self.polls, self.responses_s, strict=True)
            if response_s > poll.task.period_s
        )

    @property
    def holds(self) -> bool:
        """Whether no poll can come too late."""
        return not self.late


def plan_line(
    polls: Sequence[Poll], urgent: Urgent, *, by_deadline: bool = True, cycle: ServoCycle | None = None
) -> LinePlan:
    """Compute the budget of a line.

    Args:
        polls: its polls.
        urgent: exchanges that go before them.
        by_deadline: the earliest deadline goes first; otherwise axes take turns, exchange by exchange.
        cycle: of the drives, where polls with the same deadline are ordered by it.
    """
    tasks = [poll.task for poll in polls]
    probes = [urgent.probe] if urgent.probe else []
    # a stop does not interrupt what is on the wire, and nothing else goes before it
    longest_s = max([urgent.command_s, *(task.cost_s for task in tasks)])
    stop_s = longest_s + urgent.stop_s
    return LinePlan(
        polls=tuple(polls),
        responses_s=tuple(response_times_s(tasks, urgent=probes) if by_deadline else _in_turns_s(polls, probes)),
        figures=LineLoad(
            load=load_of([*tasks, *probes]),
            mean_load=_mean_load(polls, cycle) + load_of(probes),
            commands_per_s=_most_commands_per_s(polls, probes, urgent.command_s, by_deadline=by_deadline),
            stop_wait_s=longest_s,
            stop_s=stop_s,
            stop_after_loss_s=max(longest_s, urgent.search_s) + urgent.margin_s + urgent.recovery_s + urgent.stop_s,
        ),
    )


def _mean_load(polls: Sequence[Poll], cycle: ServoCycle | None) -> float:
    lengths_s: Sequence[float] = [poll.mean_s for poll in polls]
    # one drive alone leaves nothing to choose
    if cycle and len(polls) > 1:
        lengths_s = mean_lengths_s(tuple(PolledDrive(poll.rate_hz, poll.mean_cost) for poll in polls), cycle)
    return math.fsum(poll.rate_hz * length_s for poll, length_s in zip(polls, lengths_s, strict=True))


def in_time(polls: Sequence[Poll], urgent: Sequence[PeriodicTask], *, by_deadline: bool) -> bool:
    """Tell whether every poll is always over before its next turn."""
    if by_deadline:
        return meets_deadlines([poll.task for poll in polls], *urgent)
    bounds_s = _in_turns_s(polls, urgent)
    return all(bound_s <= poll.task.period_s for bound_s, poll in zip(bounds_s, polls, strict=True))


def _in_turns_s(polls: Sequence[Poll], urgent: Sequence[PeriodicTask]) -> list[float]:
    places: dict[str, list[int]] = {}
    for place, poll in enumerate(polls):
        places.setdefault(poll.axis, []).append(place)
    bounds_s = [0.0] * len(polls)
    units = [[polls[place].task for place in unit] for unit in places.values()]
    for unit, unit_bounds_s in zip(places.values(), taking_turns_s(units, urgent), strict=True):
        for place, bound_s in zip(unit, unit_bounds_s, strict=True):
            bounds_s[place] = bound_s
    return bounds_s


def largest(fits: Callable[[float], bool], least: float, most: float) -> float | None:
    """Return the largest value for which something fits, None when not even the least does.

    Args:
        fits: true up to some value, false above it.
        least: where to begin.
        most: where to end.
    """
    if fits(most):
        return most
    if not fits(least):
        return None
    for _ in range(STEPS):
        middle = (least + most) / 2
        if fits(middle):
            least = middle
        else:
            most = middle
    return least


def _most_commands_per_s(
    polls: Sequence[Poll], probes: Sequence[PeriodicTask], command_s: float, *, by_deadline: bool
) -> float:
    room = (FULL - load_of([*(poll.task for poll in polls), *probes])) / command_s
    least = room / 2**STEPS
    if room <= 0.0:
        return 0.0

    def fits(rate: float) -> bool:
        return in_time(polls, [*probes, PeriodicTask(1.0 / rate, command_s)], by_deadline=by_deadline)

    return largest(fits, least, room) or 0.0
