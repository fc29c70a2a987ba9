"""Rotary axes: positions that repeat, the way to turn, and no end at the range of the drive's counter."""

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from pydantic import ValidationError

from ldcnd.client.rig import Rig
from ldcnd.client.traces import arm_trace, fetch_trace, wait_for_trace
from ldcnd.contract.commands import Direction, Home, MoveAbsolute, MoveRelative, MoveVelocity, SetPosition, Track
from ldcnd.contract.errors import NotSupported, OutcomeUnknown, ValueOutOfRange, WrongState
from ldcnd.contract.questions import Preview
from ldcnd.contract.samples import AxisState, PositionSample, TelemetryItem
from ldcnd.contract.traces import TakeTrace, TraceTrigger, TriggerKind
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.sim.plant import MotorPlant
from tests.integration.test_turning_in_mid_move import BEYOND_MM, places_mm, turned_back_mm
from tests.support.dialect_rig import AXIS, LS_182AP, SC, V1, V4, DialectRig, adopting_rig, dialect_rig

ENDLESS = MotorPlant(reverse_limit_counts=-(2**40), forward_limit_counts=2**40, index_at_counts=2**30)
ROTARY = {"modulo": 10.0, "home": {"method": "index", "velocity": 1.0}}
NEAR_END = 2**31 - 5_000
WAYS = Direction


async def position(rig: DialectRig) -> PositionSample:
    async with asyncio.timeout(5.0), rig.rig.client.samples(AXIS, TelemetryItem.POSITION) as samples:
        _, sample = await anext(samples)
    assert isinstance(sample, PositionSample)
    return sample


@asynccontextmanager
async def near_the_end(dialect, side: int = 1, **axis: object) -> AsyncIterator[DialectRig]:
    """Run a daemon on an axis that has turned in one direction for long: its counter is near the end."""
    async with dialect_rig(dialect, ENDLESS, **axis) as before:
        before.drive.loop.renumber(side * NEAR_END)
    async with adopting_rig(dialect, before, **axis) as rig:
        await rig.power_on()
        await rig.send(SetPosition(position=4.0))
        yield rig


@pytest.mark.parametrize(
    ("start", "target", "direction", "ends_at"),
    [
        (1.0, 4.0, None, 4.0),
        (1.0, 9.0, None, -1.0),
        (1.0, 9.0, WAYS.POSITIVE, 9.0),
        (1.0, 4.0, WAYS.NEGATIVE, -6.0),
        (9.0, 1.0, WAYS.SHORTEST_WAY, 11.0),
        (2.0, 32.0, WAYS.POSITIVE, 2.0),
        (2.0, -3.0, WAYS.SHORTEST_WAY, 7.0),
    ],
)
@pytest.mark.sweep(2)
async def test_an_axis_turns_the_shortest_way_or_as_it_is_told(start, target, direction, ends_at):
    async with dialect_rig(V4, ENDLESS, **ROTARY) as rig:
        await rig.power_on()
        await rig.done(MoveRelative(distance=start))

        reply = await rig.send(MoveAbsolute(position=target, direction=direction))
        state = await rig.rig.client.wait_for_end(AXIS, reply.command_id)
        sample = await position(rig)

        assert state.last_error is None
        assert rig.position_mm == pytest.approx(ends_at, abs=0.05)
        assert reply.position == pytest.approx(ends_at % 10.0, abs=0.001)
        assert sample.turns * 10.0 + sample.value == pytest.approx(ends_at, abs=0.05)
        assert 0.0 <= sample.value < 10.0


@pytest.mark.parametrize("target", range(0, 10, 2))
@pytest.mark.parametrize("velocity", [40.0, -40.0])
@pytest.mark.sweep(2)
async def test_an_axis_that_turns_goes_on_to_a_position_from_where_it_can_stand(velocity, target):
    """It needs four turns to brake: a turn that lies behind the shaft would be gone back to, through all of them."""
    async with dialect_rig(SC, ENDLESS, **ROTARY) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=velocity, acceleration=400.0))
        await asyncio.sleep(0.5)
        to = MoveAbsolute(position=target, velocity=40.0, acceleration=20.0, buffer_mode="aborting")
        reply = await rig.send(to)
        places = await places_mm(rig, 5.0)
        state = await rig.rig.client.wait_for_end(AXIS, reply.command_id)

    assert state.last_error is None
    assert turned_back_mm([place * math.copysign(1, velocity) for place in places]) < 5.0 + BEYOND_MM
    assert math.remainder(rig.position_mm - target, 10.0) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(
    ("first", "way", "then", "direction", "ends_at"),
    [
        (9.7, "positive", 8.0, "positive", 8.0),
        (9.7, "positive", 8.0, "negative", -2.0),
        (9.7, "positive", 8.0, "shortest_way", -2.0),
        (9.7, "positive", 8.0, None, -2.0),
        (9.7, "positive", 4.0, None, 4.0),
        (9.7, "positive", 9.7, None, 9.7),
        (9.7, "positive", 9.7, "positive", 9.7),
        (9.7, "positive", 9.7, "negative", -0.3),
        (0.3, "negative", 2.0, "negative", -8.0),
        (0.3, "negative", 2.0, "positive", 2.0),
        (0.3, "negative", 2.0, None, 2.0),
        (0.3, "negative", 0.3, "positive", 0.3),
        (0.3, "negative", 0.3, "shortest_way", -9.7),
    ],
)
@pytest.mark.sweep(4)
async def test_a_move_in_mid_move_counts_from_where_the_axis_can_stand_and_not_from_the_goal_before(
    first, way, then, direction, ends_at
):
    async with dialect_rig(SC, ENDLESS, **ROTARY) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=first, velocity=1.4, acceleration=14.0, direction=way))
        await asyncio.sleep(0.3)
        to = MoveAbsolute(position=then, velocity=3.0, acceleration=14.0, direction=direction, buffer_mode="aborting")
        reply = await rig.send(to)
        state = await rig.rig.client.wait_for_end(AXIS, reply.command_id)

    assert state.last_error is None
    assert rig.position_mm == pytest.approx(ends_at, abs=0.05)


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("ahead", [0.2, 0.4, 0.7, 1.0, 1.5])
@pytest.mark.sweep(3)
async def test_a_goal_that_lies_ahead_of_where_the_axis_can_stand_is_no_turn_away(way, ahead):
    """It needs 0.08 mm to brake, and covers 0.2 mm while it is told."""
    async with dialect_rig(SC, ENDLESS, **ROTARY) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=2.0 * way, acceleration=25.0))
        await asyncio.sleep(0.5)
        begun = rig.position_mm
        direction = WAYS.POSITIVE if way > 0 else WAYS.NEGATIVE
        goal = {"position": (begun + way * ahead) % 10.0, "direction": direction, "acceleration": 25.0}
        reply = await rig.send(MoveAbsolute(**goal, velocity=2.0, buffer_mode="aborting"))
        await rig.rig.client.wait_for_end(AXIS, reply.command_id)

    assert way * (rig.position_mm - begun) == pytest.approx(ahead, abs=0.05)


@pytest.mark.parametrize("left_s", [0.35, 0.2, 0.1, 0.05])
async def test_a_goal_that_is_sent_again_while_the_axis_brakes_for_it_is_no_turn_more(left_s):
    async with dialect_rig(SC, ENDLESS, **ROTARY) as rig:
        await rig.power_on()
        to = MoveAbsolute(position=4.0, velocity=2.0, acceleration=4.0, direction="positive", buffer_mode="aborting")
        begun = await rig.send(to)
        await asyncio.sleep(begun.duration_s - left_s)
        reply = await rig.send(to)
        await rig.rig.client.wait_for_end(AXIS, reply.command_id)

    assert rig.position_mm == pytest.approx(4.0, abs=0.05)


async def test_a_motion_at_a_velocity_has_no_end_within_a_turn():
    async with dialect_rig(V4, ENDLESS, **ROTARY) as rig:
        await rig.power_on()
        planned = await rig.rig.client.ask(Preview(velocity=4.0), AXIS)
        reply = await rig.send(MoveVelocity(velocity=4.0))
        state = await rig.rig.client.state(AXIS)

    assert planned.position is None
    assert planned.ends == reply.ends == "runs until it is stopped, for at most 60 s unless it is sent again"
    assert state.command.verb == "move_velocity"
    assert state.command.target is None


async def test_a_position_where_the_axis_is_told_to_be_is_no_turn():
    async with dialect_rig(V4, ENDLESS, **ROTARY) as rig:
        await rig.power_on()
        await rig.done(MoveAbsolute(position=3.3333))

        for direction in WAYS:
            await rig.done(MoveAbsolute(position=3.3333, direction=direction))

        assert rig.position_mm == pytest.approx(3.333, abs=0.005)


async def test_a_position_of_which_no_count_tells_where_in_a_turn_it_is_is_refused():
    async with dialect_rig(V4, ENDLESS, **ROTARY) as rig:
        await rig.power_on()
        for far in (-1e17, 1e300):
            with pytest.raises(ValueOutOfRange) as refused:
                await rig.send(MoveAbsolute(position=far))
        assert rig.position_mm == pytest.approx(0.0, abs=0.005)
        await rig.done(MoveAbsolute(position=refused.value.nearest))

        assert (await position(rig)).value == pytest.approx(refused.value.nearest % 10.0, abs=0.02)


async def test_set_points_are_followed_through_the_turn():
    async with dialect_rig(V4, ENDLESS, **ROTARY, tracking={"step": 0.5, "rate": 50}) as rig:
        await rig.power_on()
        for at in (9.8, 9.6, 9.9, 0.1, 0.3):
            await rig.send(Track(position=at))
            await asyncio.sleep(0.05)
        await asyncio.sleep(0.2)  # the shaft follows

        assert rig.position_mm == pytest.approx(0.3, abs=0.02)


async def test_a_trace_waits_for_a_place_in_any_turn_and_a_client_reads_no_way_that_is_left_within_one():
    async with dialect_rig(V4, ENDLESS, **ROTARY) as rig:
        await rig.power_on()
        await rig.done(MoveRelative(distance=28.0))  # two turns behind it, at 8 within the third
        wanted = TraceTrigger(channel="position", kind=TriggerKind.RISING, level=9.0)
        request = TakeTrace(channels=("position",), samples=20, trigger=wanted)
        armed = await arm_trace(rig.rig.client, AXIS, request)
        async with Rig(rig.rig.client, await rig.rig.client.daemon()).control(AXIS, client="ann") as axis:
            await axis.power(on=True)
            move = await axis.move_absolute(2.0)
            left = {step.left async for step in move}
            await move.done()
        await wait_for_trace(rig.rig.client, AXIS, armed.trace_id, 20.0)
        taken = await fetch_trace(rig.rig.client, AXIS)

    assert taken.values[0][0] == pytest.approx(29.0, abs=0.3)
    assert left == {None}


@pytest.mark.parametrize("dialect", [V1, V4, SC, LS_182AP], ids=lambda dialect: dialect.name)
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.sweep(3)
async def test_at_the_end_of_its_counter_an_axis_goes_on(dialect, side):
    async with near_the_end(dialect, side, modulo=10.0) as rig:
        before = rig.position_mm
        for _ in range(3):
            state = await rig.done(MoveRelative(distance=20.0 * side))
            assert (state.state, state.last_error, state.referenced) == (AxisState.STANDSTILL, None, True)

        sample = await position(rig)
        assert rig.position_mm - before == pytest.approx(60.0 * side, abs=0.02)
        assert sample.turns * 10.0 + sample.value == pytest.approx(4.0 + 60.0 * side, abs=0.02)
        assert abs(rig.drive.loop.position) < 2**31 - 1
        assert abs(sample.counts) > 2**31


async def test_a_jog_at_the_end_of_the_counter_goes_on():
    async with near_the_end(LS_182AP, jog_horizon_s=5.0) as rig:
        state = await rig.done(MoveVelocity(velocity=10.0))

        assert state.last_error is None
        assert (await position(rig)).counts == pytest.approx(NEAR_END + 50_000, abs=100)


async def test_a_jog_that_is_changed_on_its_way_does_not_run_through_the_counter():
    async with near_the_end(LS_182AP, jog_horizon_s=0.3) as rig:
        await rig.send(MoveVelocity(velocity=5.0))
        await rig.send(MoveVelocity(velocity=10.0))
        async with asyncio.timeout(5.0):
            state = await rig.until(lambda state: state.state is AxisState.STANDSTILL)

        assert state.referenced


async def test_homing_near_the_end_of_the_counter_takes_the_reference_over():
    plant = ENDLESS.model_copy(update={"index_at_counts": 6_000, "index_spacing_counts": 2**31})
    async with dialect_rig(LS_182AP, plant) as before:
        before.drive.loop.renumber(NEAR_END)
    async with adopting_rig(LS_182AP, before) as rig:
        await rig.power_on()
        state = await rig.done(Home(method="index", velocity=1.0, position=2.0))

        sample = await position(rig)
        assert (state.last_error, state.referenced) == (None, True)
        assert sample.value == pytest.approx(2.0 + rig.position_mm - 6.0, abs=0.005)


async def test_a_lost_acknowledgement_of_the_counter_leaves_no_wrong_position(monkeypatch):
    async with near_the_end(V4, modulo=10.0) as rig:
        bus = rig.rig.daemon.rig.buses[0].bus
        execute = bus.execute

        async def lose(exchange, *lanes, **options):
            reply = await execute(exchange, *lanes, **options)
            if exchange.request[2] & 0x0F == CommandCode.RESET_POSITION:
                raise OutcomeUnknown("the reply was lost")
            return reply

        monkeypatch.setattr(bus, "execute", lose)
        state = await rig.done(MoveRelative(distance=20.0))

        assert (state.last_error, state.referenced) == (None, True)
        assert (await position(rig)).value == pytest.approx(4.0, abs=0.02)


async def test_an_sc_in_mid_move_is_not_set_back():
    async with near_the_end(SC) as rig:
        await rig.send(MoveRelative(distance=4.0, velocity=1.0))
        await asyncio.sleep(0.3)

        with pytest.raises(WrongState, match="beyond the drive's 32-bit counter"):
            await rig.send(MoveRelative(distance=50.0, buffer_mode="aborting"))


@pytest.mark.parametrize(("scale", "modulo"), [("10000/360", 360.0), (10_000 / math.tau, math.tau)])
@pytest.mark.parametrize("turns", [7, 2_000, -199_999])
async def test_turns_are_counted_to_the_count(scale, modulo, turns):
    axis = {"counts_per_unit": scale, "modulo": modulo}
    async with dialect_rig(V4, ENDLESS, **axis) as before:
        before.drive.loop.renumber(turns * 10_000)
    async with adopting_rig(V4, before, **axis) as rig:
        sample = await position(rig)

    assert (sample.counts, sample.turns, sample.value) == (turns * 10_000, turns, 0.0)


async def test_a_direction_needs_a_modulo_and_a_modulo_no_limits():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        with pytest.raises(NotSupported, match="no modulo"):
            await rig.send(MoveAbsolute(position=1.0, direction=WAYS.POSITIVE))
    with pytest.raises(ValidationError, match="no position limits"):
        async with dialect_rig(V4, modulo=360.0, limits={"position_max": 5.0}):
            pass
