"""Another program on the line stops or moves an axis: nothing goes on by itself, and distances count from there."""

import asyncio

import pytest

from ldcnd.contract.commands import Jog, MoveAbsolute, MoveAnalog, MoveRelative
from ldcnd.contract.errors import LdcndError, OutcomeUnknown
from ldcnd.contract.events import CommandStatus, ReadOutcome
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.contract.samples import AxisState, Moving
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.received import LoadTrajectory, PlainCommand, ReceivedCommand, StopMotor
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from tests.support.dialect_rig import AXIS, LS_182AP_22, SC, V4, DialectRig, dialect_rig

dialects = pytest.mark.parametrize("dialect", [V4, SC, LS_182AP_22], ids=lambda each: each.name)
STANDS_MM = 0.05
"""A loop hunts by as much."""


def now_s() -> float:
    return asyncio.get_running_loop().time()


def place(here: DialectRig) -> float:
    here.drive.catch_up(now_s())
    return here.position_mm


def stopped_by_another(here: DialectRig) -> None:
    here.drive.catch_up(now_s())
    here.drive.execute(StopMotor(StopControl.AMP_ENABLE | StopControl.SMOOTH, None))


@dialects
async def test_no_move_of_a_chain_begins_behind_one_that_was_stopped(dialect):
    async with dialect_rig(dialect) as here:
        await here.power_on()
        await here.send(MoveAbsolute(position=15.0, velocity=5.0))
        behind = [
            await here.send(MoveAbsolute(position=16.0, velocity=5.0, buffer_mode="buffered")),
            await here.send(MoveRelative(distance=-4.0, velocity=5.0, buffer_mode="buffered")),
            await here.send(MoveAbsolute(position=10.0, velocity=5.0, buffer_mode="buffered")),
        ]
        await asyncio.sleep(1.0)
        stopped_by_another(here)
        await asyncio.sleep(0.5)
        stands = place(here)
        await asyncio.sleep(6.0)
        went_on = abs(place(here) - stands)
        outcomes = [await here.rig.client.ask(ReadOutcome(command_id=each.command_id)) for each in behind]

    assert 2.0 < stands < 8.0
    assert went_on < STANDS_MM
    assert {each.status for each in outcomes} <= {CommandStatus.ABORTED, CommandStatus.REFUSED}


@pytest.mark.parametrize("dialect", [SC, LS_182AP_22], ids=lambda each: each.name)  # another one is switched off
@pytest.mark.parametrize("after_s", [0.3, 3.0])
async def test_a_distance_counts_from_where_a_move_was_stopped(dialect, after_s):
    async with dialect_rig(dialect) as here:
        await here.power_on()
        await here.send(MoveAbsolute(position=15.0, velocity=5.0))
        await asyncio.sleep(1.0)
        stopped_by_another(here)
        await asyncio.sleep(after_s)
        stands = place(here)
        await here.done(MoveRelative(distance=1.0, velocity=5.0, buffer_mode="aborting"))
        went = place(here) - stands

    assert went == pytest.approx(1.0, abs=0.3)  # it comes to rest meanwhile


@pytest.mark.parametrize("after_s", [0.1, 0.5])
async def test_a_speed_override_sets_nothing_off_that_was_stopped(after_s):
    async with dialect_rig(SC, rates={"position": 2, "state": 2}) as here:
        await here.power_on()
        await here.send(MoveAbsolute(position=15.0, velocity=5.0))
        await asyncio.sleep(1.0)
        stopped_by_another(here)
        await asyncio.sleep(after_s)
        await here.rig.client.ask(SetSpeedOverride(percent=90))
        await asyncio.sleep(0.2)
        stands = place(here)
        await asyncio.sleep(4.0)
        went_on = abs(place(here) - stands)

    assert 2.0 < stands < 8.0
    assert went_on < STANDS_MM


@dialects
async def test_a_jog_that_is_held_ends_where_it_was_stopped(dialect):
    async with dialect_rig(dialect) as here:
        await here.power_on()
        jog = Jog(velocity=4.0, hold_s=1.0)
        begun = await here.send(jog)
        await asyncio.sleep(0.7)
        stopped_by_another(here)
        await asyncio.sleep(0.2)
        stands = place(here)
        code = None
        for _ in range(12):
            await asyncio.sleep(0.25)
            try:
                await here.send(jog.model_copy(update={"renews": begun.command_id}))
            except LdcndError as error:
                code = error.code
                break
        went_on = abs(place(here) - stands)
        outcome = await here.rig.client.ask(ReadOutcome(command_id=begun.command_id))

    assert code == "lease_expired"
    assert went_on < STANDS_MM
    assert (outcome.status, "another program has stopped it" in outcome.reason) == (CommandStatus.FAILED, True)


@pytest.mark.parametrize("dialect", [SC, LS_182AP_22], ids=lambda each: each.name)  # others tell no following error
async def test_a_distance_counts_from_where_a_motion_between_two_polls_has_led(dialect):
    async with dialect_rig(dialect, rates={"position": 1, "state": 1}) as here:
        await here.power_on()
        await here.done(MoveAbsolute(position=5.0))
        here.drive.catch_up(now_s())
        here.drive.execute(
            LoadTrajectory(
                Trajectory(
                    position=here.drive.loop.position + 800,
                    velocity=1 << 18,
                    acceleration=2000,
                    servo=True,
                    mode=ProfileMode.TRAPEZOIDAL,
                    start_now=True,
                )
            )
        )
        await asyncio.sleep(3.0)
        await here.until(lambda state: state.moving is Moving.NO)
        stands = place(here)
        await here.done(MoveRelative(distance=1.0))
        went = place(here) - stands

    assert stands == pytest.approx(5.8, abs=STANDS_MM)
    assert went == pytest.approx(1.0, abs=STANDS_MM)


async def test_an_analog_move_that_was_stopped_has_not_reached_its_target():
    async with dialect_rig(LS_182AP_22) as here:
        await here.power_on()
        begun = await here.send(MoveAnalog(target=700, velocity=5.0))
        await asyncio.sleep(0.7)
        stopped_by_another(here)
        await here.rig.client.wait_for_end(AXIS, begun.command_id)
        outcome = await here.rig.client.ask(ReadOutcome(command_id=begun.command_id))

    assert (outcome.status, "another program has stopped it" in outcome.reason) == (CommandStatus.FAILED, True)


@pytest.mark.parametrize("target", [700, 300])
async def test_an_analog_move_whose_start_was_not_executed_is_not_done(target):
    async with dialect_rig(LS_182AP_22) as here:
        await here.power_on()
        execute = here.drive.execute

        def hold_back(command: ReceivedCommand) -> None:
            if command == PlainCommand(CommandCode.START_MOTION):
                here.drive.execute = execute
            else:
                execute(command)

        here.drive.execute = hold_back
        with pytest.raises(OutcomeUnknown, match="shows no sign of it"):
            await here.send(MoveAnalog(target=target, velocity=5.0))
        state = await here.until(lambda state: state.command is None)

    assert state.state is AxisState.STANDSTILL
    assert "no sign of it" in state.last_error
