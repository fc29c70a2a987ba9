"""Asking next whose servo cycle is about to end: the estimate, the choice, and what it brings on the simulated line."""

import random

import pytest

from ldcnd.line.exchange import Timing
from ldcnd.line.schedule import MOST_GUARD, PhaseOrder, PhaseTracker
from ldcnd.line.settings import ServoCycle
from tests.support.polled_chain import saturated
from tests.support.toy_family import ToyPoller

CYCLE_S = 0.000_512
REQUEST_S = 0.0004
REPLY_S = 0.001


def tick_after(from_s: float, phase_s: float, drift_ppm: float) -> float:
    """Return when the first servo cycle ends after an instant."""
    period_s = CYCLE_S * (1 + drift_ppm * 1e-6)
    return from_s + (phase_s - from_s) % period_s


def followed(drift_ppm: float, jitter_s: float, seed: int, polls: int = 200) -> tuple[PhaseTracker, float]:
    """Let a tracker follow a drive that is polled every 40 ms or so; return it and the last instant."""
    dice = random.Random(seed)
    tracker, at_s = PhaseTracker(CYCLE_S), 1000.0
    for _ in range(polls):
        at_s += dice.uniform(0.03, 0.05)
        tracker.observe(tick_after(at_s, 0.0001, drift_ppm) + dice.uniform(0.0, jitter_s))
    return tracker, at_s


@pytest.mark.parametrize("drift_ppm", [-100.0, -3.0, 0.0, 50.0, 100.0])
def test_phase_and_drift_show_in_the_replies(drift_ppm):
    tracker, at_s = followed(drift_ppm, 0.0, seed=1)

    assert tracker.locked
    assert tracker.period_s == pytest.approx(CYCLE_S * (1 + drift_ppm * 1e-6), abs=1e-12)
    for later_s in (0.0003, 0.1, 0.5):
        expected_s = tick_after(at_s + later_s, 0.0001, drift_ppm) - at_s - later_s
        assert tracker.wait_s(at_s + later_s) == pytest.approx(expected_s, abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_a_late_host_blurs_the_estimate_by_less_than_its_own_scatter(seed):
    tracker, at_s = followed(30.0, 0.0001, seed)

    error_s = tracker.wait_s(at_s) - (tick_after(at_s, 0.0001, 30.0) - at_s) - 0.00005
    error_s = (error_s + CYCLE_S / 2) % CYCLE_S - CYCLE_S / 2
    assert tracker.locked
    assert abs(error_s) < 0.00005


def test_replies_that_come_at_random_are_not_believed():
    tracker, _ = followed(0.0, CYCLE_S, seed=1)

    assert not tracker.locked


def test_a_pause_makes_the_phase_uncertain_and_four_replies_certain_again():
    tracker, at_s = followed(50.0, 0.0, seed=1)

    for number in range(4):
        assert tracker.locked is (number == 0)
        tracker.observe(tick_after(at_s + 5.0 + number * 0.04, 0.0001, 50.0))
    assert tracker.locked
    assert tracker.period_s == pytest.approx(CYCLE_S * 1.00005, abs=1e-10)


def known(order: PhaseOrder, phases_s: dict[int, float], until: int = 20) -> float:
    """Let an order learn the phases of nodes; return the present."""
    at_s = 0.0
    for _ in range(until):
        for node, phase_s in phases_s.items():
            at_s = asked(order, node, phase_s, at_s)
    return at_s


def asked(order: PhaseOrder, node: int, phase_s: float, at_s: float, late_s: float = 0.0) -> float:
    """Ask a node; return when its reply has come."""
    sent_s = at_s + REQUEST_S
    tick_s = tick_after(sent_s + late_s, phase_s, 0.0) + late_s
    order.observe(node, Timing(at_s, sent_s, tick_s, tick_s + REPLY_S))
    return tick_s + REPLY_S


def test_who_answers_first_is_asked_first():
    order = PhaseOrder(ServoCycle(CYCLE_S))
    phases_s = {1: 0.0, 2: 0.0002, 3: 0.0004}
    now_s = known(order, phases_s)
    pollers = [ToyPoller(node, 0.1) for node in phases_s]

    for offset_s in (0.0, 0.0001, 0.0003, 0.0005):
        ends_s = {node: tick_after(now_s + offset_s + REQUEST_S, phase, 0.0) for node, phase in phases_s.items()}
        assert order.choose(pollers, now_s + offset_s).node == min(ends_s, key=ends_s.__getitem__)


def test_nodes_that_nobody_knows_yet_go_in_the_order_given():
    order = PhaseOrder(ServoCycle(CYCLE_S))

    assert order.choose([ToyPoller(7, 0.1), ToyPoller(3, 0.1)], 5.0).node == 7


def test_a_host_that_keeps_missing_cycles_keeps_time_in_hand():
    order = PhaseOrder(ServoCycle(CYCLE_S))
    phases_s = {1: 0.0, 2: 0.0002, 3: 0.0004}
    at_s = known(order, phases_s)
    pollers = [ToyPoller(node, 0.1) for node in phases_s]

    for _ in range(200):
        node = order.choose(pollers, at_s).node
        at_s = asked(order, node, phases_s[node], at_s, late_s=0.00008)

    assert 0.00005 < order.guard_s < MOST_GUARD * CYCLE_S


@pytest.mark.long
async def test_a_saturated_line_of_31_drives_carries_an_eighth_more_and_nobody_waits_two_rounds():
    by_deadline = await saturated(31, 1.5, by_phase=False)
    by_phase = await saturated(31, 1.5, by_phase=True)

    assert by_phase.per_s / by_deadline.per_s >= 1.12
    assert by_phase.longest_gap <= 2.0
    assert by_phase.wait_s < by_deadline.wait_s / 2


@pytest.mark.long
async def test_it_still_pays_on_a_host_that_is_late():
    late_s = (0.000_05, 0.000_3)

    by_deadline = await saturated(31, 1.5, by_phase=False, late_s=late_s)
    by_phase = await saturated(31, 1.5, by_phase=True, late_s=late_s)

    assert by_phase.per_s / by_deadline.per_s >= 1.04
    assert by_phase.longest_gap <= 2.0


@pytest.mark.long
async def test_it_does_no_harm_where_nothing_can_be_predicted():
    late_s = (0.000_1, 0.001)

    by_deadline = await saturated(16, 1.0, by_phase=False, late_s=late_s)
    by_phase = await saturated(16, 1.0, by_phase=True, late_s=late_s)

    assert by_phase.per_s / by_deadline.per_s >= 0.98


def test_the_line_is_free_after_the_cycle_and_a_reply_at_the_drives_rate():
    order, phase_s, stretch = PhaseOrder(ServoCycle(CYCLE_S, 1.014)), 0.0001, 1.014
    asked_at_s = 1000.0
    assert order.free_at_s(7, asked_at_s, REPLY_S) == pytest.approx(asked_at_s + CYCLE_S / 2 + stretch * REPLY_S)

    for _ in range(50):
        asked_at_s += 0.0403
        began_s = tick_after(asked_at_s, phase_s, 0.0)
        order.observe(
            7, Timing(asked_at_s - REQUEST_S, asked_at_s, began_s + 0.014 * REPLY_S, began_s + stretch * REPLY_S)
        )
    asked_at_s += 0.0403

    expected_s = tick_after(asked_at_s, phase_s, 0.0) + stretch * REPLY_S
    assert order.free_at_s(7, asked_at_s, REPLY_S) == pytest.approx(expected_s, abs=20e-6)


def test_two_replies_at_one_instant_are_one_cycle():
    tracker, at_s = followed(0.0, 0.0, seed=1)
    before = (tracker.period_s, tracker.wait_s(at_s), tracker.locked)
    last_s = tracker._tick_s

    tracker.observe(last_s)
    tracker.observe(last_s - 0.2 * CYCLE_S)

    assert (tracker.period_s, tracker.wait_s(at_s), tracker.locked) == before
