"""A jog runs for as long as it is renewed, and ends by itself within its bound."""

import asyncio
from contextlib import asynccontextmanager

import pytest

from ldcnd.contract.commands import Halt, Jog, MoveAbsolute, Stop
from ldcnd.contract.errors import LeaseExpired, LeaseHeld, PositionLimit, StopLatched, VelocityLimit
from ldcnd.contract.events import ReadEvents
from ldcnd.contract.leases import Acquire
from ldcnd.contract.samples import AxisState, LinkState
from tests.support.dialect_rig import AXIS, LS_173AP, LS_182AP, SC, V1, V4, dialect_rig

HOLD_S = 0.4
ALIVE_S = HOLD_S + 0.1
"""From the last renewal to the ramp, with what the stop takes on the line."""
RAMP_MM = 0.2
LIMITS = {"position_min": -15, "position_max": 15, "velocity": 25}
DIALECTS = [V1, V4, SC, LS_173AP, LS_182AP]
dialects = pytest.mark.parametrize("dialect", DIALECTS, ids=lambda dialect: dialect.name)


@asynccontextmanager
async def ready(dialect, **axis):
    async with dialect_rig(dialect, **axis) as rig:
        await rig.power_on()
        yield rig


async def position(rig):
    rig.drive.catch_up(asyncio.get_running_loop().time())
    return rig.position_mm


async def hold(rig, jog, for_s, velocity):
    """Renew a jog like a finger that is down for a time."""
    until_s = asyncio.get_running_loop().time() + for_s
    while asyncio.get_running_loop().time() < until_s:
        await asyncio.sleep(0.1)
        await rig.send(Jog(velocity=velocity, hold_s=HOLD_S, renews=jog.command_id))


@pytest.mark.promise("jog-while-renewed")
@dialects
@pytest.mark.parametrize("velocity", [5.0, -5.0])
@pytest.mark.sweep(2)
async def test_a_jog_runs_while_it_is_renewed_and_ends_when_it_is_not(dialect, velocity):
    async with ready(dialect) as rig:
        jog = await rig.send(Jog(velocity=velocity, hold_s=HOLD_S))
        await hold(rig, jog, 2.0, velocity)
        let_go = await position(rig)
        state = await rig.until(lambda state: state.command is None)

        assert abs(let_go) == pytest.approx(10.0, abs=0.7)
        assert abs(await position(rig) - let_go) < 5.0 * ALIVE_S + RAMP_MM
        assert state.state is AxisState.STANDSTILL
        assert state.last_error == "jog: its hold was not renewed for 0.4 s"


@dialects
@pytest.mark.sweep(2)
async def test_a_jog_that_is_halted_ends_at_once(dialect):
    async with ready(dialect) as rig:
        await rig.send(Jog(velocity=5.0))
        await asyncio.sleep(0.2)
        before = await position(rig)
        state = await rig.done(Halt())
        events = (await rig.rig.client.ask(ReadEvents())).events

        assert await position(rig) - before < 0.3
        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        last = [event for event in events if event.verb == "jog"][-1]
        assert (last.status, last.reason) == ("done", None)  # as it should


@dialects
@pytest.mark.sweep(3)
async def test_a_jog_is_held_for_longer_than_its_goal_is_ahead(dialect):
    async with ready(dialect, jog_reach_s=1.0) as rig:
        jog = await rig.send(Jog(velocity=4.0, hold_s=HOLD_S))
        await hold(rig, jog, 4.0, 4.0)

        assert (await rig.rig.client.state(AXIS)).command.command_id == jog.command_id
        assert await position(rig) > 12.0


@dialects
@pytest.mark.sweep(2)
async def test_a_renewal_may_change_the_velocity_and_turn_round(dialect):
    async with ready(dialect) as rig:
        jog = await rig.send(Jog(velocity=4.0, hold_s=HOLD_S))
        for velocity in (4.0, 8.0, -6.0):
            await hold(rig, jog, 1.0, velocity)
            before = await position(rig)
            await hold(rig, jog, 0.5, velocity)
            assert (await position(rig) - before) / 0.5 == pytest.approx(velocity, rel=0.25)
        state = await rig.rig.client.state(AXIS)

        assert (state.state, state.command.command_id) == (AxisState.CONTINUOUS_MOTION, jog.command_id)


@dialects
@pytest.mark.sweep(2)
async def test_a_jog_ends_at_the_software_limit_and_is_over_then(dialect):
    async with ready(dialect, limits=LIMITS) as rig:
        jog = await rig.send(Jog(velocity=20.0, hold_s=HOLD_S))
        with pytest.raises(LeaseExpired, match="over"):
            await hold(rig, jog, 5.0, 20.0)
        state = await rig.until(lambda state: state.command is None)

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        assert await position(rig) == pytest.approx(15.0, abs=0.05)
        with pytest.raises(PositionLimit):
            await rig.send(Jog(velocity=1.0))


@pytest.mark.promise("jog-while-renewed")
@pytest.mark.parametrize("dialect", [SC, LS_182AP], ids=lambda dialect: dialect.name)
async def test_a_jog_that_is_over_is_not_begun_again_by_a_late_renewal(dialect):
    async with ready(dialect) as rig:
        jog = await rig.send(Jog(velocity=5.0, hold_s=HOLD_S))
        await rig.until(lambda state: state.command is None)
        before = await position(rig)
        for _ in range(5):
            with pytest.raises(LeaseExpired):
                await rig.send(Jog(velocity=5.0, renews=jog.command_id))
        with pytest.raises(LeaseExpired):
            await rig.send(Jog(velocity=5.0, renews="never begun"))
        await asyncio.sleep(1.0)

        assert await position(rig) == pytest.approx(before, abs=0.01)


@pytest.mark.promise("jog-while-renewed")
@pytest.mark.parametrize("dialect", [SC, LS_182AP], ids=lambda dialect: dialect.name)
async def test_a_renewal_after_a_halt_or_a_stop_moves_nothing(dialect):
    async with ready(dialect) as rig:
        for ending in (Halt(), Stop()):
            jog = await rig.send(Jog(velocity=5.0))
            await asyncio.sleep(0.2)
            await rig.send(ending)
            with pytest.raises(LeaseExpired):
                await rig.send(Jog(velocity=5.0, renews=jog.command_id))
            await rig.until(lambda state: state.command is None)
        before = await position(rig)
        await asyncio.sleep(1.0)

        assert await position(rig) == pytest.approx(before, abs=0.01)
        with pytest.raises(StopLatched):
            await rig.send(Jog(velocity=5.0))


async def test_renewals_leave_no_events_and_a_velocity_above_the_limit_renews_nothing():
    async with ready(LS_182AP, limits=LIMITS) as rig:
        jog = await rig.send(Jog(velocity=1.0, hold_s=HOLD_S))
        await hold(rig, jog, 1.0, 1.0)
        events = (await rig.rig.client.ask(ReadEvents())).events
        assert sum(event.verb == "jog" for event in events) <= 2  # accepted, executing
        began_s = asyncio.get_running_loop().time()
        for _ in range(3):
            with pytest.raises(VelocityLimit):
                await rig.send(Jog(velocity=30.0, renews=jog.command_id))
            await asyncio.sleep(0.1)
        state = await rig.until(lambda state: state.command is None)

        assert state.last_error is not None
        assert asyncio.get_running_loop().time() - began_s < 1.0


async def test_a_jog_that_waited_until_nobody_holds_it_is_not_begun():
    async with ready(LS_182AP) as rig:
        await rig.send(MoveAbsolute(position=10.0, velocity=5.0))
        jog = await rig.send(Jog(velocity=5.0, hold_s=0.2, buffer_mode="buffered"))

        assert await rig.rig.refusal(jog) == "lease_expired"
        await rig.until(lambda state: state.command is None)
        await asyncio.sleep(1.0)
        assert await position(rig) == pytest.approx(10.0, abs=0.05)


@pytest.mark.parametrize("dialect", [SC, LS_182AP], ids=lambda dialect: dialect.name)
async def test_a_jog_may_take_over_from_what_the_axis_does(dialect):
    async with ready(dialect) as rig:
        await rig.send(MoveAbsolute(position=15.0, velocity=5.0))
        await asyncio.sleep(0.5)
        jog = await rig.send(Jog(velocity=-4.0, hold_s=HOLD_S, buffer_mode="aborting"))
        await hold(rig, jog, 0.5, -4.0)
        before = await position(rig)
        await hold(rig, jog, 0.5, -4.0)

        assert await position(rig) - before == pytest.approx(-2.0, abs=0.5)


async def test_another_client_cannot_renew_under_a_lease_that_it_has_not():
    async with ready(SC) as rig:
        held = await rig.rig.client.ask(Acquire(client="ann", axes=(AXIS,), lease_s=5))
        jog = await rig.send(Jog(velocity=2.0, lease=held.lease))
        with pytest.raises(LeaseHeld):
            await rig.send(Jog(velocity=2.0, renews=jog.command_id))


@pytest.mark.promise("jog-ends-in-drive")
@pytest.mark.parametrize("dialect", [SC, V4], ids=lambda dialect: dialect.name)
@pytest.mark.sweep(2)
async def test_a_lost_line_ends_a_jog_within_the_goal_of_the_drive(dialect):
    async with ready(dialect, jog_reach_s=1.0) as rig:
        jog = await rig.send(Jog(velocity=5.0, hold_s=HOLD_S))
        await hold(rig, jog, 0.5, 5.0)
        before = await position(rig)
        rig.chain.unplug(asyncio.get_running_loop().time(), 10.0)
        state = await rig.until(lambda state: state.link is LinkState.DOWN)
        with pytest.raises(LeaseExpired):
            await rig.send(Jog(velocity=5.0, renews=jog.command_id))
        await asyncio.sleep(2.0)
        after = await position(rig)
        await asyncio.sleep(1.0)

        assert state.state is AxisState.ERROR_STOP
        assert after - before < 5.0 * 1.0 + RAMP_MM
        assert await position(rig) == pytest.approx(after, abs=0.01)
