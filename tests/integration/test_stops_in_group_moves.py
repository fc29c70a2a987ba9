"""A stop that comes while axes start or move together: at any instant, nothing moves afterwards."""

import asyncio

import pytest

from ldcnd.contract.commands import MoveAbsolute, Power, Reset
from ldcnd.contract.errors import LdcndError, OutcomeUnknown
from ldcnd.contract.rig_commands import AxisMove, MoveTogether
from ldcnd.contract.samples import AxisState, PositionSample, TelemetryItem
from tests.support.chain_rig import simulated_config
from tests.support.rig import RunningRig, running_rig

GANTRY = simulated_config(group=[{"name": "gantry", "axes": ["x", "y"]}])
AXES = ("x", "y")
SETTLED = 0.05
"""The loop settles by so much behind the end of the profile, in mm."""
AFTER_S = [0.0, 0.0005, 0.001, 0.002, 0.003, 0.005, 0.01, 0.2]


async def positions(rig: RunningRig) -> list[float]:
    samples = [await rig.client.last(axis, TelemetryItem.POSITION) for axis in AXES]
    return [sample.value for sample in samples if isinstance(sample, PositionSample)]


async def together(rig: RunningRig) -> LdcndError | None:
    try:
        await rig.client.ask(MoveTogether(moves=tuple(AxisMove(axis=axis, position=40.0) for axis in AXES)))
    except LdcndError as error:
        return error
    return None


@pytest.mark.parametrize("stopped", [None, "y"])
@pytest.mark.parametrize("after_s", AFTER_S)
@pytest.mark.sweep(6)
async def test_whenever_a_stop_comes_in_a_group_move_what_it_stops_stays(stopped: str | None, after_s: float):
    async with running_rig(GANTRY) as rig:
        await rig.power_on(*AXES)
        async with asyncio.TaskGroup() as group:
            sent = group.create_task(together(rig), name="together")
            await asyncio.sleep(after_s)
            reply = await rig.client.stop(stopped)
        latched = AXES if stopped is None else (stopped,)
        for axis in latched:
            await rig.until(axis, lambda state: state.moving == "no")
        before = await positions(rig)
        await asyncio.sleep(4.0)
        after = await positions(rig)
        states = {axis: await rig.client.state(axis) for axis in AXES}
        await rig.until("x", lambda state: state.moving == "no")
        ((x, _), error) = await positions(rig), sent.result()

    if isinstance(error, OutcomeUnknown):  # it says that all are commanded to stop
        assert x < 39.0
    moved = {axis: abs(now - then) for axis, then, now in zip(AXES, before, after, strict=True)}
    assert set(reply.confirmed) >= set(latched)
    assert all(state.stop_latched for axis in latched if (state := states[axis]))
    assert [axis for axis in latched if moved[axis] > SETTLED] == []


async def test_a_group_that_was_stopped_moves_again_only_after_reset():
    async with running_rig(GANTRY) as rig:
        await rig.power_on(*AXES)
        await rig.client.stop()
        for axis in AXES:
            await rig.until(axis, lambda state: state.moving == "no")
        await together(rig)
        held = await positions(rig)
        for axis in AXES:
            await rig.client.command(axis, Reset())
            state = await rig.client.state(axis)
            assert state
            if state.state is AxisState.DISABLED:
                await rig.client.command(axis, Power(on=True))
        reply = await rig.client.command("x", MoveAbsolute(position=1.0))
        end = await rig.client.wait_for_end("x", reply.command_id)

    assert all(abs(value) < 0.01 for value in held)
    assert end.state is AxisState.STANDSTILL
