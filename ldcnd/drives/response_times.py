"""How late polls can be at worst: response times on a line whose exchanges cannot be interrupted. Pure.

The line serves lanes by fixed priority without pre-emption; within the poll lane the earliest deadline goes first, the
deadline of a poll being its next period. So a poll waits for the exchange on the wire (blocking), for commands, and for
polls whose deadline is not later.

Analysis: George, Rivierre, Spuri, "Preemptive and non-preemptive real-time uniprocessor scheduling" (INRIA RR-2966,
1996), section on non-pre-emptive EDF: the worst case of a task lies in a busy period in which all others are released
together, at one of a finite number of offsets.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

FULL = 0.98
"""Share of the line above which it counts as full: the analysis would take long to say that the polls come too late."""
_ALMOST = 1e-9
"""Periods: releases that coincide up to rounding do coincide."""


@dataclass(frozen=True, slots=True)
class PeriodicTask:
    """A periodic task that should be over by its next turn.

    Attributes:
        period_s: least time between two turns.
        cost_s: longest occupation of the line.
        exchanges: that it is made of; where units take turns, those of others come between any two.
    """

    period_s: float
    cost_s: float
    exchanges: int = 1


def load_of(tasks: Sequence[PeriodicTask]) -> float:
    """Return the share of the line that tasks need at worst; above 1 it cannot give it."""
    return math.fsum(task.cost_s / task.period_s for task in tasks)


def response_times_s(
    tasks: Sequence[PeriodicTask], blocking_s: float = 0.0, urgent: Sequence[PeriodicTask] = ()
) -> list[float]:
    """Return for each task how long after it was due its exchange can be over at the latest.

    Args:
        tasks: all polls of a line.
        blocking_s: longest other exchange that can have begun just before.
        urgent: what goes before all of them whenever it is there.

    Returns:
        Seconds, in the order of `tasks`; infinity for all of them when the line is full.
    """
    if load_of([*tasks, *urgent]) > FULL:
        return [math.inf] * len(tasks)
    classes = _classes(tasks)
    busy_s = _busy_period_s([*tasks, *urgent], max([blocking_s, *(task.cost_s for task in tasks)]))
    ahead = [(each.period_s, each.cost_s, int(busy_s / each.period_s) + 1) for each in urgent]
    known: dict[PeriodicTask, float] = {}
    for task in tasks:
        if task not in known:
            known[task] = 0.0
            for at_s in _offsets_s(task, classes, busy_s):
                known[task] = _response_s(task, at_s, classes, blocking_s, known[task], ahead)
    return [known[task] for task in tasks]


def meets_deadlines(tasks: Sequence[PeriodicTask], *urgent: PeriodicTask) -> bool:
    """Tell whether every task is always over before its next turn.

    The demand of all deadlines up to an instant, one less urgent exchange that is on the wire, and what goes before all
    polls until then must fit before that instant; exact without the last (Jeffay, Stanat, Martel, "On non-preemptive
    scheduling of periodic and sporadic tasks", RTSS 1991), sufficient with it.
    """
    everything = [*tasks, *urgent]
    if load_of(everything) > FULL:
        return False
    classes = _classes(tasks)
    urgent_s = max((each.cost_s for each in urgent), default=0.0)
    busy_s = _busy_period_s(everything, max([urgent_s, *(task.cost_s for task in tasks)]))
    # demand grows at deadlines only, and nothing behind the longest busy period can be the first to be late
    deadlines_s = {turn * period_s for period_s in classes for turn in range(1, int(busy_s / period_s) + 2)}
    for at_s in deadlines_s:
        demand_s = math.fsum(int(at_s / period_s + _ALMOST) * each.cost_s for period_s, each in classes.items())
        demand_s += math.fsum((int(at_s / each.period_s) + 1) * each.cost_s for each in urgent)
        longest_s = max(
            [each.longest_s for period_s, each in classes.items() if period_s > at_s + _ALMOST], default=0.0
        )
        if demand_s + longest_s > at_s + _ALMOST:
            return False
    return True


def taking_turns_s(units: Sequence[Sequence[PeriodicTask]], urgent: Sequence[PeriodicTask] = ()) -> list[list[float]]:
    """Return a bound like `response_times_s` for a line whose units take turns, exchange by exchange.

    An exchange that is due waits for at most one of each other unit. So a unit is never served more slowly than by a
    line of its own on which each exchange takes as long as one of every unit; there it does what has the earliest
    deadline. Besides, a line that never idles while something is due has done all that is due by the end of a busy
    period, the longest of which begins with everything due at once. The lesser bound counts.

    Args:
        units: the polls of each unit.
        urgent: what goes before all of them whenever it is there.

    Returns:
        Seconds, in the order of `units`; infinity for all of them when the line is full.
    """
    everything = [*(task for tasks in units for task in tasks), *urgent]
    if load_of(everything) > FULL:
        return [[math.inf] * len(tasks) for tasks in units]
    busy_s = _busy_period_s(everything, 0.0)
    round_s = math.fsum(max(task.cost_s / task.exchanges for task in tasks) for tasks in units)
    alone = [[replace(task, cost_s=task.exchanges * round_s) for task in tasks] for tasks in units]
    return [[min(busy_s, bound_s) for bound_s in response_times_s(tasks, urgent=urgent)] for tasks in alone]


@dataclass(frozen=True, slots=True)
class _Class:
    """All tasks of one period: what they cost together, and the longest of them."""

    cost_s: float
    longest_s: float

    @classmethod
    def of(cls, tasks: Sequence[PeriodicTask], period_s: float) -> Self:
        costs_s = [task.cost_s for task in tasks if task.period_s == period_s]
        return cls(math.fsum(costs_s), max(costs_s))


def _classes(tasks: Sequence[PeriodicTask]) -> dict[float, _Class]:
    return {period_s: _Class.of(tasks, period_s) for period_s in {task.period_s for task in tasks}}


def _busy_period_s(tasks: Sequence[PeriodicTask], blocking_s: float) -> float:
    """Return how long the line can be busy without a gap."""
    # fixed point: the work that comes in while the line is busy keeps it busy; it ends as the load is below `FULL`
    longer_s = blocking_s + math.fsum(task.cost_s for task in tasks)
    busy_s = 0.0
    while longer_s > busy_s + _ALMOST:
        busy_s = longer_s
        longer_s = blocking_s + math.fsum(math.ceil(busy_s / task.period_s - _ALMOST) * task.cost_s for task in tasks)
    return busy_s


def _offsets_s(task: PeriodicTask, classes: Mapping[float, _Class], busy_s: float) -> set[float]:
    """Return when, within a busy period, a turn of this task can meet its worst case."""
    offsets = {0.0}
    for period_s in classes:
        at_s = period_s - task.period_s
        while at_s < busy_s:
            if at_s > 0.0:
                offsets.add(at_s)
            at_s += period_s
    return offsets


def _response_s(
    task: PeriodicTask,
    at_s: float,
    classes: Mapping[float, _Class],
    blocking_s: float,
    known_s: float,
    ahead: Sequence[tuple[float, float, int]],
) -> float:
    """Return the response of the turn that is due at this offset, or `known_s` if that is longer."""
    deadline_s = at_s + task.period_s
    less_urgent = [each.longest_s for period_s, each in classes.items() if period_s > deadline_s + _ALMOST]
    before_s = max([blocking_s, *less_urgent]) + math.floor(at_s / task.period_s + _ALMOST) * task.cost_s
    rivals = list(ahead)
    for period_s, each in classes.items():
        # its own earlier turns are in `before_s` already
        cost_s = each.cost_s - task.cost_s if period_s == task.period_s else each.cost_s
        turns = math.floor(deadline_s / period_s + _ALMOST)
        if turns > 0 and cost_s > 0.0:
            rivals.append((period_s, cost_s, turns))
    all_rivals_s = before_s + math.fsum(cost_s * turns for _, cost_s, turns in rivals)
    # even behind all of them it would not be later than what is known: most offsets end here
    if all_rivals_s + task.cost_s - at_s <= known_s:
        return known_s
    start_s, later_s = -1.0, 0.0
    while later_s > start_s + _ALMOST:
        start_s = later_s
        later_s = before_s + math.fsum(
            cost_s * min(int(start_s / period_s + _ALMOST) + 1, turns) for period_s, cost_s, turns in rivals
        )
    return max(known_s, task.cost_s, start_s + task.cost_s - at_s)
