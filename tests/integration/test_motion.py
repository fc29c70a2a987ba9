"""Commands of one axis, from query to drive and back, on the jumping clock."""

import asyncio
import random

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import (
    Halt,
    Home,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    QuickStop,
    Reset,
    SetPosition,
)
from ldcnd.contract.errors import NotReferenced, PositionLimit, StopLatched, WrongState
from ldcnd.contract.samples import AxisState, Moving, PositionSample, TelemetryItem, VelocitySample
from tests.support.rig import SIMULATED, RunningRig, running_rig


async def position_of(rig: RunningRig, axis: str) -> float:
    """Return the next published position."""
    async with rig.client.samples(axis, TelemetryItem.POSITION) as positions:
        _, sample = await anext(positions)
    assert isinstance(sample, PositionSample)
    return sample.value


async def settled(rig: RunningRig, axis: str) -> float:
    await asyncio.sleep(1.0)  # virtual: the loop settles within a second
    return await position_of(rig, axis)


@pytest.mark.parametrize(("axis", "resolution"), [("x", 0.001), ("z", 0.0005)])
async def test_a_move_ends_within_one_count(axis, resolution):
    async with running_rig() as rig:
        await rig.power_on(axis)

        reply = await rig.client.command(axis, MoveAbsolute(position=-7.3))
        state = await rig.client.wait_for_end(axis, reply.command_id)

        assert (state.state, state.moving, state.last_error) == (AxisState.STANDSTILL, Moving.NO, None)
        assert await settled(rig, axis) == pytest.approx(-7.3, abs=resolution * 1.01)


@pytest.mark.long
async def test_a_move_takes_as_long_as_its_reply_says():
    async with running_rig() as rig:
        await rig.power_on("x")
        loop = asyncio.get_running_loop()
        began_s = loop.time()

        reply = await rig.client.command("x", MoveAbsolute(position=50.0))
        await rig.client.wait_for_end("x", reply.command_id)

        assert reply.duration_s == pytest.approx(2.6, abs=0.01)
        assert loop.time() - began_s == pytest.approx(2.6, abs=0.25)


async def test_the_state_tells_where_a_move_ends_and_when():
    async with running_rig() as rig:
        await rig.power_on("x")

        reply = await rig.client.command("x", MoveAbsolute(position=30.0))
        under_way = (await rig.client.state("x")).command
        ended = await rig.client.wait_for_end("x", reply.command_id)

        assert (under_way.command_id, under_way.target) == (reply.command_id, 30.0)
        assert under_way.expected_end == under_way.since + round(reply.duration_s * 1e9)
        assert ended.t == pytest.approx(under_way.expected_end, abs=0.25e9)


async def test_relative_moves_add_up_without_drift():
    async with running_rig() as rig:
        await rig.power_on("x")

        for _ in range(5):
            reply = await rig.client.command("x", MoveRelative(distance=1.234))
            await rig.client.wait_for_end("x", reply.command_id)

        assert reply.position == pytest.approx(6.17)
        assert await settled(rig, "x") == pytest.approx(6.17, abs=0.0011)


async def test_the_published_velocity_is_positive_forward():
    async with running_rig() as rig:
        await rig.power_on("x")

        await rig.client.command("x", MoveVelocity(velocity=20.0))
        await asyncio.sleep(0.5)
        async with rig.client.samples("x", TelemetryItem.VELOCITY) as velocities:
            _, sample = await anext(velocities)

        assert isinstance(sample, VelocitySample)
        assert sample.value == pytest.approx(20.0, abs=3)


async def test_a_jog_on_a_referenced_axis_ends_at_the_software_limit():
    async with running_rig() as rig:
        await rig.power_on("x")

        reply = await rig.client.command("x", MoveVelocity(velocity=-50.0))
        assert (await rig.until("x", lambda state: state.command is not None)).state is AxisState.CONTINUOUS_MOTION
        await rig.client.wait_for_end("x", reply.command_id)

        assert await settled(rig, "x") == pytest.approx(-100.0, abs=0.0011)


@pytest.mark.long
async def test_a_jog_without_a_limit_ends_at_its_horizon():
    async with running_rig() as rig:
        await rig.power_on("c")

        reply = await rig.client.command("c", MoveVelocity(velocity=2.0))
        state = await rig.client.wait_for_end("c", reply.command_id)

        assert reply.position == pytest.approx(120.0, abs=0.1)
        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        assert await settled(rig, "c") == pytest.approx(120.0, abs=0.1)


async def test_halt_brings_an_axis_to_rest_and_lets_it_move_again():
    async with running_rig() as rig:
        await rig.power_on("c")
        await rig.client.command("c", MoveVelocity(velocity=90.0))
        await asyncio.sleep(1.0)

        reply = await rig.client.command("c", Halt())
        state = await rig.client.wait_for_end("c", reply.command_id)

        assert (state.state, state.stop_latched) == (AxisState.STANDSTILL, False)
        assert state.last_error is not None
        assert "aborted by halt" in state.last_error
        reply = await rig.client.command("c", MoveAbsolute(position=0.0))
        await rig.client.wait_for_end("c", reply.command_id)
        assert await settled(rig, "c") == pytest.approx(0.0, abs=0.011)


async def test_an_axis_is_known_to_rest_behind_every_halt_however_short_its_motion_was():
    rng = random.Random(1)
    async with running_rig() as rig:
        await rig.power_on("x")
        for _ in range(60):
            await asyncio.sleep(rng.uniform(0.0, 0.3))
            velocity = rng.choice((0.5, 1.0, 2.0))
            await rig.client.command("x", MoveRelative(distance=rng.choice((-20.0, 20.0)), velocity=velocity))
            await asyncio.sleep(rng.uniform(0.0, 0.07))
            await rig.client.command("x", Halt())
            await rig.until("x", lambda state: state.command is None)
            await asyncio.sleep(1.5)
            state = await rig.client.state("x")
            assert (state.moving, state.state) == (Moving.NO, AxisState.STANDSTILL)


async def test_a_second_move_in_mid_move_is_refused():
    async with running_rig() as rig:
        await rig.power_on("x")
        reply = await rig.client.command("x", MoveAbsolute(position=50.0))

        with pytest.raises(WrongState, match="is moving"):
            await rig.client.command("x", MoveAbsolute(position=0.0))

        await rig.client.wait_for_end("x", reply.command_id)
        assert await settled(rig, "x") == pytest.approx(50.0, abs=0.0011)


async def test_a_stop_in_mid_move_latches_until_reset():
    async with running_rig() as rig:
        await rig.power_on("x")
        await rig.client.command("x", MoveAbsolute(position=90.0))
        await asyncio.sleep(1.0)

        reply = await rig.client.stop("x")
        state = await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)

        assert (reply.axes, reply.confirmed) == (("x",), ("x",))
        assert state.stop_latched
        where = await settled(rig, "x")
        assert 15 < where < 30
        with pytest.raises(StopLatched) as refusal:
            await rig.client.command("x", MoveAbsolute(position=0.0))
        assert refusal.value.remedy == "send reset"
        await rig.client.command("x", Reset())
        reply = await rig.client.command("x", MoveAbsolute(position=0.0))
        await rig.client.wait_for_end("x", reply.command_id)
        assert await settled(rig, "x") == pytest.approx(0.0, abs=0.0011)


async def test_a_quick_stop_needs_no_ramp():
    async with running_rig() as rig:
        await rig.power_on("x")
        await rig.client.command("x", MoveVelocity(velocity=20.0, acceleration=20.0))
        await asyncio.sleep(1.5)
        before = await position_of(rig, "x")

        await rig.client.command("x", QuickStop())

        assert await settled(rig, "x") - before < 3.0  # the ramp alone would be 10 mm


async def test_a_stop_of_the_rig_stops_everything_at_once():
    async with running_rig() as rig:
        for axis in ("x", "y", "z"):
            await rig.power_on(axis)
            await rig.client.command(axis, MoveVelocity(velocity=10.0))
        await asyncio.sleep(0.5)

        reply = await rig.client.stop()

        assert reply.confirmed == ("x", "y", "z", "c")
        for axis in ("x", "y", "z"):
            state = await rig.until(axis, lambda state: state.state is AxisState.STANDSTILL)
            assert state.stop_latched


async def test_a_stop_does_not_close_the_loop_of_a_disabled_axis():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link == "up")

        await rig.client.stop("x")
        await asyncio.sleep(1.0)
        state = await rig.client.state("x")

        assert (state.state, state.enabled, state.stop_latched) == (AxisState.DISABLED, False, True)
        with pytest.raises(StopLatched):
            await rig.client.command("x", Power(on=True))


async def test_a_stop_overtakes_a_move_that_came_before_it():
    async with running_rig() as rig:
        await rig.power_on("x")
        axis = rig.daemon.rig.axes["x"]

        async with asyncio.TaskGroup() as group:
            move = group.create_task(_outcome(axis.execute(MoveAbsolute(position=50.0))))
            group.create_task(_outcome(rig.daemon.rig.stop(("x",))))

        assert isinstance(move.result(), StopLatched)
        assert await settled(rig, "x") == pytest.approx(0.0, abs=0.0011)


@pytest.mark.parametrize("turns", range(1, 12))
@pytest.mark.sweep(2)
async def test_whenever_a_stop_comes_nothing_moves_afterwards(turns):
    """The stop arrives after so many turns of the loop or bytes of the line: between load and start, too."""
    async with running_rig() as rig:
        await rig.power_on("x")
        axis = rig.daemon.rig.axes["x"]

        async with asyncio.TaskGroup() as group:
            group.create_task(_outcome(axis.execute(MoveAbsolute(position=50.0))))
            await asyncio.sleep(turns * 0.0004)
            await rig.daemon.rig.stop(("x",))
        await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)

        assert await settled(rig, "x") < 0.2
        assert (await rig.client.state("x")).stop_latched


async def _outcome(work):
    try:
        return await work
    except Exception as error:  # noqa: BLE001 - the outcome is what is looked at
        return error


async def test_power_off_in_mid_move_ends_the_move():
    async with running_rig() as rig:
        await rig.power_on("x")
        reply = await rig.client.command("x", MoveAbsolute(position=90.0))
        await asyncio.sleep(0.5)

        await rig.client.command("x", Power(on=False))
        state = await rig.client.wait_for_end("x", reply.command_id)

        assert (state.state, state.enabled) == (AxisState.DISABLED, False)
        assert "aborted" in state.last_error


@pytest.mark.parametrize("axis", ["x", "y", "z", "c"])
@pytest.mark.sweep(2)
async def test_homing_finds_the_reference_and_defines_the_position(axis):
    async with running_rig() as rig:
        await rig.power_on(axis)

        reply = await rig.client.command(axis, Home())
        assert (await rig.client.state(axis)).state is AxisState.HOMING
        state = await rig.client.wait_for_end(axis, reply.command_id)

        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)
        if axis == "y":  # reverse limit switch at -120 mm of the power-up position, called -120 there; then to -90
            assert await settled(rig, "y") == pytest.approx(-90.0, abs=0.1)
            assert await rig.client.command("y", MoveRelative(distance=1.0))


async def test_a_search_that_finds_nothing_ends_with_a_reason():
    async with running_rig() as rig:
        await rig.power_on("c")

        reply = await rig.client.command("c", Home(method="forward_limit", velocity=10, timeout_s=2))
        state = await rig.client.wait_for_end("c", reply.command_id)

        assert (state.state, state.referenced) == (AxisState.STANDSTILL, False)
        assert state.last_error == "home: no forward_limit within 2 s"
        with pytest.raises(NotReferenced):
            await rig.client.command("c", MoveAbsolute(position=0))


async def test_a_position_that_was_set_shifts_limits_and_targets():
    async with running_rig() as rig:
        await rig.power_on("x")

        await rig.client.command("x", SetPosition(position=95.0))

        assert await position_of(rig, "x") == pytest.approx(95.0, abs=0.0011)
        with pytest.raises(PositionLimit):
            await rig.client.command("x", MoveRelative(distance=6.0))
        reply = await rig.client.command("x", MoveRelative(distance=5.0))
        await rig.client.wait_for_end("x", reply.command_id)
        assert await settled(rig, "x") == pytest.approx(100.0, abs=0.0011)


async def test_an_axis_that_is_not_powered_says_how_to_power_it():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link == "up")

        with pytest.raises(WrongState) as refusal:
            await rig.client.command("x", MoveAbsolute(position=1.0))

        assert "power" in refusal.value.remedy


@pytest.mark.parametrize("rate_hz", [1.0, 20.0])
@pytest.mark.sweep(2)
async def test_an_axis_without_limits_may_be_moved_faster_than_its_own_velocity(rate_hz):
    config = load_config(SIMULATED)
    x = config.bus[0].axis[0]
    slow = {"velocity": 1.0, "limits": x.limits.model_copy(update={"velocity": None}), "approach": None}
    rates = x.rates.model_copy(update={"position": rate_hz, "velocity": rate_hz, "state": rate_hz})
    axes = (x.model_copy(update=slow | {"rates": rates}), *config.bus[0].axis[1:])
    bus = config.bus[0].model_copy(update={"axis": axes})
    async with running_rig(config.model_copy(update={"bus": (bus, *config.bus[1:])})) as rig:
        await rig.power_on("x")
        statistics = rig.daemon.rig.buses[0].bus.statistics
        before = statistics.resynchronisations
        for place in (80.0, -80.0):
            reply = await rig.client.command("x", MoveAbsolute(position=place, velocity=40.0, acceleration=200.0))
            state = await rig.client.wait_for_end("x", reply.command_id)
            assert state.state is AxisState.STANDSTILL
        last = await rig.client.last("x", TelemetryItem.POSITION)

    assert isinstance(last, PositionSample)
    assert abs(last.value + 80.0) < 0.01
    assert statistics.resynchronisations == before  # none of its readings was taken for another drive's
