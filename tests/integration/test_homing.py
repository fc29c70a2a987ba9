"""Homing of every dialect: each capture source, each way to stop, each way to fail, on the jumping clock."""

import asyncio
import contextlib
from dataclasses import replace

import pytest
from typing_extensions import override

from ldcnd.contract.commands import Halt, Home, HomeMethod, HomeStop, MoveAbsolute, Probe, SetOutputs, SetPosition
from ldcnd.contract.errors import BusError, MalformedRequest, NotSupported, PositionLimit, VelocityLimit
from ldcnd.contract.samples import AxisState, InputsSample, PositionSample, StateSample, TelemetryItem
from ldcnd.drives.ldcn.access import ServoAccess
from ldcnd.drives.ldcn.packet import StatusItem
from ldcnd.drives.ldcn.profiles import HomingControl
from ldcnd.drives.ldcn.received import LoadTrajectory
from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, FaultyReply, FaultyRequest, LineFault
from ldcnd.sim.ldcn.servo import ServoLoop
from tests.support.dialect_rig import (
    AXIS,
    DIALECTS,
    GAINS,
    LS_173AP,
    LS_182AP,
    LS_182AP_22,
    PLANT,
    SC,
    V1,
    V2,
    V3,
    V4,
    DialectRig,
    dialect_rig,
)

PIC_SERVOS = (V1, V2, V3, V4, SC)
LIMITS = (*PIC_SERVOS, LS_182AP, LS_182AP_22)
WIDE_INDEX = PLANT.model_copy(update={"index_width_counts": 40})
HARD_STOP = PLANT.model_copy(update={"stop_margin_counts": 500})


def named(dialects):
    return pytest.mark.parametrize("dialect", dialects, ids=lambda dialect: dialect.name)


async def published_position(rig: DialectRig) -> float:
    async with rig.rig.client.samples(AXIS, TelemetryItem.POSITION) as positions:
        _, sample = await anext(positions)
    assert isinstance(sample, PositionSample)
    return sample.value


async def offset(rig: DialectRig) -> float:
    """Return how much more the daemon says than the shaft's true position, once the axis has settled."""
    await asyncio.sleep(1.0)  # virtual
    return await published_position(rig) - rig.position_mm


@named([LS_182AP, SC])
@pytest.mark.parametrize("command", [Home(method=HomeMethod.REVERSE_LIMIT, velocity=-5.0), SetPosition(position=50.0)])
async def test_no_position_of_before_is_the_last_one_once_the_place_is_known(dialect, command):
    async with dialect_rig(dialect, rates={"position": 0.5, "state": 20.0}) as rig:
        await rig.power_on()
        last, known, inputs_at = None, [], []
        async with rig.rig.client.samples(AXIS) as samples:
            await rig.send(command)
            async with asyncio.timeout(120):
                while len(known) < 3:
                    _, sample = await anext(samples)
                    if isinstance(sample, PositionSample):
                        last = sample
                    elif isinstance(sample, InputsSample):
                        inputs_at.append(sample.t)
                    elif isinstance(sample, StateSample) and sample.referenced and last:
                        known.append(last)
        await asyncio.sleep(3.0)
        now = await rig.rig.client.position(AXIS)

    origins = {round(each.counts / 1000.0 - each.value, 3) for each in (*known, now)}
    assert len(origins) == 1
    assert inputs_at == sorted(inputs_at)


@named(LIMITS)
@pytest.mark.parametrize(("method", "velocity"), [(HomeMethod.REVERSE_LIMIT, -5.0), (HomeMethod.FORWARD_LIMIT, 5.0)])
@pytest.mark.sweep(4)
async def test_a_limit_switch_marks_the_reference(dialect, method, velocity):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()

        state = await rig.done(Home(method=method, velocity=velocity, position=100.0))

        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)
        switch_mm = 20.0 if velocity > 0 else -20.0
        assert await offset(rig) == pytest.approx(100.0 - switch_mm, abs=0.02)


@named(DIALECTS)
@pytest.mark.sweep(2)
async def test_the_index_marks_the_reference(dialect):
    async with dialect_rig(dialect, WIDE_INDEX) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="index", velocity=1.0, position=7.0))

        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)
        assert await offset(rig) == pytest.approx(7.0 - 0.7, abs=0.005)


@named(DIALECTS)
@pytest.mark.sweep(3)
async def test_an_excess_position_error_at_a_hard_stop_marks_the_reference(dialect):
    async with dialect_rig(dialect, HARD_STOP, gains=GAINS | {"el": 800, "ol": 120}) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="position_error", velocity=5.0, position=50.0))

        assert (state.state, state.referenced, state.enabled, state.last_error) == (
            AxisState.STANDSTILL,
            True,
            True,
            None,
        )
        assert await offset(rig) == pytest.approx(50.0 - 20.5, abs=0.05)
        assert (await rig.until_fault(lambda faults: not faults.active)).active == ()


@named(PIC_SERVOS)
@pytest.mark.sweep(2)
async def test_current_limiting_at_a_hard_stop_marks_the_reference(dialect):
    async with dialect_rig(dialect, HARD_STOP, gains=GAINS | {"cl": 101, "el": 16_000}) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="current", velocity=5.0, acceleration=50.0, position=50.0, stop="abrupt"))

        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)
        assert await offset(rig) == pytest.approx(50.0 - 20.5, abs=0.1)


@named((LS_173AP,))
async def test_a_drive_without_limit_capture_refuses_it(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()

        with pytest.raises(NotSupported, match="it can on index, position_error"):
            await rig.send(Home(method="forward_limit", velocity=5.0))


@named((V1, V2, V3, LS_182AP))
@pytest.mark.parametrize("stop", [HomeStop.SMOOTH, HomeStop.ABRUPT])
@pytest.mark.sweep(2)
async def test_the_motor_stops_and_holds_at_home(dialect, stop):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="forward_limit", velocity=10.0, stop=stop))

        assert (state.state, state.enabled) == (AxisState.STANDSTILL, True)
        assert rig.drive.loop.servo_on


@named((V1, V3, LS_182AP, LS_182AP_22))
@pytest.mark.sweep(2)
async def test_the_loop_can_be_opened_at_home(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="forward_limit", velocity=10.0, stop="off", position=3.0))

        assert (state.state, state.enabled, state.referenced, state.last_error) == (
            AxisState.DISABLED,
            False,
            True,
            None,
        )
        assert not rig.drive.loop.servo_on
        assert await offset(rig) == pytest.approx(3.0 - 20.0, abs=0.03)


@named((V2, V3, LS_182AP, LS_182AP_22))
@pytest.mark.sweep(2)
async def test_an_axis_that_stands_on_its_switch_moves_off_it_first(dialect):
    async with dialect_rig(dialect, start_counts=-20_500.0) as rig:
        await rig.power_on()
        assert rig.drive.shaft.on_reverse_limit

        state = await rig.done(Home(method="reverse_limit", velocity=-5.0, position=0.0))

        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)
        assert await offset(rig) == pytest.approx(20.0, abs=0.02)


async def test_moving_off_a_switch_that_never_releases_is_bounded():
    stuck = PLANT.model_copy(update={"reverse_limit_counts": 15_000, "stop_margin_counts": 30_000})
    async with dialect_rig(V4, stuck) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="reverse_limit", velocity=-5.0, distance=4.0))

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, "home: no reverse_limit within 4 mm")
        await asyncio.sleep(1.0)  # virtual
        assert rig.position_mm == pytest.approx(4.0, abs=0.01)


async def test_a_switch_that_is_active_low_is_recognised():
    home = {"method": "reverse_limit", "velocity": -5.0, "switch_active": "low"}
    async with dialect_rig(V4, home=home) as rig:  # the input is low all over the travel: "on the switch" everywhere
        await rig.power_on()

        await rig.send(Home(timeout_s=2.0))
        await asyncio.sleep(0.5)

        assert rig.position_mm > 0.5  # it moves off, not on


async def test_home_can_move_on_to_a_position():
    async with dialect_rig(LS_182AP_22) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="forward_limit", velocity=5.0, position=20.0, move_to=12.5))

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        await asyncio.sleep(1.0)  # virtual
        assert rig.position_mm == pytest.approx(12.5, abs=0.02)


async def test_the_axis_is_homing_from_the_first_leg_to_the_last():
    seen = []
    async with dialect_rig(LS_182AP, start_counts=-20_500.0) as rig:
        await rig.power_on()
        async with rig.rig.client.samples(AXIS, TelemetryItem.STATE) as states:
            await rig.done(Home(method="reverse_limit", velocity=-5.0, position=0.0, move_to=5.0))
            async with asyncio.timeout(60):
                while not seen or seen[-1] is not AxisState.STANDSTILL or AxisState.HOMING not in seen:
                    seen.append((await anext(states))[1].state)

    assert set(seen[seen.index(AxisState.HOMING) : -1]) == {AxisState.HOMING}


@named((V4, SC, LS_182AP))
@pytest.mark.parametrize(("velocity", "nearest"), [(20.0, 1.464843), (-2.0, -1.464843)])
async def test_a_search_that_the_index_pulse_can_slip_through_is_refused_with_the_nearest_velocity(
    dialect, velocity, nearest
):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()

        with pytest.raises(VelocityLimit, match="can miss an index pulse of 1 counts") as refusal:
            await rig.send(Home(method="index", velocity=velocity))

        assert refusal.value.nearest == pytest.approx(nearest, abs=1e-5)
        assert rig.position_mm == 0.0


@pytest.mark.parametrize("index_at_counts", [700, 701, 702, 703, 704])
@pytest.mark.sweep(2)
async def test_at_the_nearest_velocity_no_index_pulse_is_missed(index_at_counts):
    narrow = PLANT.model_copy(update={"index_width_counts": 1, "index_at_counts": index_at_counts})
    async with dialect_rig(LS_182AP, narrow) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="index", velocity=1.4648, position=0.0))

        assert (state.referenced, state.last_error) == (True, None)
        assert await offset(rig) == pytest.approx(-index_at_counts / 1000, abs=0.004)


async def test_a_wider_index_pulse_may_be_searched_for_faster():
    home = {"method": "index", "velocity": 20.0, "index_width": 40}
    async with dialect_rig(LS_182AP, WIDE_INDEX, home=home) as rig:
        await rig.power_on()

        assert (await rig.done(Home())).referenced


@named((V1, V4, LS_182AP))
@pytest.mark.sweep(2)
async def test_a_switch_is_found_fast_and_taken_over_slowly(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        began_s = asyncio.get_running_loop().time()

        state = await rig.done(Home(method="forward_limit", velocity=0.5, find_velocity=10.0, position=100.0))
        took_s = asyncio.get_running_loop().time() - began_s

        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)
        assert await offset(rig) == pytest.approx(80.0, abs=0.002)
        assert took_s < 20.0 / 0.5 / 2


@named((V1, V4, SC, LS_182AP))
@pytest.mark.parametrize("timeout_s", [2.32, 2.45, 2.6])
@pytest.mark.sweep(3)
async def test_a_search_whose_time_is_over_while_it_brakes_on_its_switch_goes_on_once_it_rests(
    dialect, timeout_s, monkeypatch
):
    """It is there after 2.25 s, and brakes for 0.5 s."""
    roomy = PLANT.model_copy(update={"stop_margin_counts": 6000})
    async with dialect_rig(dialect, roomy, acceleration=20) as rig:
        await rig.power_on()
        execute, in_mid_move = rig.drive.execute, []

        def take(command):
            if isinstance(command, LoadTrajectory) and not rig.drive.loop.trajectory.done:
                in_mid_move.append(command)
            execute(command)

        monkeypatch.setattr(rig.drive, "execute", take)
        search = Home(method="forward_limit", velocity=5.0, find_velocity=10.0, timeout_s=timeout_s)
        state = await rig.done(search)

        assert in_mid_move == []
        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)


async def test_a_search_ends_at_its_distance():
    async with dialect_rig(V4) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="forward_limit", velocity=5.0, distance=3.0))

        assert (state.state, state.referenced) == (AxisState.STANDSTILL, False)
        assert state.last_error == "home: no forward_limit within 3 mm"
        await asyncio.sleep(1.0)  # virtual
        assert rig.position_mm == pytest.approx(3.0, abs=0.01)


@named((V1, LS_182AP))
@pytest.mark.sweep(2)
async def test_a_search_ends_at_its_time_out(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        loop = asyncio.get_running_loop()
        began_s = loop.time()

        state = await rig.done(Home(method="forward_limit", velocity=1.0, timeout_s=3.0))

        assert state.last_error == "home: no forward_limit within 3 s"
        assert 3.0 < loop.time() - began_s < 3.5


@named((V1, V4, LS_182AP))
async def test_halt_cancels_a_search_and_disarms_the_drive(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        reply = await rig.send(Home(method="forward_limit", velocity=5.0))
        await asyncio.sleep(1.0)
        assert rig.drive.loop.search is not None

        state = await rig.done(Halt())

        assert state.state is AxisState.STANDSTILL
        assert state.last_error == "home: aborted by halt"
        assert not state.referenced
        assert rig.drive.loop.search is None
        assert (await rig.rig.client.wait_for_end(AXIS, reply.command_id)).state is AxisState.STANDSTILL


async def test_a_stop_ends_a_search_for_good():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        await rig.send(Home(method="forward_limit", velocity=5.0, move_to=0.0))
        await asyncio.sleep(1.0)

        await rig.rig.client.stop(AXIS)
        await asyncio.sleep(5.0)

        state = await rig.until(lambda state: state.state is AxisState.STANDSTILL)
        assert (state.stop_latched, state.referenced) == (True, False)
        assert rig.position_mm < 6.0
        assert rig.drive.loop.search is None


@pytest.mark.parametrize("rate", [600, 1000])
@pytest.mark.sweep(2)
async def test_polls_between_the_packets_of_a_command_do_not_disturb_it(rate):
    rates = {"position": rate, "velocity": rate, "state": rate}
    async with dialect_rig(V2, start_counts=-20_500.0, rates=rates) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="reverse_limit", velocity=-5.0, move_to=1.0))

        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)
        assert await offset(rig) == pytest.approx(20.0, abs=0.02)


@named((V2, LS_182AP_22))
@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.sweep(3)
async def test_on_a_bad_line_a_search_ends_with_the_right_reference_or_with_a_reason(dialect, seed):
    print("seed", seed)
    bad_line = FaultPlan((LineFault(FaultKind.REPLY_LOST, 0.1, from_s=5.0),), seed=seed)
    async with dialect_rig(dialect, faults=bad_line, start_counts=-20_500.0) as rig:
        await rig.power_on()
        await asyncio.sleep(5.0 - asyncio.get_running_loop().time())

        with contextlib.suppress(BusError):
            await rig.send(Home(method="reverse_limit", velocity=-5.0, timeout_s=10, move_to=1.0))
        await asyncio.sleep(0.1)
        state = await rig.until(lambda state: state.command is None and state.state is not AxisState.DISCRETE_MOTION)

        if state.referenced and state.last_error is None:
            assert await offset(rig) == pytest.approx(20.0, abs=0.02)
            assert rig.position_mm == pytest.approx(-19.0, abs=0.02)
        else:
            assert state.last_error is not None
        assert rig.drive.loop.search is None or state.state is AxisState.ERROR_STOP


class _LostDisarming(FaultInjector):
    """Loses the replies to the first packets that disarm a capture, which the drive obeys."""

    def __init__(self, lost: int) -> None:
        super().__init__(FaultPlan())
        self._left = lost
        self._loses = False

    @override
    def request(self, data: bytes, at_s: float) -> FaultyRequest:
        self._loses = self._left > 0 and data[-5:-1] == b"\xaa\x01\x19\x00"
        self._left -= self._loses
        return super().request(data, at_s)

    @override
    def reply(self, data: bytes, at_s: float) -> FaultyReply:
        return FaultyReply(b"") if self._loses else super().reply(data, at_s)


@named((LS_182AP, V2, SC))
@pytest.mark.parametrize("lost", [1, 3, 6])
@pytest.mark.parametrize("command", ["home", "probe"])
async def test_a_search_that_finds_nothing_fails_although_its_disarming_is_not_acknowledged(dialect, lost, command):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        if command == "probe":
            await rig.send(SetPosition(position=0.0))
        rig.chain.injector = _LostDisarming(lost)

        await rig.send(
            Home(method="forward_limit", velocity=5.0, distance=2.0)
            if command == "home"
            else Probe(distance=2.0, velocity=5.0, sources=("forward_limit",))
        )
        state = await rig.until(lambda state: state.command is None)

    assert state.referenced is (command == "probe")
    assert (
        state.last_error
        == {
            "home": "home: no forward_limit within 2 mm",
            "probe": "probe: no input came on the way",
        }[command]
    )


@pytest.mark.promise("motions-without-end")
async def test_every_search_ends_in_the_drive_even_without_a_host():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()

        await rig.send(Home(method="index", velocity=1.0, timeout_s=5.0))

        assert rig.drive.loop.trajectory.mode == "trapezoidal"


async def test_the_stop_is_left_to_the_drive_wherever_it_can():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()

        await rig.send(Home(method="forward_limit", velocity=5.0, stop="abrupt"))

        assert rig.drive.loop.search.control == HomingControl.LIMIT2 | HomingControl.STOP_ABRUPT


async def test_the_lock_after_homing_on_a_limit_is_lifted_by_the_next_move():
    async with dialect_rig(LS_182AP_22) as rig:
        await rig.power_on()
        await rig.done(Home(method="forward_limit", velocity=5.0, position=20.0))
        assert rig.drive._locked

        await rig.done(MoveAbsolute(position=10.0))

        await asyncio.sleep(1.0)  # virtual
        assert rig.position_mm == pytest.approx(10.0, abs=0.02)


async def test_homing_on_a_pin_that_is_an_output_is_refused():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        await rig.send(SetOutputs(limit2="high"))

        with pytest.raises(Exception, match="the forward_limit pin is an output"):
            await rig.send(Home(method="forward_limit", velocity=5.0))

        assert rig.drive.loop.search is None


async def test_opening_the_loop_and_moving_on_exclude_each_other():
    async with dialect_rig(V4) as rig:
        await rig.power_on()

        with pytest.raises(MalformedRequest, match="both open the loop and move"):
            await rig.send(Home(method="index", velocity=1.0, stop="off", move_to=1.0))


async def test_moving_on_beyond_a_software_limit_is_refused_before_the_search():
    async with dialect_rig(V4, limits={"position_max": 10}) as rig:
        await rig.power_on()

        with pytest.raises(PositionLimit):
            await rig.send(Home(method="index", velocity=1.0, move_to=11.0))

        assert rig.position_mm == pytest.approx(0.0, abs=0.02)


# -- what a search takes for its mark ----------------------------------------------------------------------------------


async def test_a_search_whose_time_is_over_before_its_first_reading_has_found_nothing():
    async with dialect_rig(LS_182AP, rates={"position": 0.5, "velocity": 0.5, "state": 0.5}) as rig:
        await rig.power_on()
        await asyncio.sleep(3.0)

        state = await rig.done(Home(method="index", velocity=1.0, timeout_s=0.05))

        assert (state.referenced, state.last_error) == (False, "home: no index within 0.05 s")


@named((V4, LS_182AP))
@pytest.mark.parametrize("stop", ["smooth", "off"])
async def test_a_captured_position_that_the_search_has_not_passed_is_no_mark(dialect, stop, monkeypatch):
    capture = ServoLoop._capture

    def elsewhere(loop, search):
        capture(loop, search)
        loop.home += 50_000

    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        monkeypatch.setattr(ServoLoop, "_capture", elsewhere)

        state = await rig.done(Home(method="forward_limit", velocity=5.0, stop=stop))

        assert (state.referenced, state.enabled) == (False, stop == "smooth")
        assert "not on the way" in state.last_error


@named((V4, LS_182AP))
@pytest.mark.parametrize(("falsified", "found"), [(1, True), (2, True), (20, False)])
@pytest.mark.parametrize("stop", ["smooth", "off"])
async def test_a_captured_position_is_believed_once_two_replies_agree(dialect, falsified, found, stop, monkeypatch):
    read, left = ServoAccess.read, [falsified]

    async def noisy(access, items):
        status = await read(access, items)
        if items is not StatusItem.HOME or not left[0]:
            return status
        left[0] -= 1
        return replace(status, home=status.home - 1000 * (left[0] + 1))

    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        monkeypatch.setattr(ServoAccess, "read", noisy)

        state = await rig.done(Home(method="forward_limit", velocity=5.0, position=100.0, stop=stop))

        assert (state.referenced, state.enabled) == (found, stop == "smooth")
        if found:
            assert await offset(rig) == pytest.approx(80.0, abs=0.02)
        else:
            assert "contradict each other" in state.last_error
