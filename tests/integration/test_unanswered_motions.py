"""Motions of which a program does not know what became of them: they count as under way, and are halted.

The axes would run on when control ends (`loss.client`): what stands here was halted by its program.
"""

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import pytest

import ldcnd
from ldcnd.client.axis import Axis
from ldcnd.client.events import latest_events
from ldcnd.client.rig import Rig
from ldcnd.config.rig import RigConfig
from ldcnd.contract.errors import OutcomeUnknown, PositionLimit, WrongState
from ldcnd.contract.leases import Acquire
from ldcnd.contract.samples import LinkState, Moving
from ldcnd.testing import simulated_rig
from tests.support.chain_rig import simulated_config
from tests.support.lost_answers import losing
from tests.support.rig import RunningRig, running_rig

RUNS_ON = simulated_config({"loss": {"client": "run_to_target"}}, group=[{"name": "gantry", "axes": ["x", "y"]}])
FAR, NEAR = 90.0, 45.0
"""Where the axes are sent to; none that is halted comes half as far."""
SPEED = 5.0


@asynccontextmanager
async def program_rig(config: RigConfig = RUNS_ON) -> AsyncIterator[tuple[RunningRig, Rig]]:
    async with running_rig(config) as running:
        for name in running.daemon.rig.axes:
            await running.until(name, lambda state: state.link is LinkState.UP)
        yield running, Rig(running.client, await running.client.daemon())


async def came_to_rest(running: RunningRig, axis: str = "x") -> float:
    """Wait until an axis has come to rest, and return where its shaft is."""
    await running.until(axis, lambda state: state.moving is Moving.NO and state.command is None)
    return running.lives.truth(axis).position


async def begins_to_move(running: RunningRig, axis: str = "x") -> None:
    await running.until(axis, lambda state: state.moving is Moving.YES)


async def run_out_of_time(x: Axis) -> None:
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(1.0):
            await x.move_absolute(FAR, velocity=SPEED)


async def be_cancelled(x: Axis) -> None:
    moving = asyncio.create_task(x.move_absolute(FAR, velocity=SPEED))
    await asyncio.sleep(1.0)
    moving.cancel()
    with pytest.raises(asyncio.CancelledError):
        await moving


async def be_cancelled_twice(x: Axis) -> None:
    moving = asyncio.create_task(x.move_absolute(FAR, velocity=SPEED))
    await asyncio.sleep(1.0)
    moving.cancel()
    await asyncio.sleep(0)
    moving.cancel()
    with pytest.raises(asyncio.CancelledError):
        await moving


async def get_no_answer(x: Axis) -> None:
    with pytest.raises(OutcomeUnknown):
        await x.move_absolute(FAR, velocity=SPEED)


@pytest.mark.parametrize("ending", [run_out_of_time, be_cancelled, be_cancelled_twice, get_no_answer])
async def test_a_motion_is_halted_whose_answer_is_not_waited_for_while_control_goes_on(ending):
    async with program_rig() as (running, rig), rig.control("x", client="ann") as x:
        await x.power(on=True)
        with losing(running.session, answers={"move_absolute"}):
            await ending(x)
        place = await came_to_rest(running)
        moved = await x.move_absolute(0.0)
        await moved.done()

    assert 1 < place < FAR / 2
    assert moved.ended.position == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize("shared", [False, True], ids=["own control", "lease hold"])
@pytest.mark.parametrize("leaving", ["exception", "end"])
async def test_a_motion_without_an_answer_is_halted_when_its_context_ends(leaving: str, shared):
    async with program_rig() as (running, rig):
        if shared:
            lease = await running.client.ask(Acquire(client="hold", axes=("x",), lease_s=60.0))
            running.client.lease = lease.lease
        with losing(running.session, answers={"move_absolute"}):
            with suppress(ZeroDivisionError):
                async with rig.control("x", client="ann") as x:
                    await x.power(on=True)
                    moving = asyncio.create_task(x.move_absolute(FAR, velocity=SPEED))
                    await begins_to_move(running)
                    if leaving == "exception":
                        raise ZeroDivisionError
            place = await came_to_rest(running)
            moving.cancel()
            await asyncio.gather(moving, return_exceptions=True)

    assert place < 10  # long before the wait for the answer would have ended


async def test_a_halt_that_did_not_arrive_is_given_again_when_control_ends():
    async with program_rig() as (running, rig):
        async with rig.control("x", client="ann") as x:
            await x.power(on=True)
            with losing(running.session, answers={"move_absolute"}, commands={"halt"}):
                await run_out_of_time(x)
        place = await came_to_rest(running)

    assert place < FAR / 2


@pytest.mark.parametrize("how", ["out of time", "no answer"])
async def test_the_members_of_a_group_are_halted_whose_start_has_no_answer(how: str):
    async with program_rig() as (running, rig), rig.control("x", "y", client="ann") as (x, y):
        for each in (x, y):
            await each.power(on=True)
        with losing(running.session, answers={"move_together"}), suppress(TimeoutError, OutcomeUnknown):
            async with asyncio.timeout(1.0 if how == "out of time" else None):
                await rig.move_together({"x": FAR, "y": NEAR}, velocity=2.0)
        places = [await came_to_rest(running, name) for name in ("x", "y")]

    assert 1 < places[0] < FAR / 2
    assert 1 < places[1] < NEAR - 5


async def test_a_motion_that_is_refused_or_was_not_sent_halts_nothing():
    async with program_rig() as (running, rig), rig.control("x", client="ann") as x:
        await x.power(on=True)
        under_way = await x.move_absolute(5.0, velocity=SPEED)
        with pytest.raises(WrongState):
            await x.move_absolute(1.0)
        with pytest.raises(PositionLimit):
            await x.move_absolute(1000.0, buffer_mode="aborting")
        unsent = asyncio.create_task(x.move_absolute(1.0))
        unsent.cancel()
        await asyncio.gather(unsent, return_exceptions=True)
        state = await under_way.done()
        events = await latest_events(running.client, 100, "x")

    assert state.position == pytest.approx(5, abs=0.02)
    assert [event.verb for event in events if event.verb == "halt"] == []


async def test_an_exception_halts_at_once_also_where_no_question_is_answered():
    async with program_rig() as (running, rig):
        with losing(running.session, answers={"outcome"}):
            with pytest.raises(ZeroDivisionError):  # noqa: PT012 - raised where the program is
                async with rig.control("x", client="ann") as x:
                    await x.power(on=True)
                    await x.move_absolute(FAR, velocity=20)
                    await begins_to_move(running)
                    seen_at = running.lives.truth("x").position
                    raise ZeroDivisionError
            place = await came_to_rest(running)

    assert place - seen_at < 10


async def test_a_motion_that_its_program_has_halted_is_halted_once():
    async with program_rig() as (running, rig):
        with pytest.raises(TimeoutError):  # noqa: PT012 - raised where the program is
            async with rig.control("x", client="ann") as x:
                await x.power(on=True)
                move = await x.move_absolute(FAR, velocity=20)
                async with asyncio.timeout(1.0):
                    await move.done()
        await came_to_rest(running)
        events = await latest_events(running.client, 100, "x")

    assert len({event.command_id for event in events if event.verb == "halt"}) == 1
    assert [event.status for event in events if event.verb == "halt"][-1] == "done"


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt, SystemExit])
async def test_an_exception_that_leaves_a_context_of_the_blocking_client_halts_its_axis(error):
    def program() -> None:
        with suppress(error), ldcnd.connect_blocking() as rig, rig.control("x", client="ann") as x:
            x.power(on=True)
            x.move_absolute(FAR, velocity=SPEED)
            time.sleep(1.0)
            raise error

    async with simulated_rig(RUNS_ON) as rig:
        await rig.run_blocking(program)
        await rig.at_rest("x")
        place = rig.truth("x").position

    assert 1 < place < 10


async def test_a_context_of_the_blocking_client_that_ends_leaves_its_axis_to_the_policy():
    def program() -> None:
        with ldcnd.connect_blocking() as rig, rig.control("x", client="ann") as x:
            x.power(on=True)
            x.move_absolute(FAR, velocity=50.0)

    async with simulated_rig(RUNS_ON) as rig:
        with pytest.warns(ldcnd.UnfinishedMotion):
            await rig.run_blocking(program)
        await rig.at_rest("x")
        place = rig.truth("x").position

    assert place == pytest.approx(FAR, abs=0.05)


@pytest.mark.parametrize("ending", ["exception", "halt", "stop"])
async def test_an_axis_that_its_program_has_halted_comes_to_rest_before_control_is_given_back(ending):
    config = simulated_config({"loss": {"client": "power_off"}, "acceleration": 4.0, "reference": "at_reset"})
    async with program_rig(config) as (running, rig):
        with suppress(ZeroDivisionError):
            async with rig.control("x", client="test") as x:
                await x.power(on=True)
                await x.move_absolute(FAR, velocity=SPEED)
                await asyncio.sleep(3.0)
                if ending == "exception":
                    raise ZeroDivisionError
                await (x.halt() if ending == "halt" else x.stop())
        await came_to_rest(running)
        state = await running.client.state("x")

    assert state.enabled
