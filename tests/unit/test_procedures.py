"""Homing, jogs, duties, set-points, analog and group moves step by step, on a drive that only records."""

import asyncio
import contextlib
import gc
import math
from dataclasses import replace

import pytest

from ldcnd.axis.events import ResetDone, StopLatch
from ldcnd.axis.permit import Right
from ldcnd.axis.procedures.group import GroupMoveRequest, Meeting
from ldcnd.contract.commands import (
    Halt,
    Home,
    HomeMethod,
    HomeStop,
    Jog,
    MoveAbsolute,
    MoveAnalog,
    MoveVelocity,
    Power,
    Probe,
    ProbeSource,
    QuickStop,
    SetOutputs,
    SetPwm,
    Track,
)
from ldcnd.contract.errors import (
    CommandAborted,
    CommandExpired,
    LdcndError,
    LeaseExpired,
    MalformedRequest,
    NotReferenced,
    NotSupported,
    OutcomeUnknown,
    PositionLimit,
    ReplyTimeout,
    StopLatched,
    TooManyRequests,
    ValueOutOfRange,
    VelocityLimit,
    WrongState,
)
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState, TelemetryItem
from ldcnd.drives.driver import AnalogMotion, CountsMotion, Fault, HomeCapture, PwmOutput, StopMode
from tests.support.axis_bench import RUNNING, STANDING, AxisBench, axis_bench, put, raising

LOST = ReplyTimeout("no reply")
PWM = {"duty": 0.5, "duration_s": 5.0}
CUT_SHORT = "the drive stopped at the forward limit switch"
OVERHEAT = Fault("overheat", "let it cool down")
SEARCHING = {**RUNNING, "homing": True, "captured": False}
CAPTURED = {**RUNNING, "homing": False, "captured": True}
RESTING = {**STANDING, "homing": False, "captured": True}
FROM_BELOW = {"approach": {"direction": "positive", "distance": 0.5}}


def loads(bench: AxisBench) -> list:
    return [what for name, what in bench.drive.told if name == "load"]


def status(bench: AxisBench, command_id: str) -> list[tuple[CommandStatus, str | None]]:
    return [(status, reason) for ended, status, reason in bench.ended if ended == command_id]


async def test_a_shaft_that_creeps_on_behind_a_refused_change_of_velocity_is_not_at_rest_before_its_stop_is_heard():
    """Its profile is done once its velocity is reached, and less than a count per tick of that shows in no reading."""
    async with axis_bench() as bench:
        await bench.send(MoveVelocity(velocity=0.3))
        await bench.pass_s(0.1, **RUNNING)
        await bench.send(MoveVelocity(velocity=0.4))
        bench.drive.during["start"] = raising(WrongState("a rule forbids it by now"))
        bench.drive.during["stop"] = raising(LOST)
        with pytest.raises(ReplyTimeout):
            await bench.send(MoveVelocity(velocity=0.5))
        bench.show(**STANDING)

        assert (bench.tracker.status.at_rest, bench.tracker.status.stands_when_done) == (False, False)


# -- homing ------------------------------------------------------------------------------------------------------------

INDEX = Home(method=HomeMethod.INDEX, velocity=5.0, position=100.0)
ONTO_SWITCH = Home(method=HomeMethod.FORWARD_LIMIT, velocity=5.0, position=20.0)


async def test_a_search_is_armed_started_once_and_taken_over_when_it_has_captured():
    async with axis_bench() as bench:
        bench.drive.home_counts = 1234
        reply = await bench.send(INDEX, "home")
        assert (reply.position, reply.velocity, reply.acceleration) == (100.0, 5.0, 200.0)
        assert bench.drive.calls == ["load", "start"]
        motion, capture = loads(bench)[0]
        assert capture == HomeCapture(HomeMethod.INDEX, StopMode.SMOOTH, guarded=True)
        assert motion == CountsMotion(round(5000 * 60.0 * 1.1), 5000.0, 200_000.0)
        assert (bench.tracker.status.state, bench.tracker.status.referenced) == (AxisState.HOMING, False)

        await bench.pass_s(0.5, **SEARCHING)
        assert bench.drive.calls == ["load", "start"]
        await bench.pass_s(0.5, position_counts=1300, **CAPTURED)
        assert bench.drive.calls == ["load", "start", "stop", "captured_home", "clear_warnings"]
        assert bench.tracker.status.referenced
        assert bench.tracker.status.scale.position(1234) == 100.0
        assert bench.tracker.status.state is AxisState.HOMING  # until it has come to rest
        await bench.settled(position_counts=1300)
        assert (bench.tracker.status.state, status(bench, "home")) == (
            AxisState.STANDSTILL,
            [(CommandStatus.DONE, None)],
        )


async def test_a_search_that_comes_to_rest_without_a_capture_has_failed():
    async with axis_bench() as bench:
        await bench.send(INDEX.model_copy(update={"distance": 3.0}), "home")
        assert loads(bench)[0][0].target_counts == 3000
        await bench.pass_s(0.5, **SEARCHING)
        await bench.settled(homing=True, position_counts=3000)

        assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)
        assert status(bench, "home") == [(CommandStatus.FAILED, "no index within 3 mm")]
        assert not bench.tracker.status.referenced


async def test_a_search_is_given_up_at_its_deadline():
    async with axis_bench() as bench:
        await bench.send(INDEX.model_copy(update={"timeout_s": 2.0, "distance": 30.0}), "home")
        await bench.pass_s(1.9, **SEARCHING)
        assert bench.drive.calls == ["load", "start"]
        await bench.pass_s(0.2, **SEARCHING)
        assert bench.drive.calls == ["load", "start", "stop"]
        await bench.settled(homing=False, captured=True)

    assert status(bench, "home") == [(CommandStatus.FAILED, "no index within 2 s")]


@pytest.mark.parametrize("velocity", [5.0, -5.0])
async def test_a_search_is_never_longer_than_the_counter_of_the_drive(velocity):
    async with axis_bench() as bench:
        await bench.send(INDEX.model_copy(update={"velocity": velocity, "distance": 1e9}))

        assert loads(bench)[0][0].target_counts == math.copysign(0x7FFF_FFFF, velocity)


@pytest.mark.parametrize("call", ["load", "start", "stop", "captured_home", "clear_warnings"])
async def test_a_stop_at_any_step_of_a_search_leaves_no_reference_and_no_command(call):
    async with axis_bench() as bench:
        bench.drive.during[call] = bench.stop
        with contextlib.suppress(StopLatched):
            await bench.send(INDEX, "home")
        await bench.pass_s(0.1, **SEARCHING)
        await bench.pass_s(0.1, **CAPTURED)
        await bench.settled(homing=False, captured=True)

        assert not bench.tracker.status.referenced
        assert (bench.tracker.status.command, bench.tracker.status.state) == (None, AxisState.STANDSTILL)
        assert bench.tracker.status.stop_latched
        assert bench.drive.calls.count("start") == (0 if call == "load" else 1)


async def test_a_stop_while_a_search_looks_at_its_switch_starts_nothing():
    async with axis_bench() as bench:
        bench.bus.during = bench.stop
        with pytest.raises(StopLatched):
            await bench.send(ONTO_SWITCH)

        assert bench.drive.calls == ["stop"]
        assert bench.tracker.status.referenced  # as before


async def test_a_stop_while_a_search_that_failed_is_ended_leaves_the_command_of_the_stop():
    async with axis_bench() as bench:
        await bench.send(INDEX.model_copy(update={"timeout_s": 1.0}), "home")
        await bench.pass_s(0.1, **SEARCHING)
        bench.drive.during["stop"] = bench.stop
        await bench.pass_s(1.0, **SEARCHING)
        assert bench.tracker.status.command.verb == "stop"
        await bench.settled(homing=False, captured=True)

    assert status(bench, "home") == [(CommandStatus.ABORTED, "aborted by stop")]


async def test_a_stop_while_an_axis_brakes_off_its_switch_leaves_no_homing_behind():
    async with axis_bench() as bench:
        await bench.settled(forward_limit=True)
        await bench.send(ONTO_SWITCH, "home")
        await bench.pass_s(0.1, **SEARCHING)
        bench.drive.during["stop"] = bench.stop
        await bench.pass_s(0.1, forward_limit=False, **CAPTURED)
        assert bench.tracker.status.state is AxisState.STOPPING
        await bench.settled(homing=False, captured=True)

        assert (bench.tracker.status.command, bench.tracker.status.state) == (None, AxisState.STANDSTILL)
        assert bench.drive.calls == ["load", "start", "stop", "stop"]


async def test_an_axis_on_its_switch_leaves_it_before_it_searches():
    async with axis_bench() as bench:
        await bench.settled(forward_limit=True, reverse_limit=False)
        await bench.send(ONTO_SWITCH, "home")
        motion, capture = loads(bench)[0]
        assert (math.copysign(1, motion.target_counts), capture.stop) == (-1, StopMode.SMOOTH)

        await bench.pass_s(0.5, **SEARCHING)
        await bench.pass_s(0.1, forward_limit=False, **CAPTURED)
        assert bench.drive.calls == ["load", "start", "stop"]
        assert bench.tracker.status.state is AxisState.HOMING
        await bench.pass_s(0.1, **RESTING)
        assert bench.drive.calls == ["load", "start", "stop", "load", "start"]
        assert loads(bench)[1][0].target_counts > 0
        await bench.pass_s(0.1, **SEARCHING)
        await bench.pass_s(0.1, forward_limit=True, **CAPTURED)
        assert bench.tracker.status.referenced


async def test_an_axis_that_does_not_come_off_its_switch_gives_up():
    async with axis_bench() as bench:
        await bench.settled(forward_limit=True)
        await bench.send(ONTO_SWITCH, "home")
        await bench.pass_s(0.5, **SEARCHING)
        await bench.pass_s(0.1, **CAPTURED)
        await bench.pass_s(0.1, **RESTING)
        await bench.settled()

    assert status(bench, "home") == [(CommandStatus.FAILED, "the axis does not come off the forward_limit switch")]
    assert bench.drive.calls == ["load", "start", "stop", "stop"]


async def test_an_axis_that_does_not_come_to_rest_off_its_switch_gives_up():
    async with axis_bench() as bench:
        await bench.settled(forward_limit=True)
        await bench.send(ONTO_SWITCH.model_copy(update={"timeout_s": 5.0}), "home")
        await bench.pass_s(0.5, **SEARCHING)
        await bench.pass_s(0.1, forward_limit=False, **CAPTURED)
        await bench.pass_s(5.1, **CAPTURED)
        await bench.settled(homing=False, captured=True)

    assert status(bench, "home") == [(CommandStatus.FAILED, "not at rest off the switch within 5 s")]


async def test_a_switch_is_found_fast_then_left_and_then_searched_slowly():
    async with axis_bench() as bench:
        await bench.settled(forward_limit=False)
        await bench.send(ONTO_SWITCH.model_copy(update={"find_velocity": 15.0}), "home")
        assert loads(bench)[0][0].velocity_counts_per_s == 15_000.0
        await bench.pass_s(0.1, **SEARCHING)
        await bench.pass_s(0.1, forward_limit=True, **CAPTURED)
        assert not bench.tracker.status.referenced
        await bench.pass_s(0.1, **RESTING)
        assert [load[0].velocity_counts_per_s for load in loads(bench)] == [15_000.0, 5000.0]
        assert loads(bench)[1][0].target_counts < 0
        assert [load[1].stop for load in loads(bench)] == [StopMode.SMOOTH] * 2


async def test_a_search_that_has_begun_is_not_late_for_its_further_legs():
    late = []

    def in_time() -> None:
        if late:
            raise CommandExpired("it comes too late")

    async with axis_bench() as bench:
        await bench.settled(forward_limit=False)
        await bench.send(ONTO_SWITCH.model_copy(update={"find_velocity": 15.0}), "home", Right(in_time=in_time))
        late.append(True)
        await bench.pass_s(0.1, **SEARCHING)
        await bench.pass_s(0.1, forward_limit=True, **CAPTURED)
        await bench.pass_s(0.1, **RESTING)

        assert bench.drive.calls.count("start") == 2
        assert status(bench, "home") == []


async def test_a_search_away_from_its_switch_looks_at_no_switch_and_finds_nothing_first():
    async with axis_bench() as bench:
        await bench.settled(forward_limit=True)
        bench.bus.during = raising(AssertionError("read"))
        away = Home(method=HomeMethod.FORWARD_LIMIT, velocity=-5.0, find_velocity=15.0)
        await bench.send(away)

        assert loads(bench)[0][0].velocity_counts_per_s == 5000.0
        assert loads(bench)[0][0].target_counts < 0


@pytest.mark.parametrize(("active", "level", "on"), [("high", True, True), ("low", True, False), ("low", False, True)])
async def test_the_level_of_a_switch_is_the_configured_one(active, level, on):
    home = {"method": "reverse_limit", "velocity": -5.0, "switch_active": active}
    async with axis_bench(home=home) as bench:
        await bench.settled(reverse_limit=level, forward_limit=not level)
        await bench.send(Home())

        assert (loads(bench)[0][0].target_counts > 0) is on


async def test_after_a_search_the_axis_moves_on_once_it_rests():
    async with axis_bench() as bench:
        bench.drive.home_counts = 1000
        await bench.send(INDEX.model_copy(update={"move_to": 90.0}), "home")
        await bench.pass_s(0.1, **SEARCHING)
        await bench.pass_s(0.1, position_counts=1100, **CAPTURED)
        assert bench.drive.calls.count("load") == 1
        await bench.settled(position_counts=1200)
        assert loads(bench)[1].target_counts == 1000 - 10_000
        assert bench.drive.calls.count("start") == 2
        assert status(bench, "home") == [(CommandStatus.DONE, None)]


async def test_a_step_that_nobody_knows_to_have_started_is_not_taken_twice_and_the_procedure_goes_on():
    async with axis_bench() as bench:
        await bench.settled(forward_limit=False)
        await bench.send(ONTO_SWITCH.model_copy(update={"find_velocity": 15.0}), "home")
        await bench.pass_s(0.1, **SEARCHING)
        bench.drive.during["start"] = raising(OutcomeUnknown("no reply"))
        await bench.pass_s(0.1, forward_limit=True, **CAPTURED)
        await bench.pass_s(0.1, **RESTING)
        assert bench.drive.calls.count("start") == 2
        await asyncio.sleep(1.0)
        assert bench.drive.calls.count("start") == 2
        assert status(bench, "home") == []

        await bench.pass_s(0.1, forward_limit=False, **SEARCHING)
        await bench.pass_s(0.1, forward_limit=False, **CAPTURED)
        await bench.settled(homing=False, captured=True)

        assert bench.tracker.status.referenced
        assert status(bench, "home") == [(CommandStatus.DONE, None)]


async def test_a_stop_ends_a_procedure_whose_step_nobody_knows_to_have_started():
    async def stopped() -> None:
        await bench.stop()
        raise OutcomeUnknown("no reply")

    async with axis_bench() as bench:
        await bench.settled(forward_limit=False)
        await bench.send(ONTO_SWITCH.model_copy(update={"find_velocity": 15.0}), "home")
        await bench.pass_s(0.1, **SEARCHING)
        bench.drive.during["start"] = stopped
        await bench.pass_s(0.1, forward_limit=True, **CAPTURED)
        await bench.pass_s(0.1, **RESTING)
        await bench.settled(homing=False, captured=True)

        assert bench.axis.commands.procedure is None
        assert not bench.tracker.status.referenced


async def test_an_axis_that_does_not_rest_after_its_search_does_not_move_on():
    async with axis_bench() as bench:
        await bench.send(INDEX.model_copy(update={"move_to": 90.0, "timeout_s": 2.0}), "home")
        await bench.pass_s(0.1, **SEARCHING)
        await bench.pass_s(0.1, **CAPTURED)
        await bench.pass_s(2.1, **CAPTURED)
        await bench.settled(homing=False, captured=True)

    assert bench.drive.calls.count("start") == 1
    assert status(bench, "home") == [(CommandStatus.FAILED, "not at rest within 2 s")]


async def test_a_search_that_opens_the_loop_ends_with_the_loop_open():
    async with axis_bench() as bench:
        await bench.send(INDEX.model_copy(update={"stop": HomeStop.OFF}), "home")
        await bench.pass_s(0.1, **SEARCHING)
        await bench.pass_s(0.1, enabled=False, **CAPTURED)

        assert ("stop", StopMode.OFF) in bench.drive.told
        assert (bench.tracker.status.state, bench.tracker.status.referenced) == (AxisState.DISABLED, True)
        assert status(bench, "home") == [(CommandStatus.DONE, None)]


@pytest.mark.parametrize("stopped", ["", "reset", "power"])
async def test_a_search_by_position_error_resets_the_drive_and_closes_the_loop_again(stopped):
    async with axis_bench() as bench:
        bench.drive.home_counts = 500
        if stopped:
            bench.drive.during[stopped] = bench.stop
        await bench.send(Home(method=HomeMethod.POSITION_ERROR, velocity=5.0), "home")
        await bench.pass_s(0.1, **SEARCHING)
        await bench.pass_s(0.1, **CAPTURED | {"enabled": False, "velocity_counts_per_s": 0.0})

        assert bench.drive.calls[2:4] == ["reset", "stop" if stopped == "reset" else "captured_home"]
        assert ("power" in bench.drive.calls) is (stopped != "reset")
        assert bench.tracker.status.referenced is not bool(stopped)


async def test_the_preset_completes_a_request_and_the_request_outranks_it():
    preset = {
        "method": "forward_limit", "velocity": 5.0, "find_velocity": 10.0, "position": 7.0, "timeout_s": 3.0,
        "distance": 4.0, "stop": "abrupt", "move_to": 1.0,
    }  # fmt: skip
    async with axis_bench(home=preset) as bench:
        reply = await bench.send(Home())
        assert reply.position == 7.0
        assert loads(bench)[0][0] == CountsMotion(4000, 10_000.0, 200_000.0)
        await bench.stop()
        await bench.settled()
        bench.tracker.take(ResetDone(0.0))
        await bench.settled()
        bench.drive.told.clear()
        await bench.send(Home(method=HomeMethod.INDEX, velocity=2.0, position=0.0, distance=8.0, stop=HomeStop.SMOOTH))

        capture = HomeCapture(HomeMethod.INDEX, StopMode.SMOOTH, guarded=True)
        assert loads(bench) == [(CountsMotion(8000, 2000.0, 200_000.0), capture)]


@pytest.mark.parametrize(
    ("request_", "refusal"),
    [
        (Home(), MalformedRequest),
        (Home(method=HomeMethod.INDEX), MalformedRequest),
        (Home(velocity=1.0), MalformedRequest),
        (Home(method=HomeMethod.CURRENT, velocity=1.0), NotSupported),
        (Home(method=HomeMethod.INDEX, velocity=1.0, stop=HomeStop.OFF, move_to=1.0), MalformedRequest),
        (Home(method=HomeMethod.INDEX, velocity=1.0, move_to=101.0), PositionLimit),
        (Home(method=HomeMethod.INDEX, velocity=31.0), VelocityLimit),
        (Home(method=HomeMethod.INDEX, velocity=8.0), VelocityLimit),
    ],
)
async def test_a_search_that_cannot_be_is_refused_before_anything_is_sent(request_, refusal):
    async with axis_bench(limits={"position_max": 100.0, "velocity": 30.0}) as bench:
        bench.drive.home_methods = frozenset(HomeMethod) - {HomeMethod.CURRENT}
        bench.drive.capture_s = 0.0001  # 7.5 mm/s with an index of one count

        with pytest.raises(refusal):
            await bench.send(request_)

        assert bench.drive.calls == []
        assert bench.tracker.status.referenced


async def test_an_index_search_as_fast_as_the_drive_can_see_is_taken_and_other_captures_do_not_care():
    async with axis_bench() as bench:
        bench.drive.capture_s = 0.0001
        with pytest.raises(VelocityLimit) as refusal:
            await bench.send(INDEX.model_copy(update={"velocity": -8.0}))
        assert refusal.value.nearest == -7.5
        await bench.send(INDEX.model_copy(update={"velocity": -7.5}))
        await bench.stop()
        await bench.settled()
        bench.tracker.take(ResetDone(0.0))
        await bench.settled()
        await bench.send(Home(method=HomeMethod.CURRENT, velocity=8.0))


async def test_a_step_whose_packets_were_lost_is_taken_again():
    async with axis_bench() as bench:
        await bench.send(INDEX, "home")
        await bench.pass_s(0.1, **SEARCHING)
        bench.drive.during["captured_home"] = raising(LOST)
        await bench.pass_s(0.1, **CAPTURED)
        assert not bench.tracker.status.referenced
        await asyncio.sleep(0.19)
        assert bench.drive.calls.count("captured_home") == 1
        await asyncio.sleep(0.02)

        assert bench.drive.calls.count("captured_home") == 2
        assert bench.tracker.status.referenced


async def test_a_step_of_a_drive_that_does_not_answer_is_taken_again_more_slowly():
    async with axis_bench() as bench:
        await bench.send(INDEX.model_copy(update={"timeout_s": 1.0}), "home")
        await bench.pass_s(0.5, **SEARCHING)
        bench.axis.readings.miss(LOST)
        bench.drive.during["stop"] = raising(LOST)
        await asyncio.sleep(0.6)
        assert bench.drive.calls.count("stop") == 1
        await asyncio.sleep(0.8)
        assert bench.drive.calls.count("stop") == 1
        await asyncio.sleep(0.2)
        assert bench.drive.calls.count("stop") == 2


async def test_a_leg_whose_sender_has_lost_the_axis_is_not_begun_and_the_axis_comes_to_rest():
    lost = []

    def holds() -> None:
        if lost:
            raise LeaseExpired("the lease has ended")

    async with axis_bench() as bench:
        await bench.settled(forward_limit=True)
        await bench.send(ONTO_SWITCH, "home", Right(holds=holds))
        await bench.pass_s(0.1, **SEARCHING)
        await bench.pass_s(0.1, forward_limit=False, **CAPTURED)
        lost.append(True)
        await bench.pass_s(0.1, **RESTING)
        assert bench.drive.calls == ["load", "start", "stop", "stop"]
        await bench.settled()

    assert status(bench, "home") == [(CommandStatus.FAILED, "the lease has ended")]


@pytest.mark.promise("permission-at-motion")
async def test_the_second_motion_of_an_approach_whose_sender_has_lost_the_axis_is_not_begun():
    lost = []

    def holds() -> None:
        if lost:
            raise LeaseExpired("the lease has ended")

    async with axis_bench(**FROM_BELOW) as bench:
        await bench.send(MoveAbsolute(position=-5.0), "first", Right(holds=holds))
        await bench.pass_s(0.1, position_counts=-500, profile_done=False, velocity_counts_per_s=-10_000.0)
        lost.append(True)
        await bench.settled(position_counts=-5500)

        assert bench.drive.calls == ["load", "start", "stop"]
        assert status(bench, "first") == [(CommandStatus.FAILED, "the lease has ended")]


async def test_a_fault_ends_a_search_and_no_step_follows():
    async with axis_bench() as bench:
        await bench.send(INDEX.model_copy(update={"timeout_s": 1.0}), "home")
        await bench.pass_s(0.1, **SEARCHING)
        bench.show(faults=(OVERHEAT,), enabled=False, **RESTING)
        await asyncio.sleep(5.0)

    assert bench.drive.calls == ["load", "start"]
    assert status(bench, "home")[0][0] is CommandStatus.FAILED


# -- jogs that change their velocity -----------------------------------------------------------------------------------


async def jogging(bench: AxisBench, velocity: float = 10.0, **changes: object) -> None:
    await bench.send(MoveVelocity(velocity=velocity), "jog")
    await bench.pass_s(0.1, **(RUNNING | changes))
    bench.drive.told.clear()


async def test_a_jog_changes_its_velocity_in_velocity_mode_and_is_ended_before_the_limit():
    async with axis_bench(limits={"position_max": 50.0}) as bench:
        await jogging(bench)
        reply = await bench.send(MoveVelocity(velocity=5.0), "slower")
        assert bench.drive.told == [("load", CountsMotion(None, 5000.0, 200_000.0)), ("start", None)]
        assert (reply.velocity, reply.acceleration) == (5.0, 200.0)

        # 10 mm/s before the change: 10 * 10 / (2 * 200) + 10 * 0.2
        await bench.pass_s(0.1, position_counts=47_749)
        assert bench.drive.calls == ["load", "start"]
        await bench.pass_s(0.1, position_counts=47_751)
        assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)
        await bench.settled(position_counts=48_000)
        assert status(bench, "slower") == [(CommandStatus.DONE, None)]


async def test_a_jog_backwards_is_ended_before_the_lower_limit():
    async with axis_bench(limits={"position_min": -50.0}) as bench:
        await jogging(bench, -10.0, velocity_counts_per_s=-10_000.0)
        await bench.send(MoveVelocity(velocity=-10.0))
        await bench.pass_s(0.1, position_counts=-47_749, velocity_counts_per_s=-10_000.0)
        assert "stop" not in bench.drive.calls
        await bench.pass_s(0.1, position_counts=-47_751, velocity_counts_per_s=-10_000.0)

    assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)


async def test_a_jog_without_a_limit_ends_at_its_horizon():
    async with axis_bench(jog_horizon_s=2.0) as bench:
        await jogging(bench)
        await bench.send(MoveVelocity(velocity=5.0))
        await bench.pass_s(1.9, **RUNNING)
        assert "stop" not in bench.drive.calls
        await bench.pass_s(0.2, **RUNNING)

    assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)


async def test_a_jog_is_not_made_faster_where_the_limit_is_too_near():
    async with axis_bench(limits={"position_max": 50.0}) as bench:
        await jogging(bench, position_counts=47_800)
        with pytest.raises(PositionLimit, match="too near"):
            await bench.send(MoveVelocity(velocity=10.0))
        assert bench.drive.calls == []

        put(bench.tracker, referenced=False)
        await bench.send(MoveVelocity(velocity=10.0))


async def test_a_jog_that_the_drive_cut_short_has_failed():
    async with axis_bench() as bench:
        await jogging(bench)
        await bench.send(MoveVelocity(velocity=5.0), "slower")
        await bench.pass_s(0.1, cut_short=CUT_SHORT, **RUNNING)
        assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)
        await bench.settled()

    assert [reason for _, _, reason in bench.ended if reason and "switch" in reason]


async def test_a_held_jog_is_renewed_by_nobody_while_it_is_being_stopped():
    held, refused = Jog(velocity=5.0, hold_s=1.0), []
    async with axis_bench() as bench:

        async def renew() -> None:
            try:
                bench.axis.renew_jog(held, "held")
            except LeaseExpired as error:
                refused.append(error)

        bench.axis.begin_hold("held", held)
        await bench.send(held, "held")
        await renew()
        assert refused == []
        bench.drive.during["stop"] = renew
        await bench.pass_s(0.1, cut_short=CUT_SHORT, **RUNNING)

    assert len(refused) == 1


async def test_a_jog_that_was_lost_from_sight_is_stopped_until_it_is_seen_at_rest():
    async with axis_bench() as bench:
        await jogging(bench)
        await bench.send(MoveVelocity(velocity=5.0))
        bench.axis.disconnected()
        await bench.pass_s(0.5, **RUNNING)

        assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)


# -- behind a limit switch ---------------------------------------------------------------------------------------------


async def test_a_move_that_goes_on_behind_its_switch_is_stopped_until_its_drive_has_heard_it():
    async with axis_bench() as bench:
        await bench.send(MoveAbsolute(position=10.0), "move")
        bench.drive.during["stop"] = raising(LOST)
        await bench.pass_s(0.1, cut_short=CUT_SHORT, **RUNNING)
        assert bench.drive.calls == ["load", "start", "stop"]
        await bench.pass_s(0.1, **RUNNING)
        assert bench.drive.told[2:] == [("stop", StopMode.SMOOTH)] * 2
        assert bench.tracker.status.state is AxisState.STOPPING
        await bench.settled(cut_short="")

    assert status(bench, "move") == [(CommandStatus.FAILED, CUT_SHORT)]


async def test_a_move_that_is_over_by_the_time_is_not_stopped_behind_its_switch():
    async with axis_bench() as bench:

        async def rests() -> None:
            bench.show(cut_short=CUT_SHORT, **RUNNING)
            bench.show(cut_short="", **STANDING)

        bench.drive.during["set_outputs"] = rests
        await bench.send(MoveAbsolute(position=10.0), "move")
        await bench.send(SetOutputs(limit1="input"))
        await asyncio.sleep(0.1)
        assert bench.drive.calls == ["load", "start", "set_outputs"]
        assert status(bench, "move") == [(CommandStatus.FAILED, CUT_SHORT)]
        await bench.send(MoveAbsolute(position=5.0))


async def test_a_duty_that_a_switch_has_ended_is_over():
    async with axis_bench(pwm=PWM) as bench:
        await bench.send(SetPwm(duty=0.2, duration_s=2.0), "pwm")
        await bench.pass_s(0.1, enabled=False, cut_short=CUT_SHORT, **STANDING)
        assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)
        await bench.settled(enabled=True, cut_short="")

    assert status(bench, "pwm") == [(CommandStatus.FAILED, CUT_SHORT)]


# -- raw duties --------------------------------------------------------------------------------------------------------


async def test_a_duty_is_ended_after_its_time():
    async with axis_bench(pwm=PWM) as bench:
        reply = await bench.send(SetPwm(duty=0.2, duration_s=2.0), "pwm")
        assert bench.drive.told == [("load", PwmOutput(0.2, 200_000.0)), ("start", None)]
        assert (reply.duty, reply.duration_s) == (0.2, 2.0)
        await bench.pass_s(1.9, enabled=False, **RUNNING)
        assert bench.tracker.status.state is AxisState.CONTINUOUS_MOTION  # an open loop is what was asked for
        assert "stop" not in bench.drive.calls
        await asyncio.sleep(0.2)
        assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)
        await bench.settled(enabled=True)

    assert bench.tracker.status.state is AxisState.STANDSTILL


@pytest.mark.parametrize(("call", "ended"), [("start", ["stop"]), ("load", [])])
async def test_a_duty_whose_sender_is_cancelled_is_ended_after_its_time_if_it_may_have_begun(call, ended):
    async with axis_bench(pwm=PWM) as bench:
        bench.drive.during[call] = raising(asyncio.CancelledError())
        with pytest.raises(asyncio.CancelledError):
            await bench.send(SetPwm(duty=0.2, duration_s=2.0), "pwm")
        shown = {"enabled": False, **RUNNING} if ended else {"enabled": True, **STANDING}
        await bench.pass_s(2.1, **shown)
        assert [each for each in bench.drive.calls if each == "stop"] == ended
        await bench.settled(enabled=True)


async def test_a_duty_may_replace_a_duty_but_not_while_it_is_being_stopped():
    async with axis_bench(pwm=PWM) as bench:
        await bench.send(SetPwm(duty=0.2, duration_s=2.0))
        await bench.send(SetPwm(duty=-0.1, duration_s=1.0))
        assert [load.duty for load in loads(bench)] == [0.2, -0.1]

        await bench.stop()
        with pytest.raises(StopLatched):
            await bench.send(SetPwm(duty=0.1, duration_s=1.0))
        assert len(loads(bench)) == 2


@pytest.mark.parametrize(
    ("duty", "duration_s", "complaint", "nearest"),
    [
        (0.6, 1.0, "duty 0.6 is above the limit 0.5", 0.5),
        (-0.6, 1.0, "duty -0.6 is above the limit 0.5", -0.5),
        (0.1, 6.0, "6 s of duty is above the limit 5 s", 5.0),
    ],
)
async def test_a_duty_beyond_its_bounds_is_refused(duty, duration_s, complaint, nearest):
    async with axis_bench(pwm=PWM) as bench:
        with pytest.raises(ValueOutOfRange, match=complaint) as refusal:
            await bench.send(SetPwm(duty=duty, duration_s=duration_s))
        await bench.send(SetPwm(duty=0.5, duration_s=5.0))

    assert refusal.value.nearest == nearest
    assert len(loads(bench)) == 1


async def test_a_duty_needs_an_axis_that_stands_and_bounds():
    async with axis_bench(pwm=PWM) as bench:
        await bench.send(MoveAbsolute(position=10.0))
        with pytest.raises(WrongState):
            await bench.send(SetPwm(duty=0.1, duration_s=1.0))
    async with axis_bench() as bench:
        with pytest.raises(NotSupported, match="not configured for raw duties"):
            await bench.send(SetPwm(duty=0.1, duration_s=1.0))
        assert bench.drive.calls == []


async def test_a_duty_that_was_lost_from_sight_is_switched_off():
    async with axis_bench(pwm=PWM) as bench:
        await bench.send(SetPwm(duty=0.2, duration_s=5.0))
        bench.axis.disconnected()
        await bench.pass_s(0.5, enabled=False, **RUNNING)

    assert bench.drive.told[-1] == ("stop", StopMode.OFF)


# -- streams of set-points ---------------------------------------------------------------------------------------------

TRACKING = {"step": 0.5, "rate": 50.0}


async def test_set_points_follow_each_other_within_their_step_and_rate():
    async with axis_bench(tracking=TRACKING) as bench:
        reply = await bench.send(Track(position=0.5), "one")
        assert reply.position == 0.5
        assert bench.tracker.status.state is AxisState.CONTINUOUS_MOTION
        await asyncio.sleep(0.02)
        await bench.send(Track(position=1.0), "two")  # from the set-point before, wherever the axis is
        assert [what for name, what in bench.drive.told if name == "track"] == [500, 1000]
        assert status(bench, "one") == [(CommandStatus.DONE, None)]

        await asyncio.sleep(0.02)
        with pytest.raises(ValueOutOfRange) as refusal:
            await bench.send(Track(position=1.6))
        assert refusal.value.nearest == pytest.approx(1.5)
        with pytest.raises(ValueOutOfRange) as refusal:
            await bench.send(Track(position=0.4))
        assert refusal.value.nearest == pytest.approx(0.5)


async def test_a_stream_is_over_when_nothing_comes_any_more():
    async with axis_bench(tracking=TRACKING) as bench:
        await bench.send(Track(position=0.1), "one")
        await bench.pass_s(0.45)
        assert bench.tracker.status.command
        await bench.pass_s(0.1)

        assert (bench.tracker.status.command, bench.tracker.status.state) == (None, AxisState.STANDSTILL)
        assert status(bench, "one") == [(CommandStatus.DONE, None)]
        assert bench.drive.calls == ["track"]


async def test_a_set_point_may_be_half_a_period_early_but_the_mean_rate_is_kept():
    async with axis_bench(tracking=TRACKING) as bench:
        await bench.send(Track(position=0.1))
        await asyncio.sleep(0.011)
        await bench.send(Track(position=0.2))
        await asyncio.sleep(0.011)
        with pytest.raises(TooManyRequests):
            await bench.send(Track(position=0.3))
        await asyncio.sleep(0.009)
        await bench.send(Track(position=0.3))

    assert bench.drive.calls == ["track"] * 3


@pytest.mark.parametrize("state", ["disabled", "moving", "latched", "not referenced", "beyond", "unconfigured"])
async def test_a_set_point_needs_a_closed_referenced_loop_at_rest_and_bounds(state):
    expected = {"not referenced": NotReferenced, "beyond": PositionLimit, "latched": StopLatched}
    tracking = {} if state == "unconfigured" else {"tracking": TRACKING}
    async with axis_bench(limits={"position_max": 0.3}, **tracking) as bench:
        if state == "disabled":
            await bench.send(Power(on=False))
        elif state == "moving":
            await bench.send(MoveAbsolute(position=0.2))
        elif state == "latched":
            await bench.stop()
            await bench.settled()
        elif state == "not referenced":
            put(bench.tracker, referenced=False)
        with pytest.raises(NotSupported if state == "unconfigured" else expected.get(state, WrongState)):
            await bench.send(Track(position=0.4 if state == "beyond" else 0.1))

    assert "track" not in bench.drive.calls


async def test_a_set_point_whose_sender_has_lost_the_axis_leaves_the_stream_as_it_is():
    async with axis_bench(tracking=TRACKING) as bench:
        await bench.send(Track(position=0.1), "one")
        await asyncio.sleep(0.02)
        asked = []

        def holds() -> None:
            asked.append(1)
            if len(asked) > 1:  # admitted, then lost
                raise LeaseExpired("the lease has ended")

        with pytest.raises(LeaseExpired):
            await bench.send(Track(position=0.2), "two", Right(holds=holds))

        assert bench.tracker.status.command.command_id == "one"
        assert bench.drive.calls == ["track"]


async def test_a_stop_ends_a_stream_and_no_set_point_follows():
    async with axis_bench(tracking=TRACKING) as bench:
        await bench.send(Track(position=0.1))
        await bench.stop()
        await asyncio.sleep(0.02)
        with pytest.raises(StopLatched):
            await bench.send(Track(position=0.2))

    assert bench.drive.calls == ["track", "stop"]


async def test_a_set_point_with_an_unknown_outcome_counts_for_the_next_one_and_a_lost_one_ends_the_stream():
    async with axis_bench(tracking=TRACKING) as bench:
        bench.drive.during["track"] = raising(OutcomeUnknown("no reply"))
        with pytest.raises(OutcomeUnknown):
            await bench.send(Track(position=0.4), "one")
        await asyncio.sleep(0.02)
        await bench.send(Track(position=0.8), "two")
        await asyncio.sleep(0.02)
        bench.drive.during["track"] = raising(LOST)
        with pytest.raises(ReplyTimeout):
            await bench.send(Track(position=0.9), "three")

        assert bench.tracker.status.command is None
        assert status(bench, "three") == [(CommandStatus.FAILED, "no reply")]


# -- analog moves ------------------------------------------------------------------------------------------------------


async def test_an_analog_move_ends_when_the_drive_says_so():
    async with axis_bench() as bench:
        reply = await bench.send(MoveAnalog(target=500, velocity=5.0), "analog")
        assert bench.drive.told == [("load", AnalogMotion(500, 5000.0, 200_000.0)), ("start", None)]
        assert (reply.target, reply.velocity, reply.acceleration) == (500, 5.0, 200.0)
        await bench.pass_s(0.1, **RUNNING)
        await bench.pass_s(0.1, **STANDING)

    assert status(bench, "analog") == [(CommandStatus.DONE, None)]


@pytest.mark.parametrize(
    ("seconds", "counts", "limit", "failure"),
    [
        (0.5, 3100, 20.0, "not there within 3 mm"),
        (0.5, -3100, 20.0, "not there within 3 mm"),
        (2.5, 100, 20.0, "not there within 2 s"),
        (0.5, 1900, 2.0, "stopped before a software limit"),
        (0.5, -1900, 2.0, "stopped before a software limit"),
        (0.5, 3000, 2.0, "not referenced"),
        (0.5, 2000, 20.0, None),
        (0.5, -2000, 20.0, None),
    ],
)
async def test_an_analog_move_is_stopped_at_each_of_its_bounds(seconds, counts, limit, failure):
    limits = {"position_min": -limit, "position_max": limit}
    async with axis_bench(analog={"timeout_s": 2.0, "distance": 3.0}, limits=limits) as bench:
        put(bench.tracker, referenced=failure is None or "limit" in failure)
        failure = None if failure == "not referenced" else failure
        await bench.send(MoveAnalog(target=500, velocity=5.0), "analog")
        await bench.pass_s(seconds, position_counts=counts, **RUNNING)
        assert ("stop" in bench.drive.calls) is (failure is not None)
        if failure:
            assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)
            await bench.settled()
            assert status(bench, "analog") == [(CommandStatus.FAILED, failure)]


async def test_an_analog_move_without_a_distance_goes_as_far_as_its_velocity_in_its_time():
    async with axis_bench() as bench:
        await bench.send(MoveAnalog(target=500, velocity=5.0, timeout_s=2.0))
        await bench.pass_s(0.1, position_counts=9_900, **RUNNING)
        assert "stop" not in bench.drive.calls
        await bench.pass_s(0.1, position_counts=10_100, **RUNNING)

    assert "stop" in bench.drive.calls


async def test_an_analog_target_above_full_scale_is_refused():
    async with axis_bench() as bench:
        with pytest.raises(ValueOutOfRange) as refusal:
            await bench.send(MoveAnalog(target=1024))
        await bench.send(MoveAnalog(target=1023))

    assert refusal.value.nearest == 1023


async def test_an_analog_move_needs_an_axis_that_stands():
    async with axis_bench() as bench:
        await bench.send(MoveAbsolute(position=1.0))
        with pytest.raises(WrongState):
            await bench.send(MoveAnalog(target=500))


@pytest.mark.parametrize("enabled", [True, False])
async def test_an_analog_move_that_was_lost_from_sight_is_stopped_or_switched_off(enabled):
    async with axis_bench() as bench:
        await bench.send(MoveAnalog(target=500))
        bench.axis.disconnected()
        await bench.pass_s(0.5, enabled=enabled, **RUNNING)
        assert bench.tracker.status.command is None
        assert bench.tracker.status.state is AxisState.ERROR_STOP

    assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH if enabled else StopMode.OFF)


# -- group moves -------------------------------------------------------------------------------------------------------


class FakeNetwork:
    """A line that starts a group after `meanwhile` has happened."""

    def __init__(self) -> None:
        self.started: list[set[str]] = []
        self.fails: Exception | None = None
        self.meanwhile = lambda: None

    async def start_group(self, motions, still_wanted):
        await asyncio.sleep(0.01)
        self.meanwhile()
        still_wanted()
        self.started.append(set(motions))
        if self.fails:
            raise self.fails


async def joined(bench: AxisBench, meeting: Meeting, position: float = 10.0, command_id: str = "group"):
    return await bench.send(GroupMoveRequest.of(MoveAbsolute(position=position), meeting), command_id)


async def outcome(call):
    try:
        return await call
    except LdcndError as error:
        return error


async def test_a_group_starts_once_all_its_members_have_their_turn():
    network = FakeNetwork()
    async with axis_bench() as one, axis_bench(name="y") as other, asyncio.TaskGroup() as group:
        meeting = Meeting(network, frozenset({"x", "y"}))
        first = group.create_task(joined(one, meeting), name="x")
        await asyncio.sleep(0.5)
        assert network.started == []
        reply = await joined(other, meeting, 20.0)
        await asyncio.sleep(0.01)

        assert network.started == [{"x", "y"}]
        assert (reply.position, first.result().position) == (20.0, 10.0)
        assert one.tracker.status.state is other.tracker.status.state is AxisState.DISCRETE_MOTION


async def test_a_member_whose_turn_does_not_come_keeps_all_from_moving():
    network = FakeNetwork()
    async with axis_bench() as one:
        with pytest.raises(WrongState, match="y did not get their turn"):
            await joined(one, Meeting(network, frozenset({"x", "y"})))

        assert (network.started, one.tracker.status.command) == ([], None)


async def test_a_member_that_cannot_move_keeps_all_from_moving_and_gives_the_cause():
    network = FakeNetwork()
    async with axis_bench() as one, axis_bench(name="y") as other, asyncio.TaskGroup() as group:
        await other.send(Power(on=False))
        meeting = Meeting(network, frozenset({"x", "y"}))
        first = group.create_task(outcome(joined(one, meeting)), name="x")
        await asyncio.sleep(0)
        begun_s = asyncio.get_running_loop().time()
        with pytest.raises(WrongState, match="disabled"):
            await joined(other, meeting)
        assert "disabled" in str(await first)  # the cause, at once, not that somebody was late
        assert asyncio.get_running_loop().time() - begun_s < 0.1
        assert "disabled" in str(meeting.failure)

    assert network.started == []


async def test_a_member_that_leaves_while_the_drives_are_loaded_keeps_all_from_moving():
    network = FakeNetwork()
    async with axis_bench() as one:
        meeting = Meeting(network, frozenset({"x"}))
        network.meanwhile = lambda: meeting.fail(LOST)
        with pytest.raises(ReplyTimeout):
            await joined(one, meeting)
        await one.pass_s(0.1)

        assert (network.started, one.tracker.status.command) == ([], None)


async def test_a_stop_of_a_member_while_the_drives_are_loaded_keeps_all_from_moving():
    network = FakeNetwork()
    async with axis_bench() as one:
        network.meanwhile = lambda: (one.tracker.take(StopLatch()), one.axis.gate.overtake(None, "a stop"))
        with pytest.raises(StopLatched):
            await joined(one, Meeting(network, frozenset({"x"})))

        assert (network.started, one.tracker.status.command) == ([], None)


async def test_a_failure_that_no_member_is_left_to_see_is_no_error_of_the_loop():
    reported = []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: reported.append(context))
    meeting = Meeting(FakeNetwork(), frozenset({"x"}))
    meeting.fail(LOST)
    await asyncio.sleep(0)

    del meeting
    gc.collect()

    assert reported == []


@pytest.mark.parametrize("error", [LOST, OutcomeUnknown("not all axes are known to have started")])
async def test_a_group_that_failed_to_start_is_over_unless_it_may_have_started(error):
    network = FakeNetwork()
    network.fails = error
    async with axis_bench() as one:
        with pytest.raises(type(error)):
            await joined(one, Meeting(network, frozenset({"x"})))

        if isinstance(error, OutcomeUnknown):
            assert one.tracker.status.command.command_id == "group"
            await one.pass_s(0.1, **STANDING)  # readings tell how it went
        assert one.tracker.status.command is None
        await asyncio.sleep(0)
        assert one.published(TelemetryItem.STATE).command is None


async def test_a_group_move_needs_a_reference():
    network = FakeNetwork()
    async with axis_bench() as one:
        put(one.tracker, referenced=False)
        with pytest.raises(NotReferenced):
            await joined(one, Meeting(network, frozenset({"x"})))


async def test_a_relative_move_counts_from_the_target_of_a_group_move():
    async with axis_bench() as one:
        await joined(one, Meeting(FakeNetwork(), frozenset({"x"})))
        await one.settled(position_counts=10_004)

        assert one.tracker.status.target_counts == 10_000
        assert replace(one.drive.shown).position_counts == 10_004


# -- jogs that a hand holds --------------------------------------------------------------------------------------------


async def test_a_jog_that_is_being_stopped_takes_no_renewal():
    refused = []

    async def renewed() -> None:
        with pytest.raises(LeaseExpired) as error:
            bench.axis.renew_jog(Jog(velocity=5.0), "jog")
        refused.append(error.value.value)

    async with axis_bench() as bench:
        await bench.send(Jog(velocity=5.0, hold_s=0.5), "jog")
        await bench.pass_s(0.1, **RUNNING)
        bench.drive.during["stop"] = renewed
        await asyncio.sleep(0.5)
        await bench.settled()

        assert refused == ["jog"]
        assert bench.drive.calls == ["load", "start", "stop"]


async def test_a_jog_that_turns_round_on_a_drive_that_must_stand_for_it_waits_until_it_stands():
    async with axis_bench() as bench:
        await bench.send(Jog(velocity=5.0, hold_s=1.0), "jog")
        await bench.pass_s(0.1, **RUNNING)
        bench.axis.renew_jog(Jog(velocity=-5.0, hold_s=1.0), "jog")
        await bench.pass_s(0.01, **RUNNING)
        assert bench.drive.calls == ["load", "start", "stop"]

        await bench.pass_s(0.1, profile_done=True, velocity_counts_per_s=5000.0)
        assert bench.drive.calls == ["load", "start", "stop"]  # the profile is done, the shaft still follows it
        while bench.drive.calls.count("load") == 1:
            await bench.pass_s(0.1, **STANDING)
        assert bench.tracker.status.state is AxisState.CONTINUOUS_MOTION
        assert bench.drive.calls == ["load", "start", "stop", "load", "start"]
        assert loads(bench)[1].target_counts < 0


# -- motions that have ended beside their goals ------------------------------------------------------------------------

NOBODY_HERE = "its drive holds the axis elsewhere than it was sent: another program has stopped it, or moved it"
SWITCH = "the drive stopped at the forward limit switch"
LED = {
    "a jog": (Jog(velocity=5.0, hold_s=1.0), {}, 1),
    "a jog to its limit": (Jog(velocity=5.0, hold_s=1.0), {"limits": {"position_max": 5.0}}, 1),
    "an approach": (MoveAbsolute(position=-5.0), FROM_BELOW, -1),
}
"""Each with the configuration that makes it so, and its direction."""
beside = pytest.mark.parametrize(("command", "config", "way"), LED.values(), ids=LED)


@beside
async def test_a_motion_of_which_nobody_knows_whether_it_began_was_stopped_by_nobody(command, config, way):
    async with axis_bench(settle={"window": 0.1}, **config) as bench:
        bench.drive.during["start"] = raising(OutcomeUnknown("no reply"))
        with pytest.raises(OutcomeUnknown):
            await bench.send(command, "first")
        await bench.settled(following_error_counts=0, position_counts=way)

        assert status(bench, "first") == [(CommandStatus.FAILED, "no reply")]
        assert bench.drive.calls == ["load", "start"]


@beside
async def test_a_motion_that_another_program_has_stopped_fails_wherever_it_led(command, config, way):
    async with axis_bench(settle={"window": 0.1}, **config) as bench:
        await bench.send(command, "first")
        running = {"profile_done": False, "velocity_counts_per_s": way * 5000.0}
        await bench.pass_s(0.1, position_counts=way * 500, **running)
        await bench.settled(position_counts=way * 1000, following_error_counts=0)

        assert status(bench, "first") == [(CommandStatus.FAILED, NOBODY_HERE)]


async def test_a_jog_that_a_switch_stops_while_it_looks_where_it_is_was_stopped_by_the_switch():
    async with axis_bench(settle={"window": 0.1}) as bench:
        bench.drive.retargets = True
        await bench.send(Jog(velocity=5.0, hold_s=0.4), "jog")
        await bench.pass_s(0.1, position_counts=500, following_error_counts=0, **RUNNING)

        async def met() -> None:
            bench.drive.shown = replace(bench.drive.shown, cut_short=SWITCH, **STANDING)

        bench.bus.during = met
        await bench.pass_s(0.25)

        assert status(bench, "jog") == [(CommandStatus.FAILED, SWITCH)]
        assert bench.drive.calls == ["load", "start"]


# -- halts that come while a command stops its drive by itself ---------------------------------------------------------

RESTS_AT = {**STANDING, "position_counts": 5000}
STOP_THEMSELVES = {
    "a jog that nobody holds": (Jog(velocity=5.0, hold_s=0.5), RUNNING, {**RUNNING, "position_counts": 2500}),
    "an analog move behind its time": (MoveAnalog(target=500, velocity=5.0, timeout_s=0.5), RUNNING, RESTS_AT),
    "a probe that met nothing": (
        Probe(sources=(ProbeSource.INDEX,), distance=5.0, velocity=10.0),
        SEARCHING,
        {**RESTS_AT, "homing": True},
    ),
}
"""Each with what its drive shows on the way, and then."""


def calmed(bench: AxisBench, command: Halt | QuickStop | Power):
    """Return what has a client calm the axis while a call of its drive is under way."""

    async def calm() -> None:
        await bench.send(command, "calm")

    return calm


@pytest.mark.parametrize(("command", "runs", "then"), STOP_THEMSELVES.values(), ids=STOP_THEMSELVES)
async def test_a_halt_outlives_the_command_that_was_stopping_its_drive_by_itself(command, runs, then):
    async with axis_bench() as bench:
        await bench.send(command, "first")
        await bench.pass_s(0.1, position_counts=500, **runs)
        bench.drive.during["stop"] = calmed(bench, Halt())
        await bench.pass_s(0.5, **then)
        await bench.settled(homing=False, captured=True)

        assert bench.drive.calls[-2:] == ["stop", "stop"]
        assert status(bench, "calm") == [(CommandStatus.DONE, None)]
        assert (bench.tracker.status.command, bench.tracker.status.state) == (None, AxisState.STANDSTILL)


@pytest.mark.parametrize(("calm", "state"), [(Halt(), AxisState.STANDSTILL), (Power(on=False), AxisState.DISABLED)])
async def test_a_jog_that_slows_down_for_another_velocity_does_not_begin_again_behind_what_ends_it(calm, state):
    async with axis_bench() as bench:
        await bench.send(Jog(velocity=5.0, hold_s=1.0), "jog")
        await bench.pass_s(0.1, **RUNNING)
        bench.drive.during["stop"] = calmed(bench, calm)
        bench.axis.renew_jog(Jog(velocity=-5.0, hold_s=1.0), "jog")
        await bench.pass_s(0.01, enabled=state is AxisState.STANDSTILL, **RUNNING)
        await bench.settled()

        assert bench.drive.calls == ["load", "start", "stop", "stop"]
        assert (bench.tracker.status.command, bench.tracker.status.state) == (None, state)
        assert status(bench, "calm") == ([(CommandStatus.DONE, None)] if isinstance(calm, Halt) else [])


@pytest.mark.parametrize("calm", [Halt(), QuickStop()], ids=lambda calm: calm.verb.value)
async def test_a_jog_that_is_calmed_while_it_looks_where_it_is_was_stopped_by_nobody_else(calm):
    async with axis_bench(settle={"window": 0.1}) as bench:
        bench.drive.retargets = True
        await bench.send(Jog(velocity=5.0, hold_s=0.4), "jog")
        await bench.pass_s(0.1, position_counts=500, following_error_counts=0, **RUNNING)

        async def calmed_at_once() -> None:
            await bench.send(calm, "calm")
            bench.drive.shown = replace(bench.drive.shown, **STANDING)

        bench.bus.during = calmed_at_once
        await bench.pass_s(0.25)
        await bench.settled()

        assert bench.drive.calls == ["load", "start", "stop"]
        assert CommandStatus.FAILED not in {how for _, how, _ in bench.ended}
        assert bench.tracker.status.state is AxisState.STANDSTILL


async def test_a_set_point_that_a_halt_has_overtaken_between_its_packets_leaves_the_halt_as_it_is():
    async def overtaken() -> None:
        await bench.send(Halt(), "calm")
        raise CommandAborted("track was overtaken by halt")

    async with axis_bench(tracking=TRACKING) as bench:
        bench.drive.during["track"] = overtaken
        with pytest.raises(CommandAborted):
            await bench.send(Track(position=0.1), "one")

        assert bench.tracker.status.state is AxisState.STOPPING  # until a reading shows that it stands
        await bench.settled()
        assert status(bench, "calm") == [(CommandStatus.DONE, None)]
        assert bench.tracker.status.last_error == "track: aborted by halt"


# -- probes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("distance", "ahead"), [(5.0, HomeMethod.FORWARD_LIMIT), (-5.0, HomeMethod.REVERSE_LIMIT)])
async def test_a_probe_that_the_switch_ahead_has_stopped_has_found_nothing(distance, ahead):
    async with axis_bench() as bench:
        bench.drive.stands_on = lambda limit, _reading: limit is ahead
        await bench.send(Probe(sources=(ProbeSource.INDEX,), distance=distance, velocity=1.0), "probe")
        await bench.pass_s(0.1, **SEARCHING)
        await bench.pass_s(0.1, **CAPTURED)
        await bench.settled(homing=False, captured=True)

        failure = f"the drive stopped at the {ahead.value.replace('_', ' ')} switch"
        assert status(bench, "probe") == [(CommandStatus.FAILED, failure)]
        assert bench.published(TelemetryItem.LATCH) is None


@pytest.mark.parametrize("distance", [5.0, -5.0])
async def test_a_probe_publishes_what_was_latched_and_stops(distance):
    async with axis_bench() as bench:
        bench.drive.home_counts = 777
        await bench.send(Probe(sources=(ProbeSource.INDEX,), distance=distance, velocity=1.0), "probe")
        assert loads(bench)[0][0].target_counts == round(distance * 1000)
        await bench.pass_s(0.1, **SEARCHING)
        assert bench.published(TelemetryItem.LATCH) is None
        await bench.pass_s(0.1, **CAPTURED)
        await bench.settled(homing=False, captured=True)

        latched = bench.published(TelemetryItem.LATCH)
        assert (latched.counts, latched.value, latched.command_id) == (777, 0.777, "probe")
        assert status(bench, "probe") == [(CommandStatus.DONE, None)]
        assert bench.tracker.status.referenced
