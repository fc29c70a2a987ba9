"""Who is polled next: by deadline while the line keeps up, by priority once it has fallen behind."""

import random
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldcnd.line.exchange import NO_DEADLINE_S, Poller, Priority
from ldcnd.line.schedule import POLLS_PER_LOWER, Choose, PollQueue
from tests.support.toy_family import ToyPoller

HIGH, NORMAL, LOW = Priority
CHOOSERS: dict[str, Choose | None] = {"deadline": None, "phase": lambda polls, _now_s: polls[-1]}
"""By deadline, and where it leaves a choice somebody who always wants the last: the worst that phases can do."""
orders = pytest.mark.parametrize("order", CHOOSERS)


def poller(node: int, priority: Priority, deadline_s: float) -> ToyPoller:
    made = ToyPoller(node, 1.0)
    made.priority, made.deadline_at_s = priority, deadline_s
    return made


def queued(order: str, *pollers: Poller[int]) -> PollQueue:
    """Return a queue in which all of them are due."""
    queue = PollQueue(CHOOSERS[order])
    for each in pollers:
        queue.schedule(each, 0.0)
    return queue


def nodes(queue: PollQueue, now_s: float, turns: int) -> list[int]:
    """Take so many turns."""
    taken = []
    for _ in range(turns):
        assert queue.is_due(now_s)
        taken.append(queue.take(now_s).node)
    return taken


@orders
def test_while_nothing_is_late_the_deadline_decides_whatever_the_priority(order):
    queue = queued(order, poller(1, HIGH, 9.0), poller(2, LOW, 7.0), poller(3, NORMAL, 8.0))

    assert nodes(queue, 6.9, 3) == [2, 3, 1]


@orders
def test_once_one_is_late_a_higher_one_goes_first_that_is_due_and_not_late_yet(order):
    queue = queued(order, poller(1, NORMAL, 5.0), poller(2, NORMAL, 8.0), poller(3, HIGH, 9.0), poller(4, LOW, 4.0))

    assert nodes(queue, 6.0, 4) == [3, 1, 2, 4]


@orders
def test_priority_decides_until_the_line_has_caught_up(order):
    queue = queued(order, poller(1, NORMAL, 5.0), poller(2, NORMAL, 8.0))
    high = poller(3, HIGH, 9.0)
    queue.schedule(high, 7.0)

    assert nodes(queue, 6.0, 1) == [1]  # the late one
    queue.schedule(high, 6.0)
    assert nodes(queue, 6.0, 2) == [3, 2]  # none is late any more, but the line has not caught up
    assert not queue.is_due(6.0)
    for each in (poller(4, HIGH, 9.0), poller(5, LOW, 8.0)):
        queue.schedule(each, 6.0)
    assert nodes(queue, 6.0, 2) == [5, 4]


@orders
def test_polls_without_a_deadline_go_last_and_do_not_keep_a_line_from_catching_up(order):
    trace = poller(9, LOW, NO_DEADLINE_S)
    queue = queued(order, trace, poller(1, LOW, 5.0), poller(2, HIGH, 8.0))

    assert nodes(queue, 6.0, 3) == [2, 1, 9]
    queue.schedule(trace, 6.0)
    assert nodes(queue, 6.0, 1) == [9]
    for each in (trace, poller(3, HIGH, 9.0), poller(4, LOW, 8.0)):
        queue.schedule(each, 6.0)
    assert nodes(queue, 6.0, 3) == [4, 3, 9]


@orders
def test_a_late_poll_of_a_lower_priority_is_passed_so_many_times_and_no_more(order):
    greedy = poller(1, HIGH, 0.0)
    queue = queued(order, greedy, poller(2, NORMAL, 0.5), poller(3, LOW, 0.5))
    taken = []
    for _ in range(3 * (POLLS_PER_LOWER + 1)):
        taken += nodes(queue, 1.0, 1)
        if taken[-1] == 1:
            queue.schedule(greedy, 1.0)

    assert POLLS_PER_LOWER == 16
    assert [turn for turn, node in enumerate(taken) if node != 1] == [16, 33]


@orders
def test_a_lower_poll_that_is_not_late_is_owed_nothing(order):
    greedy = poller(1, HIGH, 0.0)
    queue = queued(order, greedy, poller(2, LOW, NO_DEADLINE_S))

    for _ in range(100):
        assert nodes(queue, 1.0, 1) == [1]
        queue.schedule(greedy, 1.0)


@orders
def test_who_was_unscheduled_is_not_polled_however_late(order):
    kept, gone = poller(1, LOW, 0.0), poller(2, HIGH, 0.0)
    queue = queued(order, kept, gone)
    assert queue.is_due(1.0)

    queue.unschedule(gone)

    assert queue.next_due_s() == 0.0
    assert nodes(queue, 1.0, 1) == [1]
    assert not queue.is_due(1.0)
    assert queue.next_due_s() == float("inf")


@given(
    order=st.sampled_from(sorted(CHOOSERS)),
    priorities=st.lists(st.sampled_from(Priority), min_size=2, max_size=31),
    seed=st.integers(0, 1000),
)
@pytest.mark.long
def test_nobody_starves_and_within_a_priority_nobody_waits_for_two_mean_gaps(order, priorities, seed):
    """Everybody is late again at once, which is the worst that can be asked of a line."""
    dice = random.Random(seed)
    choose: Choose | None = None if order == "deadline" else lambda polls, _now_s: dice.choice(polls)
    queue, now_s = PollQueue(choose), 0.0
    pollers = [poller(node, priority, 0.0) for node, priority in enumerate(priorities)]
    for each in pollers:
        queue.schedule(each, 0.0)
    turns: dict[int, list[int]] = {each.node: [] for each in pollers}
    lower = sum(priority > min(priorities) for priority in priorities)
    for turn in range(8 * (POLLS_PER_LOWER + 1) * len(pollers)):
        now_s += 1.0
        assert queue.is_due(now_s)
        taken = queue.take(now_s)
        turns[taken.node].append(turn)
        taken.deadline_at_s = now_s + 0.5
        queue.schedule(taken, now_s)

    for each in pollers:
        gaps = [later - earlier for earlier, later in pairwise(turns[each.node])]
        peers = [turns[other.node] for other in pollers if other.priority is each.priority]
        mean = sum(peer[-1] - peer[0] for peer in peers) / sum(len(peer) - 1 for peer in peers)
        assert max(gaps) <= 2 * mean + POLLS_PER_LOWER
        if each.priority > min(priorities):
            assert max(gaps) <= 2 * (POLLS_PER_LOWER + 1) * lower


class Regular(ToyPoller):
    """Turns on a grid; those that have passed are lost."""

    lost = 0

    def turn(self, now_s: float) -> None:
        due_s = self.due_at_s
        self.next_exchange(now_s)
        self.lost += round((self.due_at_s - due_s) / self.period_s) - 1
        self.deadline_at_s = self.due_at_s + self.period_s


def shares(
    order: str, priorities: Sequence[Priority], rates_hz: Sequence[float], load: float, seed: int
) -> list[float]:
    """Ask more of a line than it can carry for half a minute; return which share of their turns pollers had."""
    dice, now_s = random.Random(seed), 0.0
    queue = PollQueue(CHOOSERS[order])
    cost_s = load / sum(rates_hz)
    pollers = [Regular(node, 1.0 / hz) for node, hz in enumerate(rates_hz)]
    for each, priority in zip(pollers, priorities, strict=True):
        each.priority = priority
        each.due_at_s = dice.choice([0.0, dice.uniform(0.0, each.period_s)])
        each.deadline_at_s = each.due_at_s + each.period_s
        queue.schedule(each, each.due_at_s)
    while now_s < 30.0:
        if not queue.is_due(now_s):
            now_s = queue.next_due_s()
            continue
        taken = queue.take(now_s)
        assert isinstance(taken, Regular)
        taken.turn(now_s)
        now_s += cost_s * dice.uniform(0.85, 1.15)
        queue.schedule(taken, taken.due_at_s)
    return [len(each.asked_at_s) / (len(each.asked_at_s) + each.lost) for each in pollers]


@orders
@pytest.mark.parametrize("load", [1.02, 1.1, 1.5, 3.0])
@pytest.mark.parametrize("highs_hz", [50.0, 5.0])
@pytest.mark.sweep(5)
def test_a_line_that_is_asked_too_much_keeps_the_rates_of_high_ones_and_polls_the_others(order, load, highs_hz):
    priorities = [HIGH] * 3 + [NORMAL] * 24 + [LOW] * 4
    rates_hz = [highs_hz] * 3 + [20.0] * 28

    for seed in range(1):
        granted = shares(order, priorities, rates_hz, load, seed)

        assert min(granted[:3]) >= 0.98
        assert min(granted) * 20.0 > 0.2
        assert sum(granted[27:]) / 4 < sum(granted[3:27]) / 24 < 1.0


@orders
def test_who_was_chosen_ahead_goes_next(order):
    first, second = poller(1, NORMAL, 5.0), poller(2, NORMAL, 6.0)
    queue = queued(order, first, second)

    assert queue.choose_ahead(1.001) is first
    assert queue.choose_ahead(1.001) is None  # it is chosen already
    assert queue.next_due_s() == first.due_at_s

    assert nodes(queue, 1.001, 2) == [1, 2]
    assert not queue.is_due(1.001)


@orders
def test_nobody_is_chosen_ahead_who_is_not_due_yet(order):
    queue = PollQueue(CHOOSERS[order])
    queue.schedule(poller(1, NORMAL, 5.0), 1.0015)

    assert queue.choose_ahead(1.001) is None
    assert nodes(queue, 1.0015, 1) == [1]


@orders
def test_who_will_be_due_by_then_can_be_chosen_ahead(order):
    queue = PollQueue(CHOOSERS[order])
    queue.schedule(poller(1, NORMAL, 5.0), 1.0005)

    assert queue.choose_ahead(1.001)
    assert nodes(queue, 1.0004, 1) == [1]  # the line is free a little sooner than expected


@orders
@pytest.mark.parametrize(("deadline_s", "taken"), [(4.9, [2, 1]), (5.1, [1, 2])])
def test_only_an_earlier_deadline_overtakes_who_was_chosen_ahead(order, deadline_s, taken):
    queue = queued(order, poller(1, NORMAL, 5.0))
    queue.choose_ahead(1.001)
    queue.schedule(poller(2, NORMAL, deadline_s), 1.0015)

    assert nodes(queue, 1.0015, 2) == taken


@orders
def test_who_was_chosen_ahead_can_be_forgotten(order):
    first, second = poller(1, NORMAL, 5.0), poller(2, NORMAL, 6.0)
    queue = queued(order, first, second)
    queue.choose_ahead(1.001)

    queue.unschedule(first)

    assert nodes(queue, 1.001, 1) == [2]
    assert not queue.is_due(1.001)


@orders
def test_another_turn_replaces_the_one_that_was_chosen_ahead(order):
    first, second = poller(1, NORMAL, 5.0), poller(2, NORMAL, 6.0)
    queue = queued(order, first, second)
    queue.choose_ahead(1.001)

    queue.schedule(first, 2.0)

    assert nodes(queue, 1.001, 1) == [2]
    assert not queue.is_due(1.999)
    assert nodes(queue, 2.0, 1) == [1]


@given(seed=st.integers(0, 2**32))
def test_to_choose_ahead_changes_nothing_for_the_earliest_deadline(seed):
    """In any mixture of periods, choosing ahead or not, the earliest deadline that is due goes first."""
    dice = random.Random(seed)
    periods = [dice.uniform(0.005, 0.05) for _ in range(6)]
    orders_taken = []
    for ahead in (False, True):
        queue = PollQueue(None)
        pollers = [poller(node, NORMAL, period_s) for node, period_s in enumerate(periods)]
        for each in pollers:
            queue.schedule(each, 0.0)
        taken, now_s = [], 0.0
        for _ in range(200):
            if queue.is_due(now_s):
                each = queue.take(now_s)
                taken.append(each.node)
                each.due_at_s += periods[each.node]
                each.deadline_at_s = each.due_at_s + periods[each.node]
                queue.schedule(each, each.due_at_s)
            if ahead:
                queue.choose_ahead(now_s + 0.001)
            now_s += 0.001
        orders_taken.append(taken)
    assert orders_taken[0] == orders_taken[1]


@pytest.mark.parametrize("gone", range(1, 8))
def test_the_deadlines_stay_in_order_when_one_poll_is_forgotten(gone):
    pollers = {node: poller(node, NORMAL, 10.0 - node) for node in range(1, 8)}
    queue = queued("deadline", *pollers.values())
    assert queue.is_due(0.0)

    queue.unschedule(pollers[gone])

    assert nodes(queue, 0.0, 6) == [node for node in range(7, 0, -1) if node != gone]
