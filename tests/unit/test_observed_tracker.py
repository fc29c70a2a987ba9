import pytest

from ldcnd.axis.events import DriveLost
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.drives.driver import AxisReading, Fault, PartialReading
from ldcnd.line.exchange import Timing
from tests.support.axis_bench import tracked

ALARM = Fault("alarm_0010", "Overcurrent")


def reading(
    *,
    enabled: bool = True,
    velocity: float = 0.0,
    faults: tuple[Fault, ...] = (),
    position: int = 0,
    pieces: PartialReading | None = None,
) -> AxisReading:
    return AxisReading(
        position_counts=position,
        following_error_counts=None,
        velocity_counts_per_s=velocity,
        velocity_resolution_counts_per_s=60.0,
        adc_counts=None,
        enabled=enabled,
        profile_done=velocity == 0.0,
        homing=False,
        faults=faults,
        pieces=pieces,
    )


def observed(*readings: AxisReading) -> AxisTracker:
    tracker = tracked("feed", "rev", commanded=False)
    for at_s, each in enumerate(readings):
        tracker.observe(each, Timing(at_s, at_s, at_s, at_s), at_s)
    return tracker


def test_states_follow_what_the_drive_shows():
    assert observed(reading(enabled=False)).status.state is AxisState.DISABLED
    assert observed(reading(), reading()).status.state is AxisState.STANDSTILL
    assert observed(reading(velocity=800.0)).status.state is AxisState.DISCRETE_MOTION
    assert observed(reading(faults=(ALARM,))).status.state is AxisState.ERROR_STOP


def test_run_switched_off_by_others_is_no_fault():
    tracker = observed(reading(velocity=800.0), reading(enabled=False))

    assert (tracker.status.state, tracker.status.active_faults) == (AxisState.DISABLED, ())


def test_a_coasting_motor_moves_though_it_is_disabled():
    assert observed(reading(enabled=False, velocity=800.0)).status.moving is Moving.YES


def test_an_alarm_that_is_gone_leaves_nothing_to_reset():
    tracker = observed(reading(faults=(ALARM,)), reading())

    assert (tracker.status.state, tracker.status.first_fault) == (AxisState.STANDSTILL, None)


def test_a_drive_that_answers_again_needs_no_reset():
    tracker = observed(reading(), reading())
    tracker.take(DriveLost(5, another=False))

    assert (tracker.status.link, tracker.status.state) == (LinkState.DOWN, AxisState.ERROR_STOP)

    for at_s in (9, 10):
        tracker.observe(reading(), Timing(at_s, at_s, at_s, at_s), at_s)

    assert (tracker.status.link, tracker.status.state, tracker.status.active_faults) == (
        LinkState.UP,
        AxisState.STANDSTILL,
        (),
    )


NEW, OLD = PartialReading(0.5, position=True), PartialReading(0.5, position=False)


@pytest.mark.parametrize("enabled", [True, False])
def test_a_shaft_that_creeps_below_what_its_drive_shows_of_its_speed_moves(enabled):
    places = (reading(enabled=enabled, position=50 * number, pieces=NEW) for number in range(6))

    assert observed(*places).status.moving is Moving.YES


def test_one_position_that_several_readings_carry_does_not_prove_that_a_shaft_stands():
    tracker = observed(reading(pieces=NEW), *[reading(pieces=OLD)] * 5)

    assert (tracker.status.moving, tracker.status.at_rest) == (Moving.UNKNOWN, False)


def test_a_shaft_that_has_turned_stands_once_two_positions_behind_that_say_so():
    before = (reading(pieces=NEW), reading(velocity=800.0, pieces=OLD), reading(pieces=OLD))

    assert observed(*before, reading(pieces=NEW)).status.moving is Moving.YES
    assert observed(*before, reading(pieces=NEW), reading(pieces=NEW)).status.moving is Moving.NO


def test_a_counter_that_was_cleared_is_no_motion():
    there = [reading(position=70_196, pieces=NEW)] * 2
    cleared = reading(pieces=PartialReading(0.5, position=True, recounted=True))

    assert observed(*there, cleared).status.moving is Moving.NO
    assert observed(*there, reading(pieces=NEW)).status.moving is Moving.YES


def test_state_and_rest_are_proven_as_of_the_oldest_word_that_tells_them():
    tracker = observed(reading(pieces=NEW), reading(pieces=PartialReading(1.0, position=False)), reading())

    assert (tracker.read_at_s, tracker.proven_at_s) == (2, 2)

    tracker.observe(reading(pieces=PartialReading(1.25, position=False)), Timing(3, 3, 3, 3), 3)

    assert (tracker.read_at_s, tracker.proven_at_s) == (3, 1.75)
