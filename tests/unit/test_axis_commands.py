"""What each command does to an axis, on a drive that only records what it is told."""

import contextlib
from dataclasses import replace

import pytest

from ldcnd.axis.events import StopUnconfirmed
from ldcnd.axis.faults import entry_of
from ldcnd.contract.commands import (
    Halt,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    PinMode,
    Power,
    Reset,
    SetGains,
    SetOutputs,
    SetPosition,
    Track,
    Verb,
)
from ldcnd.contract.errors import (
    BadReply,
    LeaseExpired,
    MalformedRequest,
    NotReferenced,
    OutcomeUnknown,
    PositionLimit,
    ReplyTimeout,
    StopLatched,
    StopNotConfirmed,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.questions import Preview
from ldcnd.contract.samples import AxisState, Moving
from ldcnd.drives.driver import CountsMotion, Fault, Gains, StopMode
from tests.support.axis_bench import GAINS, RUNNING, AxisBench, axis_bench, put, raising

WARNING = Fault("position_wrap", "the counter has wrapped", stops=False)
OVERHEAT = Fault("overheat", "let it cool down")
LOST = Fault("encoder", "the encoder was unplugged", loses_position=True)


def loaded(bench: AxisBench) -> CountsMotion:
    (motion,) = [what for name, what in bench.drive.told if name == "load"]
    return motion


# -- power, halt, reset ------------------------------------------------------------------------------------------------


async def test_power_closes_and_opens_the_loop():
    async with axis_bench() as bench:
        await bench.send(Power(on=False))
        assert bench.drive.told == [("stop", StopMode.OFF)]
        assert (bench.tracker.status.state, bench.tracker.status.enabled) == (AxisState.DISABLED, False)
        await bench.settled(enabled=False)

        await bench.send(Power(on=True))
        assert bench.drive.told[1:] == [("power", True)]
        assert (bench.tracker.status.state, bench.tracker.status.enabled) == (AxisState.STANDSTILL, True)


async def test_a_loop_that_was_to_be_closed_is_opened_again_when_permission_ends_among_the_packets():
    async with axis_bench(powered=False) as bench:
        await bench.settled()
        bench.drive.during["power"] = raising(LeaseExpired("the lease has ended"))
        with pytest.raises(LeaseExpired):
            await bench.send(Power(on=True))
        assert bench.drive.told == [("power", True), ("stop", StopMode.OFF)]

        bench.drive.told.clear()
        bench.drive.during["power"] = bench.stop
        with pytest.raises(StopLatched):
            await bench.send(Power(on=True))
        assert bench.drive.told == [("power", True), ("stop", StopMode.OFF), ("stop", StopMode.OFF)]


async def test_a_loop_that_is_closed_already_is_left_as_it_is():
    async with axis_bench() as bench:
        await bench.send(Power(on=True))

        assert bench.drive.told == []


async def test_power_in_mid_stop_is_refused_by_the_latch():
    async with axis_bench() as bench:
        await bench.send(MoveVelocity(velocity=1.0))
        await bench.pass_s(0.1, **RUNNING)
        await bench.stop()

        assert bench.tracker.status.state is AxisState.STOPPING
        with pytest.raises(StopLatched):
            await bench.send(Power(on=True))


async def test_an_axis_that_is_switched_off_in_motion_is_not_said_to_stand():
    async with axis_bench() as bench:
        await bench.send(MoveVelocity(velocity=10.0))
        await bench.pass_s(0.1, **RUNNING)

        await bench.send(Power(on=False))

        assert bench.tracker.status.moving is not Moving.NO
        assert not bench.tracker.status.at_rest
        await bench.pass_s(0.1, enabled=False, profile_done=True)
        assert bench.tracker.status.moving is Moving.YES  # it coasts


async def test_power_off_ends_the_motion_and_its_target_is_forgotten():
    async with axis_bench() as bench:
        await bench.send(MoveAbsolute(position=10.0), "first")
        await bench.pass_s(0.1, position_counts=4000, **RUNNING)
        await bench.send(Power(on=False))
        assert bench.ended[-1] == ("first", CommandStatus.ABORTED, "aborted by power")
        await bench.settled(enabled=False)
        await bench.send(Power(on=True))
        await bench.settled(enabled=True)
        bench.drive.told.clear()

        await bench.send(MoveRelative(distance=1.0))

        assert loaded(bench).target_counts == 5000


async def test_a_drive_without_gains_is_not_switched_on():
    async with axis_bench() as bench:
        await bench.send(Power(on=False))
        bench.drive.wanted_gains = None
        with pytest.raises(WrongState, match="no gains"):
            await bench.send(Power(on=True))
        with pytest.raises(WrongState, match="no gains yet"):
            await bench.send(SetGains(kp=100))
        await bench.send(SetGains(kp=100, el=2000))
        await bench.send(Power(on=True))

    assert bench.drive.calls == ["stop", "set_gains", "power"]
    assert bench.drive.told[1][1] == Gains(kp=100, kd=0, ki=0, il=0, ol=250, cl=0, el=2000, sr=1, deadband=0)


async def test_a_halt_is_always_sent_also_to_a_motor_that_seems_to_stand():
    async with axis_bench() as bench:
        await bench.send(Halt())
        assert bench.drive.calls == ["stop"]
        await bench.settled()

        await bench.send(MoveVelocity(velocity=10.0), "jog")
        await bench.pass_s(0.1, position_counts=2000, **RUNNING)
        bench.drive.told.clear()
        await bench.send(Halt(), "halt")

        assert bench.drive.told == [("stop", StopMode.SMOOTH)]
        assert (bench.tracker.status.state, bench.tracker.status.stop_latched) == (AxisState.STOPPING, False)
        await bench.settled(position_counts=3000)
        assert bench.tracker.status.state is AxisState.STANDSTILL
        bench.drive.told.clear()
        await bench.send(MoveRelative(distance=1.0))
        assert loaded(bench).target_counts == 4000


async def test_a_halt_stops_an_axis_in_error_that_still_turns():
    async with axis_bench() as bench:
        await bench.send(MoveVelocity(velocity=10.0))
        await bench.pass_s(0.1, faults=(OVERHEAT,), **RUNNING)
        assert bench.tracker.status.state is AxisState.ERROR_STOP
        bench.drive.told.clear()
        with pytest.raises(WrongState, match="still moves"):
            await bench.send(Reset())

        await bench.send(Halt())

        assert bench.drive.told == [("stop", StopMode.SMOOTH)]
        assert bench.tracker.status.state is AxisState.ERROR_STOP  # only a reset leads out of it


@pytest.mark.promise("stop-latches")
async def test_a_reset_in_mid_stop_keeps_the_latch():
    async with axis_bench() as bench:
        await bench.send(MoveVelocity(velocity=10.0))
        await bench.pass_s(0.1, **RUNNING)
        await bench.stop()
        bench.drive.told.clear()

        with pytest.raises(WrongState):
            await bench.send(Reset())
        assert bench.tracker.status.stop_latched

        await bench.settled()
        await bench.send(Reset())
        assert (bench.tracker.status.stop_latched, bench.drive.calls) == (False, [])
        assert bench.tracker.status.enabled  # nothing was wrong with the drive


async def test_a_reset_clears_a_fault_and_leaves_the_loop_open():
    async with axis_bench() as bench:
        await bench.settled(enabled=False, faults=(OVERHEAT,))
        assert bench.tracker.status.state is AxisState.ERROR_STOP

        await bench.send(Reset())

        assert bench.drive.calls == ["reset"]
        assert (bench.tracker.status.state, bench.tracker.status.active_faults) == (AxisState.DISABLED, ())


async def test_a_fault_that_shows_while_the_loop_is_open_is_reset_as_well():
    async with axis_bench(powered=False) as bench:
        await bench.settled()
        put(bench.tracker, state=AxisState.DISABLED)
        put(bench.tracker, faults=(entry_of(OVERHEAT, 0),))

        await bench.send(Reset())

        assert bench.drive.calls == ["reset"]


@pytest.mark.promise("stop-latches")
@pytest.mark.parametrize(("fault", "call"), [(OVERHEAT, "reset"), (WARNING, "clear_warnings")])
async def test_a_stop_that_comes_during_a_reset_keeps_its_latch(fault, call):
    async with axis_bench() as bench:
        bench.show(faults=(fault,))
        bench.drive.during[call] = bench.stop

        with pytest.raises(StopLatched):
            await bench.send(Reset())

        assert bench.drive.calls[-2:] == [call, "stop"]
        assert bench.tracker.status.stop_latched


async def test_a_reset_of_a_mere_warning_leaves_the_loop_as_it_is():
    async with axis_bench() as bench:
        await bench.settled(faults=(WARNING,))

        await bench.send(Reset())

        assert bench.drive.calls == ["clear_warnings"]
        assert (bench.tracker.status.state, bench.tracker.status.enabled) == (AxisState.STANDSTILL, True)


async def test_a_reset_waits_for_a_stop_that_no_drive_has_confirmed():
    async with axis_bench() as bench:
        bench.tracker.take(StopUnconfirmed(0))

        with pytest.raises(StopNotConfirmed, match="not confirmed"):
            await bench.send(Reset())

        assert bench.drive.calls == []


@pytest.mark.promise("latch-outlasts-programs")
async def test_a_reset_of_faults_only_clears_no_latch():
    async with axis_bench() as bench:
        bench.show(enabled=False, faults=(OVERHEAT,))
        await bench.stop()

        with pytest.raises(StopLatched, match="latched"):
            await bench.send(Reset(faults_only=True))
        assert "reset" not in bench.drive.calls
        assert bench.tracker.status.stop_latched

        await bench.send(Reset())
        assert not bench.tracker.status.stop_latched


# -- moves -------------------------------------------------------------------------------------------------------------


async def test_a_move_answers_what_the_drive_will_do():
    async with axis_bench() as bench:
        reply = await bench.send(MoveAbsolute(position=10.0, velocity=5.0, acceleration=50.0))

        assert bench.drive.told == [("load", CountsMotion(10_000, 5000.0, 50_000.0)), ("start", None)]
        assert (reply.position, reply.velocity, reply.acceleration) == (10.0, 5.0, 50.0)
        assert reply.duration_s == pytest.approx(10.0 / 5.0 + 5.0 / 50.0)


async def test_a_relative_move_counts_from_the_target_of_the_one_that_has_ended():
    async with axis_bench() as bench:
        await bench.send(MoveAbsolute(position=10.0))
        await bench.settled(position_counts=10_004)
        bench.drive.told.clear()

        await bench.send(MoveRelative(distance=1.0))

        assert loaded(bench).target_counts == 11_000


async def test_a_relative_move_from_a_position_that_two_readings_do_not_confirm_is_refused():
    async with axis_bench() as bench:
        positions = iter(range(0, 10_000_000, 100_000))

        async def jump() -> None:
            bench.drive.shown = replace(bench.drive.shown, position_counts=next(positions))
            bench.bus.during = jump

        bench.bus.during = jump
        with pytest.raises(BadReply, match="contradict"):
            await bench.send(MoveRelative(distance=1.0))

        assert bench.drive.calls == []


async def test_a_stop_that_comes_while_a_relative_move_reads_the_position_wins():
    async with axis_bench() as bench:
        bench.bus.during = bench.stop
        with pytest.raises(StopLatched):
            await bench.send(MoveRelative(distance=1.0))

        assert bench.drive.calls == ["stop"]


async def test_an_absolute_move_needs_a_reference_and_a_relative_one_does_not():
    async with axis_bench(limits={"position_max": 5.0}) as bench:
        put(bench.tracker, referenced=False)
        with pytest.raises(NotReferenced):
            await bench.send(MoveAbsolute(position=1.0))
        assert bench.drive.calls == []

        await bench.send(MoveRelative(distance=100.0))  # limits mean nothing without a reference


@pytest.mark.parametrize("direction", ["forward", "reverse"])
@pytest.mark.parametrize(
    "command",
    [MoveAbsolute(position=13.0), MoveVelocity(velocity=20.0), Track(position=13.0)],
    ids=lambda each: each.verb,
)
async def test_a_position_limit_between_two_counts_is_not_exceeded_by_rounding(command, direction):
    bounds = {"limits": {"position_max": 13.0}, "tracking": {"step": 100.0, "rate": 10.0}}
    async with axis_bench(counts_per_unit=0.2, direction=direction, **bounds) as bench:
        await bench.send(command)
        told = bench.drive.told[0][1]

    assert (told.target_counts if isinstance(told, CountsMotion) else told) == (2 if direction == "forward" else -2)


async def test_an_axis_on_the_last_count_before_a_limit_is_at_it():
    async with axis_bench(counts_per_unit=0.2, limits={"position_max": 13.0}) as bench:
        await bench.settled(position_counts=2)
        with pytest.raises(PositionLimit, match="is at its limit 13"):
            await bench.send(MoveVelocity(velocity=20.0))


@pytest.mark.parametrize("state", ["moving", "disabled", "latched"])
@pytest.mark.parametrize("move", [MoveAbsolute(position=1.0), MoveRelative(distance=1.0), MoveVelocity(velocity=1.0)])
async def test_a_move_needs_an_axis_that_stands_powered_and_unlatched(state, move):
    async with axis_bench() as bench:
        if state == "moving":
            await bench.send(MoveAbsolute(position=10.0))
        elif state == "disabled":
            await bench.send(Power(on=False))
        else:
            await bench.stop()
            await bench.settled()
        bench.drive.told.clear()

        with pytest.raises((WrongState, StopLatched)):
            await bench.send(move)

        assert bench.drive.calls == []


@pytest.mark.parametrize(("velocity", "end"), [(10.0, 40.0), (-10.0, -30.0)])
async def test_a_jog_ends_at_the_limit_ahead_and_without_one_at_its_horizon(velocity, end):
    async with axis_bench(limits={"position_min": -30.0, "position_max": 40.0}, jog_horizon_s=2.0) as bench:
        await bench.settled(position_counts=5000)
        bench.drive.told.clear()
        reply = await bench.send(MoveVelocity(velocity=velocity))
        assert loaded(bench) == CountsMotion(round(end * 1000), 10_000.0, 200_000.0)
        assert reply.velocity == velocity
        assert bench.tracker.status.state is AxisState.CONTINUOUS_MOTION
        await bench.settled(position_counts=5000)
        bench.drive.told.clear()

        put(bench.tracker, referenced=False)
        await bench.send(MoveVelocity(velocity=velocity))
        assert loaded(bench).target_counts == 5000 + round(2 * velocity * 1000)


async def test_a_jog_on_a_drive_that_retargets_takes_another_velocity_in_mid_move():
    async with axis_bench() as bench:
        bench.drive.retargets = True
        await bench.send(MoveVelocity(velocity=10.0))
        await bench.pass_s(0.1, **RUNNING)
        bench.drive.told.clear()

        await bench.send(MoveVelocity(velocity=5.0))
        assert bench.drive.calls == ["load", "start"]
        await bench.stop()
        with pytest.raises(StopLatched):
            await bench.send(MoveVelocity(velocity=5.0))


@pytest.mark.parametrize("position", [3_000_000.0, -3_000_000.0])
async def test_a_target_beyond_the_counter_of_the_drive_is_refused(position):
    async with axis_bench() as bench:
        with pytest.raises(ValueOutOfRange, match="32-bit"):
            await bench.send(MoveAbsolute(position=position))
        await bench.settled(position_counts=-0x7000_0000)
        with pytest.raises(ValueOutOfRange, match="32-bit"):  # the target fits, the way to it does not
            await bench.send(MoveAbsolute(position=0x6000_0000 / 1000))

        assert bench.drive.calls == []


async def test_the_farthest_target_that_fits_is_taken():
    async with axis_bench(counts_per_unit=1, velocity=20_000, acceleration=200_000) as bench:
        await bench.send(MoveAbsolute(position=float(0x7FFF_FFFF)))

        assert loaded(bench).target_counts == 0x7FFF_FFFF


async def test_a_velocity_of_zero_is_no_motion():
    async with axis_bench() as bench:
        with pytest.raises(ValueOutOfRange, match="not a motion"):
            await bench.send(MoveVelocity(velocity=0.0))


async def test_before_the_first_reading_nothing_is_planned():
    async with axis_bench(powered=False) as bench:
        with pytest.raises(WrongState, match="not been read"):
            bench.axis.motion.plans.to(1.0, None, None)


# -- registers ---------------------------------------------------------------------------------------------------------


async def test_a_position_is_given_to_an_axis_that_stands_and_makes_it_referenced():
    async with axis_bench() as bench:
        put(bench.tracker, referenced=False)
        await bench.settled(position_counts=7000)

        reply = await bench.send(SetPosition(position=100.0))

        assert (reply.position, bench.tracker.status.referenced) == (100.0, True)
        assert bench.tracker.status.scale.position(7000) == 100.0
        assert bench.tracker.status.scale.position(8000) == 101.0


@pytest.mark.parametrize("what", ["moving", "lost", "lost meanwhile", "stopped meanwhile"])
async def test_a_position_is_not_given_to_an_axis_that_moves_or_does_not_know_where_it_is(what):
    async with axis_bench() as bench:
        put(bench.tracker, referenced=False)

        async def lose() -> None:
            put(bench.tracker, position_lost=True)

        if what == "moving":
            await bench.send(MoveRelative(distance=10.0))
        elif what == "lost":
            await bench.settled(faults=(replace(LOST, stops=False),))
        else:
            bench.bus.during = bench.stop if what == "stopped meanwhile" else lose

        with pytest.raises((WrongState, StopLatched)):
            await bench.send(SetPosition(position=0.0))

        assert not bench.tracker.status.referenced


async def test_gains_change_one_by_one_and_the_servo_rate_only_at_rest():
    async with axis_bench() as bench:
        await bench.send(SetGains(kp=100))
        await bench.send(SetGains(kd=200))
        assert bench.drive.told[-1][1] == replace(GAINS, kp=100, kd=200)

        await bench.send(MoveAbsolute(position=10.0))
        await bench.send(SetGains(ki=5, sr=1))
        with pytest.raises(WrongState):
            await bench.send(SetGains(sr=2))
        assert bench.drive.calls.count("set_gains") == 3


async def test_gains_that_were_not_taken_are_not_remembered():
    async with axis_bench() as bench:
        bench.drive.during["set_gains"] = raising(ReplyTimeout("no reply"))
        with contextlib.suppress(ReplyTimeout):
            await bench.send(SetGains(kp=100))

        await bench.send(SetGains(kd=200))

        assert bench.drive.told[-1][1] == replace(GAINS, kd=200)


async def test_a_position_error_limit_stays_above_the_tracking_step():
    async with axis_bench(tracking={"step": 0.5, "rate": 50.0}) as bench:
        with pytest.raises(ValueOutOfRange) as refusal:
            await bench.send(SetGains(el=500))
        await bench.send(SetGains(el=501))

    assert refusal.value.nearest == 501
    assert bench.drive.calls == ["set_gains"]


async def test_outputs_are_set_one_by_one():
    async with axis_bench() as bench:
        await bench.send(SetOutputs(limit1=PinMode.HIGH))

    assert bench.drive.told == [("set_outputs", (PinMode.HIGH, None))]


# -- previews ----------------------------------------------------------------------------------------------------------


async def test_a_preview_is_what_the_move_would_do_and_sends_nothing():
    async with axis_bench(limits={"position_max": 100.0}) as bench:
        await bench.settled(position_counts=5000)
        absolute = bench.axis.preview(Preview(position=10.0, velocity=5.0), ())
        relative = bench.axis.preview(Preview(distance=5.0), ("a stop is latched",))
        jog = bench.axis.preview(Preview(velocity=-5.0), ())
        refused = bench.axis.preview(Preview(position=101.0), ())
        with pytest.raises(MalformedRequest):
            bench.axis.preview(Preview(position=1.0, distance=1.0), ())

    assert (absolute.position, absolute.velocity, absolute.velocity_error) == (10.0, 5.0, 0.0)
    assert absolute.acceleration == 200.0
    assert absolute.duration_s == pytest.approx(5.0 / 5.0 + 5.0 / 200.0)
    assert (relative.position, relative.obstacles) == (10.0, ("a stop is latched",))
    assert (jog.position, jog.velocity, jog.duration_s) == (None, -5.0, None)
    assert refused.refusal.code == "position_limit"
    assert bench.drive.calls == []


async def test_a_preview_of_another_velocity_in_mid_move_is_what_the_drive_would_be_told(monkeypatch):
    legs: list[CountsMotion] = []

    def kept(motions, *_):
        legs.extend(motions)
        return ()

    async with axis_bench() as bench:
        bench.drive.retargets = True
        await bench.send(MoveVelocity(velocity=10.0))
        await bench.pass_s(0.1, **RUNNING)
        bench.drive.told.clear()
        monkeypatch.setattr(bench.drive, "exchanges", kept)
        bench.axis.preview(Preview(velocity=5.0), ())
        await bench.send(MoveVelocity(velocity=5.0))

        assert legs == [loaded(bench)]


async def test_a_limit_in_force_is_the_one_of_the_latest_configuration():
    async with axis_bench(limits={"position_max": 100.0}) as bench:
        limits = bench.axis.config.limits.model_copy(update={"position_max": 5.0})
        bench.axis.reconfigure(bench.axis.config.model_copy(update={"limits": limits, "velocity": 1.0}))
        with pytest.raises(PositionLimit):
            await bench.send(MoveAbsolute(position=10.0))
        await bench.send(MoveAbsolute(position=4.0))

    assert loaded(bench).velocity_counts_per_s == 1000.0


async def test_an_unknown_outcome_of_a_start_keeps_the_command_and_a_stop_ends_it():
    async with axis_bench() as bench:
        bench.drive.during["start"] = raising(OutcomeUnknown("no reply"))
        with contextlib.suppress(OutcomeUnknown):
            await bench.send(MoveAbsolute(position=10.0), "first")
        assert bench.tracker.status.command.command_id == "first"

        await bench.stop()

        assert bench.ended[-1][:2] == ("first", CommandStatus.ABORTED)


@pytest.mark.parametrize("error", [LeaseExpired("not renewed"), ReplyTimeout("no answer")], ids=["refused", "lost"])
async def test_an_aborting_move_that_is_not_started_in_mid_move_brings_the_one_before_to_rest(error):
    async with axis_bench() as bench:
        bench.drive.retargets = True
        await bench.send(MoveAbsolute(position=10.0), "first")
        await bench.pass_s(0.1, **RUNNING)
        bench.drive.told.clear()
        bench.drive.during["start"] = raising(error)
        then = MoveAbsolute(position=20.0, buffer_mode="aborting")

        with pytest.raises(type(error)):
            await bench.axis.succession.carry_out(
                then, bench.axis.permit("second", Verb.MOVE_ABSOLUTE), lambda: bench.send(then, "second")
            )
        state, told = bench.tracker.status.state, bench.drive.calls
        await bench.settled(enabled=True)

        assert told == ["load", "start", "stop"]
        assert state is AxisState.STOPPING
        assert bench.tracker.status.state is AxisState.STANDSTILL
        assert bench.ended == [
            ("first", CommandStatus.ABORTED, "aborted by move_absolute"),
            ("second", CommandStatus.FAILED, error.message),
        ]
