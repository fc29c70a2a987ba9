"""Response times and plans, against arithmetic by hand and against the real queue run at random."""

import math
import random

import pytest

from ldcnd.drives.cost import Cost
from ldcnd.drives.line_plan import Poll, Urgent, largest, plan_line
from ldcnd.drives.response_times import PeriodicTask, load_of, meets_deadlines, response_times_s, taking_turns_s
from ldcnd.line.exchange import Poller, Priority
from ldcnd.line.schedule import Choose, Schedule
from tests.support.queue_turns import schedule_by, take

MS = 0.001
URGENT = Urgent(command_s=2 * MS, stop_s=1 * MS, recovery_s=3 * MS, margin_s=5 * MS)


class Turns(Poller[None]):
    """A task as the queue sees it."""

    def __init__(self, task: PeriodicTask, start_s: float) -> None:
        self.node = 1
        self.task = task
        self.due_at_s = start_s
        self.deadline_at_s = start_s + task.period_s

    def next_exchange(self, now_s):
        self.due_at_s += self.task.period_s
        self.deadline_at_s = self.due_at_s + self.task.period_s

    def deliver(self, reply, timing):
        raise NotImplementedError

    missed = deliver


def observed_s(
    tasks: list[PeriodicTask],
    starts_s: list[float],
    until_s: float,
    choose: Choose | None = None,
    dice: random.Random | None = None,
) -> list[float]:
    """Let the real queue order the tasks; return the longest time of each from being due to being over.

    Args:
        tasks: what is asked of the line.
        starts_s: first turns.
        until_s: when to end.
        choose: among equals.
        dice: draw the priorities; all have the same one if missing.
    """
    queue: Schedule = schedule_by(choose)
    turns = [Turns(task, start) for task, start in zip(tasks, starts_s, strict=True)]
    for each in turns:
        each.priority = dice.choice(list(Priority)) if dice else Priority.NORMAL
    longest = dict.fromkeys(turns, 0.0)
    for each in turns:
        queue.polls.schedule(each, each.due_at_s)
    now_s = 0.0
    while now_s < until_s:
        taken = take(queue, now_s)
        if taken is None:
            now_s = queue.polls.next_due_s()
            continue
        due_s = taken.due_at_s
        taken.next_exchange(now_s)
        now_s += taken.task.cost_s
        longest[taken] = max(longest[taken], now_s - due_s)
        queue.polls.schedule(taken, taken.due_at_s)
    return [longest[each] for each in turns]


def test_equal_rates_wait_for_one_round():
    tasks = [PeriodicTask(0.1, 3 * MS)] * 4

    assert response_times_s(tasks) == [pytest.approx(12 * MS)] * 4


def test_a_fast_poll_waits_for_the_slow_one_that_has_just_begun_and_for_no_other():
    fast, slow = PeriodicTask(0.02, 2 * MS), PeriodicTask(1.0, 5 * MS)

    fast_s, *_ = response_times_s([fast, slow, slow, slow])

    assert fast_s == pytest.approx(7 * MS)


def test_a_full_line_promises_nothing():
    assert response_times_s([PeriodicTask(0.01, 6 * MS)] * 2) == [math.inf] * 2


def test_blocking_delays_everybody():
    tasks = [PeriodicTask(0.1, 3 * MS)] * 2

    assert response_times_s(tasks, blocking_s=4 * MS) == [pytest.approx(10 * MS)] * 2


def test_commands_take_the_room_of_polls():
    polls = [PeriodicTask(0.01, 3 * MS), PeriodicTask(0.1, 4 * MS)]

    assert meets_deadlines(polls, PeriodicTask(0.01, 1 * MS))
    assert not meets_deadlines(polls, PeriodicTask(0.01, 4 * MS))
    assert not meets_deadlines(polls, PeriodicTask(0.002, 1.5 * MS))


@pytest.mark.parametrize("seed", range(20))
def test_demand_and_response_times_agree_on_what_fits(seed):
    dice = random.Random(seed)
    tasks = [
        PeriodicTask(dice.choice([0.01, 0.02, 0.03, 0.05, 0.14]), dice.uniform(0.8, 3.0) * MS)
        for _ in range(dice.randint(2, 9))
    ]

    late = any(response_s > task.period_s for response_s, task in zip(response_times_s(tasks), tasks, strict=True))

    assert meets_deadlines(tasks) is not late


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.sweep(2)
def test_no_poll_is_ever_later_than_its_bound(seed):
    dice = random.Random(seed)
    tasks = []
    while load_of(tasks) < 0.85:
        tasks.append(PeriodicTask(dice.choice([0.02, 0.03, 0.05, 0.1, 0.14, 0.5]), dice.uniform(0.8, 4.0) * MS))
    bounds_s = response_times_s(tasks)

    for _ in range(10):
        starts_s = [dice.choice([0.0, dice.uniform(0.0, task.period_s)]) for task in tasks]
        for seen_s, bound_s in zip(observed_s(tasks, starts_s, 4.0), bounds_s, strict=True):
            assert seen_s <= bound_s + 1e-9


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.sweep(2)
def test_no_poll_is_later_than_its_bound_whoever_chooses_among_equals(seed):
    dice = random.Random(seed)
    tasks = []
    while load_of(tasks) < 0.9:
        tasks.append(PeriodicTask(dice.choice([0.03, 0.06, 0.12]), dice.uniform(0.8, 4.0) * MS))
    bounds_s = response_times_s(tasks)
    chosen = []

    def choose(polls, _now_s):
        chosen.append(len(polls))
        return dice.choice(polls)

    for _ in range(5):
        starts_s = [dice.choice([0.0, 0.0, 0.01]) for _ in tasks]
        for seen_s, bound_s in zip(observed_s(tasks, starts_s, 4.0, choose), bounds_s, strict=True):
            assert seen_s <= bound_s + 1e-9
    assert max(chosen) > 3


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.sweep(2)
def test_where_a_plan_holds_no_poll_is_later_than_its_bound_whatever_the_priorities(seed):
    dice = random.Random(seed)
    tasks = []
    while not tasks or meets_deadlines(tasks):
        held, tasks = tasks, [*tasks, PeriodicTask(dice.choice([0.02, 0.03, 0.06, 0.12]), dice.uniform(0.8, 4.0) * MS)]
    bounds_s = response_times_s(held)

    for choose in (None, lambda polls, _now_s: dice.choice(polls)):
        for _ in range(5):
            starts_s = [dice.choice([0.0, dice.uniform(0.0, task.period_s)]) for task in held]
            for seen_s, bound_s in zip(observed_s(held, starts_s, 4.0, choose, dice), bounds_s, strict=True):
                assert seen_s <= bound_s + 1e-9


def test_the_bound_is_reached():
    tasks = [PeriodicTask(0.02, 2 * MS), PeriodicTask(0.05, 4 * MS), PeriodicTask(1.0, 6 * MS)]
    bounds_s = response_times_s(tasks)

    just_after = [1e-7, 1e-7, 0.0]

    assert observed_s(tasks, just_after, 3.0)[0] == pytest.approx(bounds_s[0], abs=1e-6)


def test_a_unit_waits_for_one_exchange_of_each_other_unit():
    seldom, often = PeriodicTask(0.1, 2 * MS), PeriodicTask(1.0, 200 * MS, exchanges=100)

    (seldom_s,), (often_s,) = taking_turns_s([[seldom], [often]])

    assert seldom_s == pytest.approx(4 * MS)
    assert often_s == pytest.approx(206 * MS)  # at worst, not twice as long, because the other one has so little to do


def test_where_turns_would_promise_nothing_the_longest_busy_time_does():
    heavy, light = PeriodicTask(0.1, 50 * MS), PeriodicTask(10.0, 4 * MS)

    (heavy_s,), *lights_s = taking_turns_s([[heavy], *[[light]] * 9])

    assert heavy_s == pytest.approx(86 * MS)
    assert lights_s == [[pytest.approx(86 * MS)]] * 9


def test_what_is_urgent_delays_whoever_takes_turns():
    ((bound_s,),) = taking_turns_s([[PeriodicTask(0.1, 5 * MS)]], [PeriodicTask(0.1, 7 * MS)])

    assert bound_s == pytest.approx(12 * MS)


def test_the_earliest_deadline_goes_first_among_the_polls_that_are_due():
    queue: Schedule = Schedule()
    slow, fast = Turns(PeriodicTask(1.0, MS), 0.0), Turns(PeriodicTask(0.1, MS), 0.01)
    for each in (slow, fast):
        queue.polls.schedule(each, each.due_at_s)

    assert [take(queue, 0.02), take(queue, 0.02), take(queue, 0.02)] == [fast, slow, None]


def test_a_plan_counts_the_room_that_is_left_for_commands():
    plan = plan_line([poll("x", 50.0, 4 * MS), poll("y", 50.0, 4 * MS)], URGENT)

    assert plan.holds
    assert plan.figures.load == pytest.approx(0.4)
    assert plan.figures.mean_load == pytest.approx(0.2)
    interval_s = 1 / plan.figures.commands_per_s
    tasks = [each.task for each in plan.polls]
    assert meets_deadlines(tasks, PeriodicTask(interval_s * 1.0001, URGENT.command_s))
    assert plan.figures.commands_per_s <= (0.98 - plan.figures.load) / URGENT.command_s


def test_a_stop_waits_for_the_longest_exchange_and_no_more():
    plan = plan_line([poll("x", 10.0, 7 * MS), poll("y", 10.0, 4 * MS)], URGENT)

    assert plan.figures.stop_wait_s == pytest.approx(7 * MS)
    assert plan.figures.stop_s == pytest.approx(8 * MS)
    assert plan.figures.stop_after_loss_s == pytest.approx(16 * MS)


def test_a_plan_names_the_polls_that_can_come_too_late():
    plan = plan_line([poll("fast", 100.0, 3 * MS), poll("slow", 1.0, 9 * MS)], URGENT)

    assert not plan.holds
    assert [late.axis for late in plan.late] == ["fast"]


def test_a_full_line_has_no_room_for_commands():
    assert plan_line([poll("x", 500.0, 2 * MS)], URGENT).figures.commands_per_s == 0.0


@pytest.mark.parametrize(("limit", "expected"), [(3.7, 3.7), (20.0, 10.0), (0.5, None)])
def test_the_largest_value_that_fits_is_found(limit, expected):
    found = largest(lambda value: value <= limit, 1.0, 10.0)

    assert found is expected if expected is None else found == pytest.approx(expected, abs=1e-3)


def poll(axis: str, rate_hz: float, longest_s: float) -> Poll:
    return Poll(axis, ("position",), rate_hz, Cost(longest_s, 0.0, 0.0, 0.0), longest_s / 2)


def test_deadlines_break_ties_by_due_time():
    queue: Schedule = Schedule()
    late, early = Turns(PeriodicTask(1.0, MS), 0.0), Turns(PeriodicTask(1.0, MS), 0.0)
    late.deadline_at_s = early.deadline_at_s = 5.0
    queue.polls.schedule(late, 0.2)
    queue.polls.schedule(early, 0.1)

    assert [take(queue, 1.0), take(queue, 1.0)] == [early, late]
