"""A fault keeps its name as long as the drive holds it, and is never given one that the drive does not have."""

import asyncio

import pytest

from ldcnd.contract.commands import MoveAbsolute, Power, Reset, SetPosition, Stop
from ldcnd.contract.errors import DriveFault, NotReferenced, WrongState
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.drives.ldcn.faults import FaultCode
from ldcnd.sim.ldcn.power import FaultCondition
from tests.support.dialect_rig import (
    AXIS,
    DIALECTS,
    GAINS,
    LS_173AP,
    LS_182AP,
    SC,
    V4,
    DialectRig,
    adopting_rig,
    dialect_rig,
)

FAR = MoveAbsolute(position=18.0, velocity=10.0)
LATCHED = {
    FaultCondition.STOP_INPUT: FaultCode.STOP_INPUT,
    FaultCondition.MOTOR_SHORT: FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE,
    FaultCondition.OVERHEAT: FaultCode.OVERHEAT,
    FaultCondition.OVERCURRENT: FaultCode.OVERCURRENT,
    FaultCondition.ENCODER_LOSS: FaultCode.ENCODER_OR_HALL,
}
latched = pytest.mark.parametrize("condition", LATCHED, ids=lambda condition: condition.value)
logosol = pytest.mark.parametrize("dialect", [LS_173AP, LS_182AP], ids=lambda dialect: dialect.name)


async def trip(rig: DialectRig, condition: FaultCondition) -> None:
    """Let something switch the moving motor off; it is over again when the drive has noticed."""
    await rig.power_on()
    await rig.send(FAR)
    await asyncio.sleep(0.3)
    rig.condition(condition)
    await rig.until_fault(lambda faults: faults.active)
    rig.condition(condition, present=False)


async def codes_later(rig: DialectRig) -> list[str]:
    """Return what the drive complains about after some more polls."""
    await asyncio.sleep(0.5)
    sample = await rig.until_fault(lambda _: True)
    return [fault.code for fault in sample.active]


@logosol
@latched
@pytest.mark.parametrize("command", [Stop(), Power(on=False)], ids=["stop", "power off"])
@pytest.mark.sweep(2)
async def test_a_stop_of_a_tripped_drive_leaves_the_fault_its_name(dialect, condition, command):
    async with dialect_rig(dialect) as rig:
        await trip(rig, condition)

        await rig.send(command)

        assert await codes_later(rig) == [LATCHED[condition]]


@pytest.mark.parametrize("dialect", [V4, SC, LS_182AP], ids=lambda dialect: dialect.name)
async def test_a_stop_after_a_position_error_leaves_the_fault_its_name(dialect):
    async with dialect_rig(dialect, gains=GAINS | {"el": 500}) as rig:
        await trip(rig, FaultCondition.STALLED)

        await rig.send(Stop())

        assert await codes_later(rig) == ["position_error"]
        await rig.send(Reset())
        assert await codes_later(rig) == []


async def test_a_position_that_was_lost_stays_lost_after_a_stop():
    async with dialect_rig(LS_182AP) as rig:
        await trip(rig, FaultCondition.ENCODER_LOSS)
        await rig.send(Stop())
        await asyncio.sleep(0.5)

        with pytest.raises(WrongState, match="its position is lost"):
            await rig.send(SetPosition(position=3.0))

        await rig.send(Reset())
        await rig.send(Power(on=True))
        with pytest.raises(NotReferenced):
            await rig.send(FAR)
        await rig.send(SetPosition(position=3.0))
        assert (await rig.rig.client.state(AXIS)).referenced


@latched
@pytest.mark.sweep(2)
async def test_a_second_without_the_cable_leaves_the_fault_its_name(condition):
    async with dialect_rig(LS_182AP) as rig:
        await trip(rig, condition)

        rig.chain.unplug(asyncio.get_running_loop().time(), 1.0)
        await rig.until(lambda state: state.link is LinkState.DOWN)
        await rig.until(lambda state: state.link is LinkState.UP)

        assert await codes_later(rig) == [LATCHED[condition]]


@pytest.mark.parametrize("condition", [*LATCHED, FaultCondition.STALLED], ids=lambda condition: condition.value)
@pytest.mark.sweep(2)
async def test_a_tripped_drive_that_is_taken_over_has_a_fault_without_a_cause(condition):
    async with dialect_rig(LS_182AP, gains=GAINS | {"el": 500}) as rig:
        await trip(rig, condition)
        await rig.until(lambda state: state.moving is not Moving.YES)  # else the daemon would stop it as it ends

    async with adopting_rig(LS_182AP, rig) as later:
        await later.until(lambda state: state.state is AxisState.ERROR_STOP)
        assert await codes_later(later) == ["latched_fault"]

        await later.send(Stop())
        assert await codes_later(later) == ["latched_fault"]

        await later.send(Reset())
        assert await codes_later(later) == []


async def stopped_after(rig: DialectRig, condition: FaultCondition) -> None:
    """Trip a drive and stop it: with its power driver off it hides a cause that is over, and holds it all the same."""
    await trip(rig, condition)
    await rig.until(lambda state: state.moving is not Moving.YES)
    await rig.send(Stop())


@pytest.mark.parametrize(
    ("dialect", "condition"),
    [(LS_182AP, condition) for condition in LATCHED] + [(each, FaultCondition.STALLED) for each in DIALECTS],
    ids=lambda each: each.name.lower(),
)
@pytest.mark.sweep(2)
async def test_one_reset_is_enough_for_a_tripped_drive_that_was_stopped_and_taken_over(dialect, condition):
    async with dialect_rig(dialect, gains=GAINS | {"el": 500}) as rig:
        await stopped_after(rig, condition)

    async with adopting_rig(dialect, rig) as later:
        await later.until(lambda state: state.link is LinkState.UP)
        await later.send(Stop())
        await later.send(Reset())

        await later.send(Power(on=True))

        assert (await later.rig.client.state(AXIS)).enabled


@pytest.mark.parametrize("dialect", [LS_173AP, LS_182AP], ids=lambda dialect: dialect.name)
@pytest.mark.sweep(2)
async def test_power_clears_no_fault_that_a_drive_hides_when_it_is_taken_over(dialect):
    async with dialect_rig(dialect, gains=GAINS | {"el": 500}) as rig:
        await stopped_after(rig, FaultCondition.STALLED)

    async with adopting_rig(dialect, rig) as later:
        await later.until(lambda state: state.state is AxisState.DISABLED)

        with pytest.raises(DriveFault, match="did not close its loop"):
            await later.send(Power(on=True))

        assert "position_error" in await codes_later(later)


async def test_nothing_is_said_of_a_drive_that_is_taken_over_switched_off():
    async with dialect_rig(LS_182AP) as rig:
        await rig.until(lambda state: state.state is AxisState.DISABLED)

    async with adopting_rig(LS_182AP, rig) as later:
        await later.until(lambda state: state.state is AxisState.DISABLED)
        assert await codes_later(later) == []
        await later.power_on()
        assert (await later.rig.client.state(AXIS)).enabled


@pytest.mark.parametrize("dialect", [V4, SC], ids=lambda dialect: dialect.name)
async def test_lost_motor_power_keeps_its_name_when_the_power_is_back(dialect):
    async with dialect_rig(dialect) as rig:
        await trip(rig, FaultCondition.MOTOR_POWER_OFF)

        assert await codes_later(rig) == ["power_lost"]


@pytest.mark.parametrize("dialect", [V4, SC], ids=lambda dialect: dialect.name)
async def test_motor_power_that_is_off_while_the_axis_is_disabled_stops_nothing(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.until(lambda state: state.state is AxisState.DISABLED)
        rig.condition(FaultCondition.MOTOR_POWER_OFF)
        sample = await rig.until_fault(lambda faults: faults.active)

        assert [(fault.code, fault.stops) for fault in sample.active] == [("power_lost", False)]
        await rig.send(Reset())
        assert (await rig.rig.client.state(AXIS)).state is AxisState.DISABLED
        rig.condition(FaultCondition.MOTOR_POWER_OFF, present=False)
        await rig.send(Power(on=True))
        assert (await rig.done(FAR)).last_error is None
