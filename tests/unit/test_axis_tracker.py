from dataclasses import replace

import pytest

from ldcnd.axis.events import (
    CommandBegun,
    CommandOver,
    DriveLost,
    FaultFound,
    LoopSwitched,
    MotionStarted,
    PlaceKnown,
    PollMissed,
    PowerSwitched,
    ResetDone,
    StopConfirmed,
    StopLatch,
    StopUnconfirmed,
)
from ldcnd.axis.faults import JUMPED
from ldcnd.axis.status import ActiveCommand, AxisStatus, Completion
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.commands import Verb
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState, LinkState, Moving, Quality
from ldcnd.drives.driver import AxisReading, Fault
from ldcnd.line.exchange import Timing
from ldcnd.line.proof import MISSES_UNTIL_LOST
from tests.support.axis_bench import tracked

OFF = AxisReading(
    position_counts=0,
    following_error_counts=None,
    velocity_counts_per_s=0.0,
    velocity_resolution_counts_per_s=1953.0,
    adc_counts=None,
    enabled=False,
    profile_done=True,
    homing=False,
    faults=(),
)
ON = replace(OFF, enabled=True)
RUNNING = replace(ON, profile_done=False, velocity_counts_per_s=20_000.0)
OVERHEAT = Fault("overheat", "let it cool down")


def at(sent_at_s: float) -> Timing:
    return Timing(sent_at_s, sent_at_s, sent_at_s, sent_at_s)


def command(verb=Verb.MOVE_ABSOLUTE, state=AxisState.DISCRETE_MOTION, completion=Completion.PROFILE) -> ActiveCommand:
    return ActiveCommand(f"c-{verb}", verb, 0, state, completion)


def started(tracker: AxisTracker, now_s: float) -> None:
    tracker.take(MotionStarted(tracker.status.command.command_id, now_s, endless=False))


@pytest.fixture
def moving() -> AxisTracker:
    tracker = tracked()
    tracker.observe(ON, at(1.0), 0)
    tracker.take(CommandBegun(command()))
    started(tracker, 2.0)
    return tracker


def test_before_the_first_reading_nothing_is_known():
    tracker = tracked()

    assert (tracker.status.link, tracker.status.moving, tracker.status.quality) == (
        LinkState.DOWN,
        Moving.UNKNOWN,
        Quality.BAD,
    )


def test_an_open_loop_is_disabled_and_a_closed_one_stands():
    tracker = tracked()

    tracker.observe(OFF, at(1.0), 0)
    assert (tracker.status.state, tracker.status.moving) == (AxisState.DISABLED, Moving.UNKNOWN)
    tracker.observe(OFF, at(1.3), 0)
    assert (tracker.status.state, tracker.status.moving) == (AxisState.DISABLED, Moving.NO)

    tracker.take(PowerSwitched(on=True, now_s=2.0))
    tracker.observe(ON, at(3.0), 0)
    assert (tracker.status.state, tracker.status.moving) == (AxisState.STANDSTILL, Moving.NO)


def creeping(counts_per_s, seconds, reading=ON, every_s=0.05) -> list[tuple[AxisState, Moving]]:
    """Return what is known after each reading of a shaft that nobody is known to move."""
    tracker = tracked()
    seen = []
    for step in range(round(seconds / every_s)):
        position = round(counts_per_s * step * every_s)
        tracker.observe(replace(reading, position_counts=position), at(1.0 + step * every_s), 0)
        seen.append((tracker.status.state, tracker.status.moving))
    return seen


@pytest.mark.parametrize("counts_per_s", [39.0, 584.0, 1757.0, -584.0])
@pytest.mark.parametrize("reading", [ON, OFF])
def test_a_shaft_that_creeps_below_a_count_per_tick_never_stands(counts_per_s, reading):
    seen = creeping(counts_per_s, 5.0, reading)

    assert seen[0][1] is Moving.UNKNOWN
    assert Moving.NO not in {moving for _, moving in seen}
    assert seen[-1][1] is Moving.YES


def test_a_shaft_that_creeps_out_of_the_band_is_believed_to_stand_only_after_it_stayed_longer():
    moving = [moving for _, moving in creeping(5.0, 20.0)]
    left = moving.index(Moving.YES)

    assert Moving.NO in moving[:left]  # in the first second 5 counts look like a loop that hunts
    assert Moving.NO not in moving[left:]


def test_a_closed_loop_that_hunts_by_some_counts_stands():
    tracker = tracked()
    for step in range(100):
        tracker.observe(replace(ON, position_counts=step % 6), at(1.0 + 0.05 * step), 0)

    assert (tracker.status.state, tracker.status.moving) == (AxisState.STANDSTILL, Moving.NO)


def test_after_a_gap_rest_must_be_proven_again(moving):
    moving.observe(ON, at(2.2), 0)
    assert moving.status.moving is Moving.NO

    moving.take(DriveLost(0, another=False))
    moving.observe(ON, at(9.0), 0)

    assert moving.status.moving is Moving.UNKNOWN


def test_a_shaft_turned_by_hand_moves():
    tracker = tracked()

    tracker.observe(replace(OFF, velocity_counts_per_s=-50_000.0), at(1.0), 0)

    assert tracker.status.moving is Moving.YES


def test_a_move_is_done_when_a_later_reading_says_so(moving):
    moving.observe(RUNNING, at(2.1), 0)
    assert moving.status.state is AxisState.DISCRETE_MOTION

    moving.observe(ON, at(2.2), 0)
    assert (moving.status.state, moving.status.command, moving.status.last_error) == (AxisState.STANDSTILL, None, None)


def test_a_reading_asked_for_before_the_start_ends_nothing(moving):
    moving.observe(ON, at(1.9), 0)

    assert (moving.status.state, moving.status.moving) == (AxisState.DISCRETE_MOTION, Moving.YES)


def test_reaching_the_commanded_velocity_is_not_standstill(moving):
    moving.take(CommandBegun(command(Verb.STOP, AxisState.STOPPING, Completion.REST)))
    started(moving, 3.0)

    moving.observe(replace(RUNNING, profile_done=True), at(3.1), 0)
    assert moving.status.state is AxisState.STOPPING

    moving.observe(ON, at(3.2), 0)
    assert moving.status.state is AxisState.STANDSTILL


def test_a_velocity_below_a_count_per_tick_that_is_reached_is_no_rest_until_a_stop(moving):
    moving.take(CommandBegun(command(Verb.MOVE_VELOCITY, AxisState.CONTINUOUS_MOTION, Completion.PROCEDURE)))
    moving.take(MotionStarted(moving.status.command.command_id, 3.0, endless=True))
    for step in range(20):
        moving.observe(replace(ON, position_counts=10 * step), at(3.1 + 0.05 * step), 0)
        assert (moving.status.at_rest, moving.status.stands_when_done) == (False, False)

    moving.take(MotionStarted(moving.status.command.command_id, 5.0, endless=False))
    moving.observe(replace(ON, position_counts=200), at(5.1), 0)

    assert (moving.status.at_rest, moving.status.stands_when_done) == (True, True)


def test_a_move_that_a_stop_ended_was_not_done(moving):
    moving.take(CommandBegun(command(Verb.STOP, AxisState.STOPPING, Completion.REST)))

    assert moving.status.last_error == "move_absolute: aborted by stop"


def test_a_drive_fault_ends_the_move_and_keeps_the_first_cause(moving):
    moving.observe(replace(OFF, faults=(OVERHEAT,)), at(2.5), 111)
    moving.observe(replace(OFF, faults=(Fault("position_error", "stuck"),)), at(2.6), 222)

    assert (moving.status.state, moving.status.command) == (AxisState.ERROR_STOP, None)
    assert [fault.code for fault in moving.status.active_faults] == ["position_error"]
    assert (moving.status.first_fault.code, moving.status.first_fault.since) == ("overheat", 111)


def test_a_loop_that_opens_by_itself_is_a_fault(moving):
    moving.observe(OFF, at(2.5), 0)

    assert moving.status.state is AxisState.ERROR_STOP
    assert moving.status.first_fault.code == "loop_opened"


def test_a_warning_stops_nothing(moving):
    moving.observe(replace(RUNNING, faults=(Fault("position_wrap", "wrapped", stops=False),)), at(2.5), 0)

    assert moving.status.state is AxisState.DISCRETE_MOTION
    assert [fault.code for fault in moving.status.active_faults] == ["position_wrap"]


def test_a_silent_drive_moves_unknown_not_no(moving):
    moving.take(PollMissed(0, another=False))
    assert (moving.status.link, moving.status.moving, moving.status.quality) == (
        LinkState.DEGRADED,
        Moving.UNKNOWN,
        Quality.UNCERTAIN,
    )

    for _ in range(MISSES_UNTIL_LOST - 1):
        moving.take(PollMissed(0, another=False))
    assert (moving.status.link, moving.status.moving, moving.status.quality) == (
        LinkState.DOWN,
        Moving.UNKNOWN,
        Quality.BAD,
    )


def test_after_a_gap_the_axis_is_in_error_stop_and_not_referenced(moving):
    moving.take(PlaceKnown(moving.status.scale))
    moving.take(DriveLost(0, another=False))
    moving.observe(ON, at(9.0), 0)

    assert (moving.status.state, moving.status.referenced, moving.status.link) == (
        AxisState.ERROR_STOP,
        False,
        LinkState.UP,
    )
    assert moving.status.first_fault.code == "link_lost"


def test_reset_forgets_the_cause_and_the_latch(moving):
    moving.take(StopLatch())
    moving.observe(replace(OFF, faults=(OVERHEAT,)), at(2.5), 0)
    assert moving.status.last_error

    moving.take(ResetDone(3.0))
    moving.observe(OFF, at(3.1), 0)

    assert (moving.status.state, moving.status.stop_latched, moving.status.first_fault) == (
        AxisState.DISABLED,
        False,
        None,
    )
    assert moving.status.last_error is None


def test_an_adopted_drive_that_runs_is_in_motion():
    tracker = tracked()

    tracker.observe(RUNNING, at(1.0), 0)
    assert (tracker.status.state, tracker.status.moving) == (AxisState.DISCRETE_MOTION, Moving.YES)

    for sent_at_s in (1.1, 1.2, 1.3):
        tracker.observe(ON, at(sent_at_s), 0)
    assert tracker.status.state is AxisState.DISCRETE_MOTION
    tracker.observe(ON, at(1.4), 0)
    assert tracker.status.state is AxisState.STANDSTILL


def test_a_procedure_alone_says_when_its_command_is_over(moving):
    moving.take(CommandBegun(command(Verb.HOME, AxisState.HOMING, Completion.PROCEDURE)))
    started(moving, 3.0)

    moving.observe(ON, at(3.1), 0)

    assert (moving.status.state, moving.status.command.verb) == (AxisState.HOMING, Verb.HOME)


def test_an_open_loop_fails_a_command_unless_it_is_meant_to_open_it(moving):
    moving.take(CommandBegun(command(Verb.MOVE_ABSOLUTE)))
    moving.take(CommandBegun(replace(command(Verb.SET_PWM, completion=Completion.PROCEDURE), opens_loop=True)))
    started(moving, 3.0)

    moving.observe(replace(OFF, profile_done=False), at(3.1), 0)
    assert (moving.status.state, moving.status.energised, moving.status.enabled) == (
        AxisState.DISCRETE_MOTION,
        True,
        False,
    )

    moving.take(CommandBegun(command(Verb.MOVE_ABSOLUTE)))
    started(moving, 4.0)
    moving.observe(OFF, at(4.1), 0)
    assert (moving.status.state, moving.status.energised) == (AxisState.ERROR_STOP, False)


@pytest.mark.parametrize("stops", [True, False])
def test_a_fault_that_loses_the_position_takes_the_reference_away_and_nothing_but_a_new_one_brings_it_back(stops):
    tracker = tracked()
    tracker.observe(ON, at(1.0), 0)
    tracker.take(PlaceKnown(tracker.status.scale))

    tracker.observe(replace(ON, faults=(Fault("lost", "home", stops=stops, loses_position=True),)), at(2.0), 0)
    assert (tracker.status.referenced, tracker.status.position_lost) == (False, True)

    tracker.take(ResetDone(3.0))
    tracker.observe(ON, at(3.1), 0)
    assert (tracker.status.referenced, tracker.status.position_lost) == (False, False)


@pytest.mark.parametrize("how", ["line lost", "not sent"])
def test_readings_count_again_after_a_start_that_no_drive_has_taken(how):
    tracker = tracked()
    tracker.observe(ON, at(1.0), 0)
    tracker.take(CommandBegun(command()))

    if how == "line lost":
        tracker.take(DriveLost(0, another=False))
    else:
        tracker.take(CommandOver("c-move_absolute", "the line was busy"))
    for at_s in (5.0, 5.5):
        tracker.observe(OFF, at(at_s), 0)

    assert (tracker.status.moving, tracker.status.enabled) == (Moving.NO, False)


def test_a_change_of_power_leads_out_of_no_error(moving):
    moving.observe(replace(OFF, faults=(OVERHEAT,)), at(2.5), 0)
    assert moving.status.state is AxisState.ERROR_STOP

    moving.take(PowerSwitched(on=False, now_s=3.0))
    assert moving.status.state is AxisState.ERROR_STOP


def test_a_loop_that_is_closed_in_the_course_of_a_command_is_enabled_at_once(moving):
    moving.take(LoopSwitched(on=False, now_s=3.0))
    assert (moving.status.enabled, moving.status.energised, moving.status.at_rest) == (False, False, False)

    moving.take(LoopSwitched(on=True, now_s=4.0))
    assert (moving.status.enabled, moving.status.energised) == (True, True)
    assert moving.status.command


def test_misses_count_only_in_a_row(moving):
    for number in range(5):
        moving.take(PollMissed(0, another=False))
        moving.take(PollMissed(0, another=False))
        assert moving.status.link is LinkState.DEGRADED
        moving.observe(RUNNING, at(3.0 + number), 0)
        assert moving.status.link is LinkState.UP


def test_a_drive_that_was_away_is_not_degraded_by_a_further_miss(moving):
    moving.take(DriveLost(5, another=False))
    faults = moving.status.active_faults
    moving.take(PollMissed(6, another=False))

    assert (moving.status.link, moving.status.active_faults) == (LinkState.DOWN, faults)
    assert faults[0].source == "daemon"


def test_what_brings_an_axis_to_rest_early_is_the_reason_of_its_end():
    ended = []
    tracker = tracked()

    def note_end(_before: AxisStatus, after: AxisStatus) -> None:
        ended.append((after.last_end.status, after.last_end.reason))

    tracker.watch(note_end, "last_end")
    tracker.observe(ON, at(1.0), 0)
    tracker.take(CommandBegun(command()))
    started(tracker, 2.0)

    tracker.observe(replace(RUNNING, cut_short="the drive stopped at the switch"), at(2.1), 0)
    tracker.observe(ON, at(2.2), 0)
    tracker.take(CommandBegun(command(Verb.MOVE_RELATIVE)))
    assert tracker.status.last_error is None
    started(tracker, 3.0)
    tracker.observe(ON, at(3.1), 0)

    assert ended == [(CommandStatus.FAILED, "the drive stopped at the switch"), (CommandStatus.DONE, None)]


@pytest.mark.parametrize(("state", "keeps"), [(AxisState.DISCRETE_MOTION, False), (AxisState.STOPPING, True)])
def test_what_takes_a_motion_over_is_no_error_of_it_and_what_stops_it_is(moving, state, keeps):
    moving.take(CommandBegun(command(Verb.MOVE_RELATIVE, state)))

    assert (moving.status.last_error is not None) is keeps


def test_an_unconfirmed_stop_is_one_fault_however_often_it_is_sent(moving):
    moving.take(StopUnconfirmed(5))
    moving.take(StopUnconfirmed(6))
    moving.observe(replace(RUNNING, faults=(Fault("position_wrap", "wrapped", stops=False),)), at(2.5), 7)
    assert [(fault.code, fault.since) for fault in moving.status.active_faults] == [
        ("position_wrap", 7), ("stop_unconfirmed", 5),
    ]  # fmt: skip

    moving.take(StopConfirmed())
    assert ([fault.code for fault in moving.status.active_faults], moving.status.stop_pending) == (
        ["position_wrap"],
        False,
    )


def test_a_jump_is_a_fault_until_reset_and_loses_the_reference(moving):
    moving.take(PlaceKnown(moving.status.scale))
    moving.take(FaultFound(JUMPED))
    moving.observe(ON, at(2.5), 0)
    assert (moving.status.state, moving.status.referenced) == (AxisState.ERROR_STOP, False)
    assert moving.status.first_fault.source == "daemon"
    moving.take(FaultFound(JUMPED))
    moving.observe(ON, at(2.6), 0)
    assert [fault.code for fault in moving.status.active_faults] == [JUMPED.code]

    moving.take(ResetDone(3.0))
    moving.observe(ON, at(3.1), 0)
    assert (moving.status.state, moving.status.active_faults, moving.status.first_fault) == (
        AxisState.STANDSTILL,
        (),
        None,
    )


def test_a_repeated_begin_of_one_command_does_not_abort_it(moving):
    moving.take(CommandBegun(replace(command(), state=AxisState.STOPPING, completion=Completion.REST)))

    assert (moving.status.last_error, moving.status.state) == (None, AxisState.STOPPING)


def test_an_axis_in_error_stays_there_when_its_loop_is_closed_and_at_rest():
    tracker = tracked()
    tracker.observe(ON, at(1.0), 0)
    tracker.take(DriveLost(0, another=False))
    for step in range(5):
        tracker.observe(ON, at(2.0 + step), 0)

    assert tracker.status.state is AxisState.ERROR_STOP
    assert tracker.status.at_rest


def test_a_disabled_axis_that_is_lost_from_sight_is_in_no_error():
    tracker = tracked()
    tracker.observe(OFF, at(1.0), 0)
    tracker.take(DriveLost(0, another=False))

    assert tracker.status.state is AxisState.DISABLED
    assert tracker.status.active_faults
