"""Moves that find the axis moving, on the jumping clock."""

import asyncio
import json
from contextlib import asynccontextmanager

import pytest

from ldcnd.client.rig import Rig
from ldcnd.contract.commands import (
    BufferMode,
    CommandReply,
    Halt,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    SetPosition,
)
from ldcnd.contract.errors import PositionLimit, WrongState
from ldcnd.contract.events import CommandOutcome, CommandStatus, ReadOutcome
from ldcnd.contract.samples import AxisState, LinkState, PositionSample, TelemetryItem
from tests.support.command_line import virtual_rig
from tests.support.dialect_rig import AXIS, SC, dialect_rig
from tests.support.rig import RunningRig, running_rig


async def moving(rig: RunningRig, target: float = 40.0) -> str:
    """Have axis x move, and return the command's id."""
    await rig.power_on("x")
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


@asynccontextmanager
async def controlled():
    """Yield a rig and its axis x, as a program controls it."""
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        async with Rig(rig.client, await rig.client.daemon()).control("x", client="tester") as x:
            yield rig, x


async def waiting_behind_a_long_move(rig: RunningRig) -> tuple[str, CommandReply]:
    """Have x move for 30 s and another move wait behind that; return the first one's id and the second one's reply."""
    first = await moving(rig, 0.0)
    await rig.client.wait_for_end("x", first)
    first = (await rig.client.command("x", MoveAbsolute(position=30.0, velocity=1.0))).command_id
    await asyncio.sleep(0.5)
    return first, await rig.client.command("x", MoveAbsolute(position=2.0, buffer_mode=BufferMode.BUFFERED))


@pytest.mark.long
async def test_a_move_behind_a_long_one_is_answered_at_once_and_its_end_is_waited_for():
    async with running_rig() as rig:
        began_s = asyncio.get_running_loop().time()
        first, waiting = await waiting_behind_a_long_move(rig)
        answered_s = asyncio.get_running_loop().time() - began_s

        await rig.client.wait_for_end("x", waiting.command_id)

        assert answered_s < 5.0
        assert waiting.waits_for == first
        assert [(await outcome(rig, each)).status for each in (first, waiting.command_id)] == [CommandStatus.DONE] * 2
        assert await position_of(rig) == pytest.approx(2.0, abs=0.0011)


@pytest.mark.long
async def test_a_bare_query_that_is_short_of_time_has_its_answer_before_anything_begins():
    async with running_rig() as rig:
        first, _ = await waiting_behind_a_long_move(rig)
        payload = b'{"position": 4.0, "buffer_mode": "buffered", "command_id": "mine"}'

        (answer,) = await rig.session.query(rig.client.keys.command("x", "move_absolute"), payload, timeout_s=0.2)
        again = await rig.session.query(rig.client.keys.command("x", "move_absolute"), payload, timeout_s=0.2)

        assert json.loads(answer.payload)["waits_for"] not in (None, first)  # the one that waits already
        assert json.loads(again[0].payload)["command_id"] == "mine"
        await rig.client.wait_for_end("x", "mine")
        assert await position_of(rig) == pytest.approx(4.0, abs=0.0011)


@pytest.mark.long
async def test_a_halt_withdraws_what_waits():
    async with running_rig() as rig:
        _, waiting = await waiting_behind_a_long_move(rig)

        halt = await rig.client.command("x", Halt())
        await rig.client.wait_for_end("x", halt.command_id)
        halted_at = await position_of(rig)
        await asyncio.sleep(60.0)

        ended = await outcome(rig, waiting.command_id)
        assert ended.status is CommandStatus.ABORTED
        assert "overtaken by halt" in (ended.reason or "")
        assert await position_of(rig) == pytest.approx(halted_at, abs=0.0011)


@pytest.mark.long
async def test_a_program_that_gives_up_its_wait_leaves_nothing_that_begins_later():
    async with controlled() as (rig, x):
        await x.power(on=True)
        await x.set_position(0.0)
        await x.move_absolute(30.0, velocity=1.0)
        waiting = await x.move_absolute(2.0, buffer_mode=BufferMode.BUFFERED)

        with pytest.raises(TimeoutError):
            async with asyncio.timeout(8.0):
                await waiting.done()
        await rig.until("x", lambda state: state.command is None)
        given_up_at = await position_of(rig)
        await asyncio.sleep(60.0)

        assert (await outcome(rig, waiting.command_id)).status is CommandStatus.ABORTED
        assert await position_of(rig) == pytest.approx(given_up_at, abs=0.0011)


@pytest.mark.long
async def test_a_program_waits_for_as_long_as_what_it_waits_behind_takes():
    async with controlled() as (_, x):
        await x.power(on=True)
        await x.set_position(0.0)
        await x.move_absolute(30.0, velocity=1.0)

        state = await (await x.move_absolute(2.0, buffer_mode=BufferMode.BUFFERED)).done()

        assert state.position == pytest.approx(2.0, abs=0.05)


async def test_a_target_beyond_the_limits_is_refused_at_once_and_not_when_its_turn_comes():
    async with running_rig() as rig:
        await waiting_behind_a_long_move(rig)
        await rig.client.command("x", Halt())
        await rig.until("x", lambda state: state.command is None)
        await rig.client.command("x", SetPosition(position=0.0))
        await rig.client.command("x", MoveAbsolute(position=30.0, velocity=1.0))

        with pytest.raises(PositionLimit):
            await move(rig, 1e4, BufferMode.BUFFERED)


@pytest.mark.long
async def test_an_aborting_move_on_an_axis_that_takes_long_to_come_to_rest_is_answered_meanwhile():
    async with running_rig() as rig:
        await moving(rig, 0.0)
        await rig.until("x", lambda state: state.command is None)
        slow = MoveVelocity(velocity=20.0, acceleration=2.0)
        first = (await rig.client.command("x", slow)).command_id
        await asyncio.sleep(12.0)

        began_s = asyncio.get_running_loop().time()
        reply = await rig.client.command("x", MoveAbsolute(position=-5.0, buffer_mode=BufferMode.ABORTING))
        answered_s = asyncio.get_running_loop().time() - began_s
        await rig.client.wait_for_end("x", reply.command_id)

        assert answered_s < 4.0
        assert (await outcome(rig, first)).status is CommandStatus.ABORTED
        assert await position_of(rig) == pytest.approx(-5.0, abs=0.0011)


async def test_a_stop_also_ends_what_waits():
    async with running_rig() as rig:
        await moving(rig)

        async with asyncio.TaskGroup() as group:
            waiting = group.create_task(move(rig, 5.0, BufferMode.BUFFERED), name="waiting")
            await asyncio.sleep(0.1)
            await rig.client.stop("x")
        await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)

        assert (await outcome(rig, waiting.result())).status is CommandStatus.REFUSED
        assert await position_of(rig) > 5.5


async def test_an_aborting_move_on_a_standing_axis_is_like_any_other():
    async with running_rig() as rig:
        await rig.power_on("x")

        request = MoveVelocity(velocity=5.0, buffer_mode=BufferMode.ABORTING)
        await rig.client.command("x", request)

        assert (await rig.client.state("x")).state is AxisState.CONTINUOUS_MOTION


@pytest.mark.long
def test_the_command_line_waits_for_as_long_as_what_it_waits_behind_takes(monkeypatch):
    with virtual_rig(monkeypatch) as here:
        here.power_on("x")
        here.run("move x 30 --velocity 1")

        ran = here.run("move x 2 --buffer-mode buffered --wait")

        assert (ran.code, ran.errors) == (0, "")
        assert "accepted, waits until" in ran.printed
        assert "x: done, standstill at" in ran.printed.splitlines()[-1]
        assert here.wait(position_of(here.rig)) == pytest.approx(2.0, abs=0.0011)


@pytest.mark.long
def test_the_command_line_says_why_what_it_waited_for_did_not_begin(monkeypatch):
    with virtual_rig(monkeypatch) as here:
        here.power_on("x")
        here.run("move x 30 --velocity 1")

        async def halted_later():
            await asyncio.sleep(8.0)
            await here.rig.client.command("x", Halt())

        halting = here.wait(_begun(halted_later()))
        ran = here.run("move x 2 --buffer-mode buffered --wait")
        here.wait(halting)

        assert ran.code == 1
        assert "was overtaken by halt" in ran.errors


async def _begun(work):
    return asyncio.create_task(work)


async def test_a_distance_from_a_motion_at_a_velocity_is_taken_from_where_the_axis_is():
    """A PIC-SERVO SC goes on without a halt; the end of its motion in the drive is only there for a host that dies."""
    async with dialect_rig(SC) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=10.0))
        await asyncio.sleep(0.5)
        here = rig.position_mm
        reply = await rig.send(MoveRelative(distance=2.0, buffer_mode=BufferMode.ABORTING))
        assert reply.position == pytest.approx(here + 2.0, abs=1.0)
        await rig.rig.client.wait_for_end(AXIS, reply.command_id)

        assert rig.position_mm == pytest.approx(here + 2.0, abs=1.0)
