"""`snapshot`: the positions of all axes of a line at one instant, with its bound, for clients."""

import asyncio

import pytest

from ldcnd.contract.commands import Home, MoveVelocity
from ldcnd.contract.errors import NotSupported, ValueOutOfRange, WrongState
from ldcnd.contract.rig_commands import Snapshot
from tests.support.dialect_rig import AXIS, LS_182AP, V4, dialect_rig

FREEZES = {"snapshot": True}


@pytest.mark.parametrize("dialect", [V4, LS_182AP], ids=lambda dialect: dialect.name)
async def test_a_snapshot_tells_the_position_of_a_moving_axis_within_its_bound(dialect):
    async with dialect_rig(dialect, line=FREEZES) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=5.0))
        await asyncio.sleep(0.5)
        seen: list[tuple[int, float]] = []
        loop = asyncio.get_running_loop()

        async def watch() -> None:
            while True:
                rig.chain.advance(loop.time())
                rig.drive.catch_up(loop.time())
                seen.append((rig.rig.daemon.rig.axes[AXIS]._clock.now_ns(), rig.position_mm))
                await asyncio.sleep(0.0005)

        watching = asyncio.create_task(watch())
        reply = await rig.rig.client.ask(Snapshot(bus="line"))
        watching.cancel()

        (frozen,) = reply.positions
        assert (frozen.axis, frozen.unit, frozen.referenced) == (AXIS, "mm", True)
        assert 0 < reply.t_error_ns < 2_500_000
        within = [mm for t, mm in seen if abs(t - reply.t) <= reply.t_error_ns + 1_000_000]
        assert min(within) - 0.01 <= frozen.position <= max(within) + 0.01


async def test_a_snapshot_is_taken_while_a_limit_switch_guards_the_motion():
    async with dialect_rig(LS_182AP, line=FREEZES, limit_switches="stop") as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=5.0))
        await asyncio.sleep(0.5)

        reply = await rig.rig.client.ask(Snapshot(bus="line"))

        assert reply.positions[0].position == pytest.approx(2.4, abs=0.2)


async def test_a_snapshot_waits_for_no_homing_and_spoils_none():
    async with dialect_rig(LS_182AP, line=FREEZES) as rig:
        await rig.power_on()
        await rig.send(Home(method="index", velocity=-0.5, timeout_s=5.0))

        with pytest.raises(WrongState, match="home register is in use"):
            await rig.rig.client.ask(Snapshot(bus="line"))


async def test_a_snapshot_is_refused_on_a_line_that_is_not_configured_for_it_or_does_not_exist():
    async with dialect_rig(V4) as rig:
        with pytest.raises(NotSupported, match="not configured"):
            await rig.rig.client.ask(Snapshot(bus="line"))
        with pytest.raises(ValueOutOfRange, match="no bus 'other'"):
            await rig.rig.client.ask(Snapshot(bus="other"))
