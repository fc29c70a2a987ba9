from ldcnd.axis.events import DriveLost
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.drives.driver import AxisReading, Fault
from ldcnd.line.exchange import Timing
from tests.support.axis_bench import tracked

ALARM = Fault("alarm_0010", "Overcurrent")


def reading(*, enabled: bool = True, velocity: float = 0.0, faults: tuple[Fault, ...] = ()) -> AxisReading:
    return AxisReading(
        position_counts=0,
        following_error_counts=None,
        velocity_counts_per_s=velocity,
        velocity_resolution_counts_per_s=60.0,
        adc_counts=None,
        enabled=enabled,
        profile_done=velocity == 0.0,
        homing=False,
        faults=faults,
    )


def observed(*readings: AxisReading) -> AxisTracker:
    tracker = tracked("feed", "rev", commanded=False)
    for at_s, each in enumerate(readings):
        tracker.observe(each, Timing(at_s, at_s, at_s, at_s), at_s)
    return tracker


def test_states_follow_what_the_drive_shows():
    assert observed(reading(enabled=False)).status.state is AxisState.DISABLED
    assert observed(reading()).status.state is AxisState.STANDSTILL
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
    tracker = observed(reading())
    tracker.take(DriveLost(5, another=False))

    assert (tracker.status.link, tracker.status.state) == (LinkState.DOWN, AxisState.ERROR_STOP)

    tracker.observe(reading(), Timing(9, 9, 9, 9), 9)

    assert (tracker.status.link, tracker.status.state, tracker.status.active_faults) == (
        LinkState.UP,
        AxisState.STANDSTILL,
        (),
    )
