"""A drive that is sent to 0 of its own counter arrives there, however seldom it is asked: it was not reset."""

import asyncio

import pytest

from ldcnd.contract.commands import BufferMode, MoveAbsolute, MoveVelocity, SetPosition
from ldcnd.contract.samples import AxisState
from tests.support.dialect_rig import AXIS, LS_182AP, SC, V4, Dialect, dialect_rig


@pytest.mark.parametrize("dialect", [LS_182AP, V4, SC], ids=lambda dialect: dialect.name)
@pytest.mark.parametrize("state_hz", [1.0, 2.0, 5.0])
@pytest.mark.parametrize("on_its_way", [False, True])
@pytest.mark.sweep(5)
async def test_a_move_to_the_zero_of_the_counter_is_no_reset(dialect: Dialect, state_hz: float, on_its_way):
    rates = {"position": state_hz, "velocity": 0, "adc": 0, "state": state_hz}
    home = MoveAbsolute(position=0.0, velocity=40.0, buffer_mode=BufferMode.ABORTING)
    limits = {"velocity": 40.0, "acceleration": 800.0}
    async with dialect_rig(dialect, rates=rates, velocity=10, acceleration=100, limits=limits) as rig:
        await rig.power_on()
        await rig.send(SetPosition(position=0.0))
        for _ in range(4):
            if on_its_way:
                await rig.send(MoveVelocity(velocity=4.0))
                await asyncio.sleep(0.9)
            else:
                await rig.send(MoveAbsolute(position=3.2, velocity=10.0))
                await asyncio.sleep(1.2)
            await rig.send(home)
            await asyncio.sleep(2.0)
            state = await rig.rig.client.state(AXIS)
            assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
            assert rig.position_mm == pytest.approx(0.0, abs=0.05)
        assert (await rig.rig.client.state(AXIS)).referenced
