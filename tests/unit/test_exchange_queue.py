from dataclasses import dataclass
from itertools import pairwise

import pytest

from ldcnd.contract.errors import BusBusy
from ldcnd.line.exchange import Lane, Poller
from ldcnd.line.schedule import COMMANDS_PER_POLL, LANE_LIMITS, POLLS_PER_BACKGROUND, Schedule
from tests.support.queue_turns import schedule_by, take
from tests.support.toy_family import ToyPoller


@dataclass(eq=False)
class Ticket:
    name: str
    abandoned: bool = False
    doubted: bool = False


def filled(**lanes: int) -> Schedule[Ticket]:
    """A queue with so many jobs in each lane, named after the lane and their order."""
    queue: Schedule[Ticket] = Schedule()
    for name, count in lanes.items():
        for number in range(count):
            queue.push(Ticket(f"{name}{number}"), Lane[name.upper()])
    return queue


def always_due(queue: Schedule[Ticket], node: int = 1) -> Poller[int]:
    poller = ToyPoller(node, 1.0)
    queue.polls.schedule(poller, 0.0)
    return poller


def order(queue: Schedule[Ticket], turns: int, now_s: float = 0.0) -> list[str]:
    """Take so many turns; a poller is due again at once."""
    names = []
    for _ in range(turns):
        taken = take(queue, now_s)
        if isinstance(taken, Poller):
            names.append(f"poll{taken.node}")
            queue.polls.schedule(taken, now_s)
        else:
            names.append(taken.name if taken else "-")
    return names


def test_stop_overtakes_queued_commands_and_polls():
    queue = filled(command=2, background=1)
    always_due(queue)

    queue.push(Ticket("stop"), Lane.STOP)

    assert queue.stop_waits()
    assert order(queue, 1) == ["stop"]
    assert not queue.stop_waits()


def test_a_lane_is_first_in_first_out():
    queue = filled(command=3)

    assert order(queue, 4) == ["command0", "command1", "command2", "-"]


def test_a_due_poll_waits_for_four_commands_at_most():
    queue = filled(command=10)
    always_due(queue)

    taken = order(queue, 10)

    assert COMMANDS_PER_POLL == 4
    assert [turn for turn, name in enumerate(taken) if name == "poll1"] == [4, 9]


def test_commands_go_before_due_polls():
    queue = filled(command=2)
    always_due(queue)

    assert order(queue, 3) == ["command0", "command1", "poll1"]


def test_a_poll_that_is_not_due_delays_no_command():
    queue = filled(command=10)
    queue.polls.schedule(ToyPoller(1, 1.0), 5.0)

    assert order(queue, 11, now_s=4.9) == [f"command{number}" for number in range(10)] + ["-"]


def test_background_waits_for_eight_polls_at_most():
    queue = filled(background=2)
    always_due(queue)

    taken = order(queue, 18)

    assert POLLS_PER_BACKGROUND == 8
    assert [turn for turn, name in enumerate(taken) if name.startswith("background")] == [8, 17]


def test_background_goes_when_no_poll_is_due():
    queue = filled(background=1)
    queue.polls.schedule(ToyPoller(1, 1.0), 5.0)

    assert order(queue, 2, now_s=1.0) == ["background0", "-"]


def test_commands_go_before_background():
    queue = filled(background=1, command=6)

    assert order(queue, 7)[-1] == "background0"


def test_polls_go_in_the_order_of_their_due_times():
    queue: Schedule[Ticket] = Schedule()
    for node, at_s in ((1, 3.0), (2, 1.0), (3, 2.0)):
        queue.polls.schedule(ToyPoller(node, 1.0), at_s)

    taken = [take(queue, 10.0) for _ in range(3)]

    assert [poller.node for poller in taken if isinstance(poller, Poller)] == [2, 3, 1]


def test_polls_due_at_once_take_turns():
    queue: Schedule[Ticket] = Schedule()
    for node in (1, 2, 3):
        always_due(queue, node)

    assert order(queue, 6) == ["poll1", "poll2", "poll3", "poll1", "poll2", "poll3"]


def test_scheduling_again_replaces_the_turn():
    queue: Schedule[Ticket] = Schedule()
    poller = always_due(queue)

    queue.polls.schedule(poller, 7.0)

    assert queue.polls.next_due_s() == 7.0
    assert take(queue, 6.9) is None
    assert take(queue, 7.0) is poller
    assert take(queue, 8.0) is None


def test_an_unscheduled_poller_is_forgotten():
    queue: Schedule[Ticket] = Schedule()
    poller = always_due(queue)

    queue.polls.unschedule(poller)
    queue.polls.unschedule(poller)

    assert queue.polls.next_due_s() == float("inf")
    assert take(queue, 1.0) is None


def test_abandoned_jobs_are_passed_over():
    queue = filled(command=2, stop=1)
    for lane in (Lane.STOP, Lane.COMMAND):
        queue.waiting(lane)[0].abandoned = True

    assert not queue.stop_waits()
    assert order(queue, 2) == ["command1", "-"]


@pytest.mark.parametrize("lane", LANE_LIMITS)
def test_a_full_lane_refuses_and_says_so(lane: Lane):
    queue = filled(**{lane.name.lower(): LANE_LIMITS[lane]})

    with pytest.raises(BusBusy, match=lane.name.lower()) as refused:
        queue.push(Ticket("one more"), lane)

    assert refused.value.limit == LANE_LIMITS[lane]
    assert len(queue.waiting(lane)) == LANE_LIMITS[lane]


def test_a_lane_full_of_abandoned_jobs_has_room():
    queue = filled(command=LANE_LIMITS[Lane.COMMAND])
    for ticket in queue.waiting(Lane.COMMAND)[1:]:
        ticket.abandoned = True

    queue.push(Ticket("one more"), Lane.COMMAND)

    assert order(queue, 3) == ["command0", "one more", "-"]


def test_a_job_that_is_sent_again_goes_first_and_always_finds_room():
    queue = filled(command=LANE_LIMITS[Lane.COMMAND])

    queue.requeue(Ticket("again"), Lane.COMMAND)

    assert order(queue, 2) == ["again", "command0"]


def test_draining_returns_every_job_and_forgets_the_pollers():
    queue = filled(background=1, command=2, stop=1)
    always_due(queue)

    drained = queue.drain()

    assert [ticket.name for ticket in drained] == ["stop0", "command0", "command1", "background0"]
    assert take(queue, 10.0) is None
    assert queue.polls.next_due_s() == float("inf")


def chosen(now_s: float, deadlines_s: list[float], turns: int) -> list[int]:
    """Let somebody who always wants the highest node choose; return who goes. A poll is due again at once."""
    queue: Schedule[Ticket] = schedule_by(lambda polls, _now_s: max(polls, key=lambda poll: poll.node))
    for node, deadline_s in enumerate(deadlines_s, 1):
        poller = ToyPoller(node, 1.0)
        poller.deadline_at_s = deadline_s
        queue.polls.schedule(poller, 0.0)
    nodes = []
    for _ in range(turns):
        taken = take(queue, now_s)
        assert isinstance(taken, Poller)
        nodes.append(taken.node)
        queue.polls.schedule(taken, now_s)
    return nodes


def test_the_choice_is_among_polls_with_the_earliest_deadline():
    assert chosen(1.0, [2.0, 2.0, 3.0, 9.0], 1) == [2]


def test_there_is_no_choice_while_deadlines_differ():
    assert chosen(1.0, [2.0, 3.0, 4.0], 1) == [1]


def test_among_late_polls_the_choice_is_free_and_nobody_is_passed_over_for_two_rounds():
    nodes = chosen(5.0, [float(number) / 10 for number in range(8)], 800)

    gaps = [
        later - earlier
        for node in range(1, 9)
        for earlier, later in pairwise([turn for turn, other in enumerate(nodes) if other == node])
    ]
    assert nodes.count(8) == max(nodes.count(node) for node in range(1, 9))
    assert min(gaps) >= 4
    assert max(gaps) <= 16


def test_a_poll_that_was_unscheduled_is_not_chosen():
    queue: Schedule[Ticket] = schedule_by(lambda polls, _now_s: polls[-1])
    kept, gone = ToyPoller(1, 1.0), ToyPoller(2, 1.0)
    for poller in (kept, gone):
        queue.polls.schedule(poller, 0.0)
    queue.polls.unschedule(gone)

    assert [take(queue, 1.0), take(queue, 1.0)] == [kept, None]


def test_a_probe_of_the_stop_lane_goes_before_everything_but_stops():
    queue = filled(command=1)
    always_due(queue)
    queue.push_probe(Ticket("probe"))
    queue.push(Ticket("stop"), Lane.STOP)

    assert not queue.takes_probe()
    assert order(queue, 3) == ["stop", "probe", "command0"]
    assert queue.takes_probe()


def test_a_probe_is_no_stop_and_is_drained_like_any_job():
    queue = filled(command=1)
    queue.push_probe(Ticket("probe"))

    assert not queue.stop_waits()
    assert [job.name for job in queue.drain()] == ["probe", "command0"]
    assert queue.takes_probe()


def test_a_probe_is_taken_only_where_it_is_alone():
    queue: Schedule[Ticket] = Schedule()
    stop = Ticket("stop")
    queue.push(stop, Lane.STOP)
    assert not queue.takes_probe()
    stop.abandoned = True
    assert queue.takes_probe()

    queue.push_probe(Ticket("probe"))
    assert not queue.takes_probe()


def test_a_probe_that_nobody_waits_for_any_more_is_passed_over():
    queue = filled(command=1)
    queue.push_probe(Ticket("probe", abandoned=True))

    assert order(queue, 1) == ["command0"]
    assert queue.takes_probe()
