"""A cable that is cut before the first drive of a line: every axis behind it is soon shown as not answering."""

import asyncio

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import BufferMode, MoveAbsolute, MoveVelocity, Power
from ldcnd.contract.errors import StopNotConfirmed
from ldcnd.contract.samples import LinkState
from ldcnd.testing import run, simulated_rig
from tests.support.rig import SIMULATED

LONGEST_S = 4.5
"""Three polls of each of four drives, between which stops and searches go out that nobody answers either."""


async def found_lost(mover: str) -> dict[str, float]:
    """Return after how many seconds each axis is down, with one that moves when the cable is cut."""
    async with simulated_rig(SIMULATED) as rig:
        client = rig.client.client
        await client.command(mover, Power(on=True))
        async with asyncio.TaskGroup() as group:
            moving = group.create_task(client.command(mover, MoveAbsolute(position=45.0)))
            await asyncio.sleep(1.0)
            rig.faults.cable_cut("x")
            began_s, down_s = rig.now_s, {}
            while len(down_s) < len(rig.daemon.rig.axes):
                await asyncio.sleep(0.01)
                for axis in rig.daemon.rig.axes:
                    state = await client.state(axis)
                    if state and state.link is LinkState.DOWN:
                        down_s.setdefault(axis, rig.now_s - began_s)
                assert rig.now_s - began_s < 30, down_s
            moving.cancel()
        return down_s


@pytest.mark.long
def test_an_axis_that_moves_is_found_lost_as_soon_as_the_others():
    for mover in "xz":
        down_s = run(found_lost(mover))

        assert max(down_s.values()) < LONGEST_S, down_s


@pytest.mark.parametrize("mover", ["x", "z"])
@pytest.mark.parametrize("motion", [MoveAbsolute(position=1.0), MoveVelocity(velocity=-5.0)])
@pytest.mark.parametrize("cut_s", [2.0, 3.0])
def test_a_motion_whose_axis_cannot_be_halted_for_it_does_not_begin_when_the_cable_is_mended(mover, motion, cut_s):
    async def program() -> None:
        config = load_config(SIMULATED)
        slow = tuple(bus.model_copy(update={"margin_ms": 300.0}) for bus in config.bus)  # so that it is not lost soon
        async with simulated_rig(config.model_copy(update={"bus": slow}), seed=1) as rig:
            client = rig.client.client
            await client.command(mover, Power(on=True))
            await client.command(mover, MoveAbsolute(position=45.0))
            await asyncio.sleep(0.5)
            cut = rig.faults.cable_cut("x")
            began_s = rig.now_s
            await asyncio.sleep(0.3)
            with pytest.raises(StopNotConfirmed):
                await client.command(mover, motion.model_copy(update={"buffer_mode": BufferMode.ABORTING}), 60)
            await asyncio.sleep(max(0.0, began_s + cut_s - rig.now_s))
            stands, velocity = rig.truth(mover).position, rig.truth(mover).velocity
            cut.end()
            await asyncio.sleep(8)
            assert rig.truth(mover).at_rest
            assert rig.truth(mover).position > stands - 0.1, f"it set off backwards; it had {velocity} at the repair"

    run(program())
