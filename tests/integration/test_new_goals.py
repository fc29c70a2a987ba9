"""PIC-SERVO SC takes a new goal in mid-move; other drives are halted first."""

import asyncio

import pytest

from ldcnd.contract.commands import BufferMode, MoveAbsolute, MoveRelative, MoveVelocity, Reset
from ldcnd.contract.errors import RequestRefused, StopLatched, WrongState
from ldcnd.contract.samples import Moving
from ldcnd.drives.ldcn.packet import CommandCode, PacketReader
from ldcnd.line.flight_recorder import WireEvent
from tests.support.dialect_rig import AXIS, LS_182AP, SC, V4, DialectRig, dialect_rig


def stops(rig: DialectRig) -> int:
    reader = PacketReader()
    records = rig.rig.daemon.rig.buses[0].bus.wire_log.records()
    data = b"".join(record.data for record in records if record.event is WireEvent.SENT and record.data)
    received = [reader.feed(byte) for byte in data]
    return sum(each is not None and each.packet.command is CommandCode.STOP_MOTOR for each in received)


@pytest.mark.parametrize(
    ("then", "ends_at"),
    [
        (MoveAbsolute(position=18.0, buffer_mode="aborting"), 18.0),
        (MoveAbsolute(position=-5.0, velocity=5.0, buffer_mode="aborting"), -5.0),
        (MoveRelative(distance=2.0, buffer_mode="aborting"), 12.0),
    ],
)
@pytest.mark.sweep(2)
async def test_an_sc_goes_on_to_the_new_goal_without_a_halt(then, ends_at):
    async with dialect_rig(SC) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=10.0, velocity=10.0))
        await asyncio.sleep(0.4)
        before = stops(rig)

        done = await rig.done(then)
        assert stops(rig) == before
        assert done.last_error is None
        assert rig.position_mm == pytest.approx(ends_at, abs=0.05)


async def test_a_jog_of_an_sc_becomes_a_move_without_a_halt():
    async with dialect_rig(SC) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=5.0))
        await asyncio.sleep(0.4)
        before = stops(rig)

        await rig.done(MoveAbsolute(position=12.0, buffer_mode="aborting"))

        assert stops(rig) == before
        assert rig.position_mm == pytest.approx(12.0, abs=0.05)


async def test_a_move_of_an_sc_is_refused_in_mid_move_unless_it_says_so():
    async with dialect_rig(SC) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=10.0, velocity=10.0))

        with pytest.raises(WrongState):
            await rig.send(MoveAbsolute(position=5.0))


async def test_another_drive_is_halted_first():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=10.0, velocity=10.0))
        await asyncio.sleep(0.4)
        before = stops(rig)

        await rig.done(MoveAbsolute(position=-5.0, velocity=10.0, buffer_mode="aborting"))

        assert stops(rig) == before + 1
        assert rig.position_mm == pytest.approx(-5.0, abs=0.05)


async def test_the_switch_ahead_stops_an_sc_that_turns_round_too_late():
    async with dialect_rig(SC, limit_switches="stop", start_counts=18_000.0) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=10.0, velocity=20.0, acceleration=100.0))
        await asyncio.sleep(0.19)
        turned = rig.position_mm
        assert turned < 20.0

        state = await rig.done(MoveAbsolute(position=-1.0, acceleration=100.0, buffer_mode="aborting"))

        assert state.last_error is not None
        assert "forward limit switch" in state.last_error


@pytest.mark.parametrize("dialect", [SC, LS_182AP], ids=lambda each: each.name)
@pytest.mark.parametrize("pace_s", [0.0, 0.001, 0.005, 0.02, 0.3])
@pytest.mark.parametrize(
    ("first", "goals"),
    [(BufferMode.REFUSE, (7.0, 2.0)), (BufferMode.ABORTING, (7.0, 2.0)), (BufferMode.ABORTING, (7.0, 7.5, -3, 9, 2.0))],
)
@pytest.mark.sweep(4)
async def test_the_newest_of_several_goals_wins_at_whatever_pace_they_come(dialect, pace_s, first, goals):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        async with asyncio.TaskGroup() as group:
            for number, goal in enumerate(goals):
                move = MoveAbsolute(position=goal, buffer_mode=BufferMode.ABORTING if number else first)
                sent = group.create_task(refused_or_id(rig, move), name=f"to {goal}")
                await asyncio.sleep(pace_s)

        assert await sent
        await rig.rig.client.wait_for_end(AXIS, sent.result())
        await rig.until(lambda state: state.moving is Moving.NO)
        assert rig.position_mm == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("dialect", [SC, LS_182AP], ids=lambda each: each.name)
@pytest.mark.parametrize("pace_s", [0.0, 0.005])
async def test_the_newest_of_several_goals_wins_in_mid_move(dialect, pace_s):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=7.0))
        await asyncio.sleep(0.3)
        async with asyncio.TaskGroup() as group:
            for goal in (7.5, 6.0, 2.0):
                move = MoveAbsolute(position=goal, buffer_mode=BufferMode.ABORTING)
                sent = group.create_task(refused_or_id(rig, move), name=f"to {goal}")
                await asyncio.sleep(pace_s)

        assert await sent
        await rig.rig.client.wait_for_end(AXIS, sent.result())
        assert rig.position_mm == pytest.approx(2.0, abs=0.05)


async def test_a_goal_beyond_the_limits_disturbs_none_that_was_sent_just_before_it():
    async with dialect_rig(LS_182AP, limits={"position_max": 10}) as rig:
        await rig.power_on()
        async with asyncio.TaskGroup() as group:
            sent = group.create_task(refused_or_id(rig, MoveAbsolute(position=3.0)), name="good")
            await asyncio.sleep(0)
            far = MoveAbsolute(position=11, buffer_mode=BufferMode.ABORTING)
            beyond = group.create_task(refused_or_id(rig, far), name="beyond the limits")

        assert beyond.result() is None
        await rig.rig.client.wait_for_end(AXIS, sent.result())
        assert rig.position_mm == pytest.approx(3.0, abs=0.05)


async def refused_or_id(rig: DialectRig, move: MoveAbsolute) -> str | None:
    try:
        return (await rig.send(move)).command_id
    except RequestRefused:
        return None


@pytest.mark.promise("stop-in-any-state")
@pytest.mark.parametrize("dialect", [SC, LS_182AP])
@pytest.mark.parametrize("mode", ["buffered", "aborting"])
async def test_a_move_that_comes_while_a_stop_is_latched_does_not_wait_for_its_reset(dialect, mode):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=30.0, velocity=20.0))
        await asyncio.sleep(0.5)
        await rig.rig.client.stop(AXIS)
        with pytest.raises(StopLatched):  # it decelerates yet
            await rig.send(MoveRelative(distance=5.0, buffer_mode=mode))
        while True:
            try:
                await rig.send(Reset())
                break
            except RequestRefused:
                await asyncio.sleep(0.005)
        before = rig.position_mm
        await asyncio.sleep(2.0)

        assert rig.position_mm == pytest.approx(before, abs=0.05)
