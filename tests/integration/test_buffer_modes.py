"""Moves that find the axis moving, on the jumping clock."""

import asyncio

import pytest

from ldcnd.errors import StopLatched, WrongState
from ldcnd.model.commands import BufferMode, MoveAbsolute, MoveVelocity, Power
from ldcnd.model.events import CommandOutcome, CommandStatus, ReadOutcome
from ldcnd.model.samples import AxisState, LinkState, PositionSample, TelemetryItem
from tests.support.rig import RunningRig, running_rig


async def moving(rig: RunningRig, target: float = 40.0) -> str:
    """Have axis x move, and return the command's id."""
    await rig.until("x", lambda state: state.link is LinkState.UP)
    await rig.client.command("x", Power(on=True))
    reply = await rig.client.command("x", MoveAbsolute(position=target))
    await asyncio.sleep(0.5)
    return reply.command_id


async def outcome(rig: RunningRig, command_id: str) -> CommandOutcome:
    return await rig.client.ask(ReadOutcome(command_id=command_id))


async def move(rig: RunningRig, position: float, mode: BufferMode) -> str:
    request = MoveAbsolute(position=position, buffer_mode=mode)
    return (await rig.client.command("x", request, timeout_s=30.0)).command_id


async def position_of(rig: RunningRig) -> float:
    await asyncio.sleep(1.0)
    sample = await rig.client.last("x", TelemetryItem.POSITION)
    assert isinstance(sample, PositionSample)
    return sample.value


async def test_a_move_refuses_to_disturb_another_unless_told_otherwise():
    async with running_rig() as rig:
        first = await moving(rig)

        with pytest.raises(WrongState):
            await move(rig, 0.0, BufferMode.REFUSE)

        await rig.client.wait_for_end("x", first)
        assert (await outcome(rig, first)).status is CommandStatus.DONE


async def test_an_aborting_move_halts_what_runs_and_takes_over():
    async with running_rig() as rig:
        first = await moving(rig)

        second = await move(rig, -5.0, BufferMode.ABORTING)
        state = await rig.client.wait_for_end("x", second)

        assert state.state is AxisState.STANDSTILL
        assert (await outcome(rig, first)).status is CommandStatus.ABORTED
        assert (await outcome(rig, second)).status is CommandStatus.DONE
        assert await position_of(rig) == pytest.approx(-5.0, abs=0.0011)


async def test_buffered_moves_follow_one_another_in_order():
    async with running_rig() as rig:
        first = await moving(rig, 20.0)

        async with asyncio.TaskGroup() as group:
            followers = [
                group.create_task(move(rig, target, BufferMode.BUFFERED), name=f"to {target}") for target in (5.0, 8.0)
            ]
        await rig.client.wait_for_end("x", followers[1].result())

        statuses = [(await outcome(rig, name)).status for name in (first, *(task.result() for task in followers))]
        assert statuses == [CommandStatus.DONE] * 3
        assert await position_of(rig) == pytest.approx(8.0, abs=0.0011)


async def test_a_stop_also_ends_what_waits():
    async with running_rig() as rig:
        await moving(rig)

        async with asyncio.TaskGroup() as group:
            waiting = group.create_task(_refusal(move(rig, 5.0, BufferMode.BUFFERED)), name="waiting")
            await asyncio.sleep(0.1)
            await rig.client.stop("x")
        await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)

        assert isinstance(waiting.result(), StopLatched)
        assert await position_of(rig) > 5.5


async def test_an_aborting_move_on_a_standing_axis_is_like_any_other():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        await rig.client.command("x", Power(on=True))

        request = MoveVelocity(velocity=5.0, buffer_mode=BufferMode.ABORTING)
        await rig.client.command("x", request)

        assert (await rig.client.state("x")).state is AxisState.CONTINUOUS_MOTION


async def _refusal(work):
    try:
        return await work
    except StopLatched as error:
        return error
