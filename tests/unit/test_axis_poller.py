"""Which items travel with which poll."""

from collections import Counter
from types import SimpleNamespace

import pytest

from ldcnd.axis.polling import AGAIN_S, AxisPoller
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.axis_config import RatesConfig
from ldcnd.line.exchange import Timing

POSITION, VELOCITY, ADC, STATE = (
    TelemetryItem.POSITION,
    TelemetryItem.VELOCITY,
    TelemetryItem.ADC,
    TelemetryItem.STATE,
)


def poller(rates_hz: dict[TelemetryItem, float], start_at_s: float = 0.0) -> AxisPoller:
    """A poller whose exchanges are the items that they ask for."""
    driver = SimpleNamespace(spec=SimpleNamespace(address=1), reading=lambda items: items)
    return AxisPoller(driver, rates_hz, start_at_s, lambda *_: False, lambda _: None, lambda _: None)


def polls(axis: AxisPoller, until_s: float, late_s: float = 0.0) -> list[tuple[float, frozenset[TelemetryItem]]]:
    """Give the poller its turns, each so much later than it was due."""
    taken = []
    while axis.due_at_s < until_s:
        now_s = axis.due_at_s + late_s
        taken.append((now_s, axis.next_exchange(now_s)))
    return taken


def test_an_axis_is_polled_as_often_as_its_fastest_item():
    taken = polls(poller({POSITION: 20.0, STATE: 5.0, ADC: 7.0}), 10.0)

    assert len(taken) == pytest.approx(200, abs=1)
    assert all(POSITION in items for _, items in taken)


@pytest.mark.parametrize("rate_hz", [1.0, 3.3, 5.0, 7.0, 13.0, 19.9])
def test_slower_items_keep_their_rate_and_stay_within_half_a_poll_of_their_grid(rate_hz):
    taken = polls(poller({POSITION: 20.0, ADC: rate_hz}), 100.0)

    at_s = [now_s for now_s, items in taken if ADC in items]

    assert len(at_s) == pytest.approx(100 * rate_hz, abs=2)
    assert all(abs(now_s - number / rate_hz) <= 0.025 + 1e-6 for number, now_s in enumerate(at_s))


def test_a_late_poll_does_not_shift_the_next_one():
    axis = poller({POSITION: 10.0})

    axis.next_exchange(0.03)

    assert axis.due_at_s == pytest.approx(0.1)
    assert axis.deadline_at_s == pytest.approx(0.2)


def test_missed_turns_are_skipped_and_not_made_up_for():
    axis = poller({POSITION: 10.0, ADC: 5.0})

    axis.next_exchange(0.57)

    assert axis.due_at_s == pytest.approx(0.6)
    asked = Counter(item for _, items in polls(axis, 1.55) for item in items)
    assert asked == {POSITION: 10, ADC: 5}


def test_items_that_are_switched_off_and_converters_that_do_not_exist_are_not_polled():
    rates = RatesConfig(position=10, velocity=0, adc=2, state=5)

    assert rates.wanted_hz(adc=False) == {POSITION: 10, STATE: 5}
    assert rates.wanted_hz(adc=True) == {POSITION: 10, ADC: 2, STATE: 5}


def test_to_prepare_a_poll_changes_nothing_but_when_the_work_is_done():
    plain, prepared = (poller({POSITION: 20.0, ADC: 7.0, STATE: 3.0}) for _ in range(2))

    for number in range(200):
        at_s = number * 0.05
        prepared.prepare(at_s)
        due_at_s = prepared.due_at_s
        assert due_at_s == plain.due_at_s  # it is not asked yet

        assert prepared.next_exchange(at_s) == plain.next_exchange(at_s)
        assert (prepared.due_at_s, prepared.deadline_at_s) == (plain.due_at_s, plain.deadline_at_s)


def test_what_was_prepared_for_a_turn_that_has_passed_is_not_asked():
    axis = poller({POSITION: 10.0, ADC: 1.0})
    axis.next_exchange(0.0)
    axis.prepare(0.1)

    assert axis.next_exchange(1.0) == {POSITION, ADC}
    assert axis.due_at_s == pytest.approx(1.1)


def test_the_poll_of_an_axis_counts_as_much_work():
    assert poller({POSITION: 1.0}).slow_to_deliver


def test_the_deadline_of_a_poll_is_when_the_next_one_is_due():
    axis = poller({POSITION: 10.0}, start_at_s=3.0)
    assert (axis.due_at_s, axis.deadline_at_s) == (3.0, pytest.approx(3.1))

    axis.next_exchange(3.0)
    assert (axis.due_at_s, axis.deadline_at_s) == (pytest.approx(3.1), pytest.approx(3.2))


def test_what_is_not_believed_is_asked_again_at_once_and_the_poll_keeps_its_turn():
    driver = SimpleNamespace(spec=SimpleNamespace(address=1), reading=lambda items: items)
    again, moved = [True, False, False], []
    axis = AxisPoller(
        driver, {POSITION: 10.0, ADC: 5.0}, 0.0, lambda *_: again.pop(0), lambda _: None, lambda _: moved.append(1)
    )
    reply = SimpleNamespace(asked=frozenset({ADC}))
    axis.next_exchange(0.0)

    axis.deliver(reply, Timing(0.0, 0.0, 0.0, 0.004))
    assert (axis.due_at_s, axis.deadline_at_s) == (0.004, pytest.approx(0.004 + AGAIN_S))
    assert axis.next_exchange(0.005) == {ADC}
    assert (axis.due_at_s, axis.deadline_at_s) == (pytest.approx(0.1), pytest.approx(0.2))
    axis.deliver(reply, Timing(0.0, 0.0, 0.0, 0.006))
    assert len(moved) == 1
    assert axis.next_exchange(0.1) == {POSITION}


def test_an_answer_that_comes_before_it_was_asked_again_settles_it():
    driver = SimpleNamespace(spec=SimpleNamespace(address=1), reading=lambda items: items)
    again, moved = [True, False], []
    axis = AxisPoller(driver, {POSITION: 10.0}, 0.0, lambda *_: again.pop(0), lambda _: None, lambda _: moved.append(1))
    reply = SimpleNamespace(asked=frozenset({POSITION}))
    axis.next_exchange(0.0)
    axis.deliver(reply, Timing(0.0, 0.0, 0.0, 0.004))

    axis.deliver(reply, Timing(0.0, 0.0, 0.0, 0.006))

    assert (axis.due_at_s, axis.deadline_at_s, len(moved)) == (pytest.approx(0.1), pytest.approx(0.2), 2)


def test_a_poll_that_brought_nothing_is_reported():
    driver = SimpleNamespace(spec=SimpleNamespace(address=1), reading=lambda items: items)
    missed: list[object] = []
    axis = AxisPoller(driver, {POSITION: 10.0}, 0.0, lambda *_: False, missed.append, lambda _: None)

    axis.missed("lost")

    assert missed == ["lost"]


def test_a_poll_that_was_prepared_too_early_is_made_anew():
    axis = poller({POSITION: 10.0, ADC: 5.0})
    axis.next_exchange(0.0)
    axis.prepare(0.1)
    assert axis.next_exchange(0.1) == {POSITION}
    axis.prepare(0.2)
    assert axis.next_exchange(0.4) == {POSITION, ADC}
    assert axis.due_at_s == pytest.approx(0.5)


def test_a_look_in_between_goes_at_its_instant_and_shifts_no_poll():
    axis = poller({POSITION: 10.0, STATE: 10.0})
    axis.next_exchange(0.0)

    axis.ask_at(0.03)
    assert (axis.due_at_s, axis.deadline_at_s) == (0.03, pytest.approx(0.03 + AGAIN_S))
    assert axis.next_exchange(0.031) == {POSITION}
    assert (axis.due_at_s, axis.deadline_at_s) == (pytest.approx(0.1), pytest.approx(0.2))
    assert axis.next_exchange(0.1) == {POSITION, STATE}


def test_a_look_behind_the_next_poll_waits_for_it_and_is_taken_with_a_later_one():
    axis = poller({POSITION: 10.0, STATE: 10.0})
    axis.next_exchange(0.0)

    axis.ask_at(0.15)
    assert axis.due_at_s == pytest.approx(0.1)
    axis.next_exchange(0.1)
    assert axis.due_at_s == 0.15
    assert axis.next_exchange(0.205) == {POSITION, STATE}  # late: one exchange serves both
    assert axis.due_at_s == pytest.approx(0.3)
