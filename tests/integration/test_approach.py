"""Moves that come to their goal from one side, where the mechanics have play."""

import asyncio

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Halt, MoveAbsolute, MoveRelative, MoveVelocity, Power, Stop
from ldcnd.contract.errors import PositionLimit
from ldcnd.contract.events import ReadEvents
from ldcnd.contract.questions import Preview
from ldcnd.contract.rig_commands import AxisMove, MoveTogether
from ldcnd.contract.samples import AxisState, LinkState
from tests.integration.test_path import plane, sc_chain
from tests.support.chain_rig import drive, rig_on
from tests.support.dialect_rig import AXIS, LS_182AP, SC, V4, dialect_rig

FROM_BELOW = {"direction": "positive", "distance": 0.5}
LIMITS = {"position_min": -10, "position_max": 10}
dialects = pytest.mark.parametrize("dialect", [V4, SC, LS_182AP], ids=lambda dialect: dialect.name)


async def watched(rig, command):
    """Send a move; return the lowest and the highest position on the way, and the state after it."""
    seen = [rig.position_mm]

    async def look():
        while True:
            rig.drive.catch_up(asyncio.get_running_loop().time())
            seen.append(rig.position_mm)
            await asyncio.sleep(0.005)

    async with asyncio.TaskGroup() as group:
        looking = group.create_task(look())
        state = await rig.done(command)
        await asyncio.sleep(0.2)
        looking.cancel()
    return min(seen), max(seen), state


@dialects
@pytest.mark.sweep(2)
async def test_every_goal_is_reached_from_below(dialect):
    async with dialect_rig(dialect, approach=FROM_BELOW) as rig:
        await rig.power_on()
        up = await watched(rig, MoveAbsolute(position=5.0))
        down = await watched(rig, MoveAbsolute(position=2.0))
        same = await watched(rig, MoveAbsolute(position=2.0))
        step = await watched(rig, MoveRelative(distance=0.1))
        back = await watched(rig, MoveRelative(distance=-0.1))

        assert up[1] == pytest.approx(5.0, abs=0.03)
        assert down[0] == pytest.approx(1.5, abs=0.03)
        assert same[0] == pytest.approx(2.0, abs=0.03)  # it is there already, from below
        assert step[0] == pytest.approx(2.0, abs=0.03)  # the play is taken up
        assert back[0] == pytest.approx(1.5, abs=0.03)
        assert rig.position_mm == pytest.approx(2.0, abs=0.01)
        assert [each[2].last_error for each in (up, down, same, step, back)] == [None] * 5


async def test_after_any_other_motion_the_play_is_taken_up_again():
    async with dialect_rig(LS_182AP, approach={"direction": "negative", "distance": 0.5}) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=5.0))
        await asyncio.sleep(0.5)
        await rig.done(Halt())
        here = rig.position_mm
        lowest, highest, _ = await watched(rig, MoveAbsolute(position=round(here - 0.1, 3)))

        assert highest == pytest.approx(here + 0.4, abs=0.05)
        assert lowest == pytest.approx(here - 0.1, abs=0.05)


@dialects
async def test_two_motions_are_one_command_with_one_target(dialect):
    async with dialect_rig(dialect, approach=FROM_BELOW) as rig:
        await rig.power_on()
        said = await rig.rig.client.ask(Preview(position=-3.0), AXIS)
        reply = await rig.send(MoveAbsolute(position=-3.0))
        await asyncio.sleep(0.1)
        first = await rig.rig.client.state(AXIS)
        await asyncio.sleep(said.duration_s - 0.15)
        last = await rig.rig.client.state(AXIS)
        await rig.rig.client.wait_for_end(AXIS, reply.command_id)
        events = [
            event for event in (await rig.rig.client.ask(ReadEvents())).events if event.command_id == reply.command_id
        ]

        assert (said.approach_from, said.position) == (pytest.approx(-3.5), pytest.approx(-3.0))
        assert reply.duration_s == pytest.approx(said.duration_s, rel=0.1)
        assert (first.command.command_id, first.command.target) == (reply.command_id, pytest.approx(-3.0))
        assert (last.command.command_id, last.state) == (reply.command_id, AxisState.DISCRETE_MOTION)
        assert [event.status for event in events][-1] == "done"
        assert sum(event.status == "done" for event in events) == 1


@pytest.mark.promise("approach-keeps-limits")
@pytest.mark.parametrize("ending", [Halt(), Stop()], ids=["halt", "stop"])
@pytest.mark.parametrize("after_s", [0.1, 0.55, 0.75])
@pytest.mark.sweep(2)
async def test_a_halt_or_a_stop_in_either_motion_ends_the_move(ending, after_s):
    async with dialect_rig(LS_182AP, approach=FROM_BELOW) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=-3.0, velocity=10.0))
        await asyncio.sleep(after_s)
        await rig.send(ending)
        await rig.until(lambda state: state.command is None)
        rig.drive.catch_up(asyncio.get_running_loop().time())
        stood = rig.position_mm
        await asyncio.sleep(2.0)
        rig.drive.catch_up(asyncio.get_running_loop().time())

        assert rig.position_mm == pytest.approx(stood, abs=0.02)


@dialects
async def test_an_aborting_move_in_mid_approach_goes_to_its_own_goal_from_below(dialect):
    async with dialect_rig(dialect, approach=FROM_BELOW) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=-6.0, velocity=10.0))
        await asyncio.sleep(0.3)
        lowest, _, state = await watched(rig, MoveAbsolute(position=-4.0, buffer_mode="aborting"))

        assert rig.position_mm == pytest.approx(-4.0, abs=0.02)
        assert state.last_error is None
        assert lowest > -6.2


async def falls_to(shaft, position):
    """Wait until the shaft has come down to a position, mm; return its place."""
    async with asyncio.timeout(60):
        while (place := shaft()) > position:
            await asyncio.sleep(0.002)
    return place


@pytest.mark.parametrize(("approach", "at"), [(FROM_BELOW, 8.0), (FROM_BELOW, 4.6), (None, 8.0)])
async def test_a_distance_counts_from_the_goal_of_a_move_wherever_that_is_on_its_way(approach, at):
    async with dialect_rig(SC, approach=approach) as rig:

        def shaft():
            rig.drive.catch_up(asyncio.get_running_loop().time())
            return rig.position_mm

        await rig.power_on()
        await rig.done(MoveAbsolute(position=10.0))
        await rig.send(MoveAbsolute(position=5.0, velocity=4.0))
        await falls_to(shaft, at)
        state = await rig.done(MoveRelative(distance=1.0, velocity=4.0, buffer_mode="aborting"))

        assert state.last_error is None
        assert shaft() == pytest.approx(6.0, abs=0.03)


async def test_a_move_in_the_place_of_one_of_a_group_comes_to_its_goal_from_below():
    """A group goes straight to its goal, which is below that of the move that follows."""
    document, chain = plane().model_dump(mode="json", exclude_unset=True), sc_chain()
    for axis in document["bus"][0]["axis"]:
        axis["approach"] = FROM_BELOW

    def shaft():
        return drive(chain, 1).shaft.position_counts / 1000

    async with rig_on(chain, RigConfig.model_validate(document)) as rig:
        for name in ("z", "c"):
            await rig.until(name, lambda state: state.link is LinkState.UP)
            await rig.client.command(name, Power(on=True))
        for goal in (10.0, 0.0):
            moves = tuple(AxisMove(axis=name, position=goal, velocity=4.0) for name in ("z", "c"))
            sent = (await rig.client.ask(MoveTogether(moves=moves))).replies
            if goal:
                for each in sent:
                    await rig.client.wait_for_end(each.axis, each.command_id)
        lowest = await falls_to(shaft, 6.0)
        over = await rig.client.command("z", MoveAbsolute(position=3.0, velocity=4.0, buffer_mode="aborting"))
        async with asyncio.TaskGroup() as group:
            ending = group.create_task(rig.client.wait_for_end("z", over.command_id))
            while not ending.done():
                lowest = min(lowest, shaft())
                await asyncio.sleep(0.002)
        state = ending.result()

        assert state.last_error is None
        assert lowest == pytest.approx(2.5, abs=0.03)
        assert shaft() == pytest.approx(3.0, abs=0.02)


@pytest.mark.promise("approach-keeps-limits")
async def test_an_approach_that_would_leave_the_limits_is_refused_and_nothing_moves():
    async with dialect_rig(LS_182AP, approach=FROM_BELOW, limits=LIMITS) as rig:
        await rig.power_on()
        with pytest.raises(PositionLimit):
            await rig.send(MoveAbsolute(position=-9.8))
        said = await rig.rig.client.ask(Preview(position=-9.8), AXIS)
        await asyncio.sleep(0.5)
        rig.drive.catch_up(asyncio.get_running_loop().time())

        assert said.refusal is not None
        assert rig.position_mm == pytest.approx(0.0, abs=0.01)
