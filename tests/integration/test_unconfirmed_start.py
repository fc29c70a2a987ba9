"""A motion whose start was not confirmed is begun by nothing that follows: who was told so may be at the machine."""

import asyncio

import pytest

from ldcnd.contract.commands import Home, HomeMethod, Jog, MoveAbsolute, MoveVelocity
from ldcnd.contract.errors import OutcomeUnknown
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.contract.samples import AxisState, Moving
from ldcnd.drives.ldcn.commands import CommandCode
from tests.support.dialect_rig import AXIS, LS_182AP, SC, V4, Dialect, DialectRig, dialect_rig

APPROACH = {"distance": 2.0, "direction": "positive"}
STILL_MM = 0.05
dialects = pytest.mark.parametrize("dialect", [SC, V4, LS_182AP], ids=lambda dialect: dialect.name)


def lose_next(
    rig: DialectRig, monkeypatch: pytest.MonkeyPatch, code: CommandCode = CommandCode.START_MOTION, *, heard: bool
) -> None:
    """Have the next packet of a kind unconfirmed: the drive has not heard it, or its reply is lost."""
    bus = rig.rig.daemon.rig.buses[0].bus
    execute, lost = bus.execute, []

    async def lose(exchange, *lanes, **options):
        if exchange.request[2] & 0x0F != code or lost:
            return await execute(exchange, *lanes, **options)
        lost.append(exchange)
        if heard:
            await execute(exchange, *lanes, **options)
        raise OutcomeUnknown("the reply was lost")

    monkeypatch.setattr(bus, "execute", lose)


@dialects
@pytest.mark.parametrize(
    "request_",
    [
        MoveAbsolute(position=20.0, velocity=10.0),
        MoveAbsolute(position=-20.0, velocity=10.0),
        MoveVelocity(velocity=10.0),
        Jog(velocity=10.0, hold_s=1.0),
        Home(method=HomeMethod.INDEX, velocity=0.5, timeout_s=2.0),
    ],
    ids=["move", "approach", "velocity", "jog", "home"],
)
@pytest.mark.parametrize("after_s", [0.1, 1.0])
async def test_what_did_not_begin_begins_with_no_other_speed_and_no_later_step(
    dialect: Dialect, request_, after_s, monkeypatch
):
    async with dialect_rig(dialect, approach=APPROACH) as rig:
        await rig.power_on()
        lose_next(rig, monkeypatch, heard=False)
        with pytest.raises(OutcomeUnknown):
            await rig.send(request_)
        await asyncio.sleep(after_s)
        told = await rig.rig.client.state(AXIS)
        await rig.rig.client.ask(SetSpeedOverride(percent=50.0))
        await asyncio.sleep(3.0)
        state = await rig.until(lambda state: state.command is None)

    assert abs(rig.position_mm) < STILL_MM
    assert told.moving is (Moving.UNKNOWN if told.command and told.state is not AxisState.STOPPING else Moving.NO)
    assert state.state is AxisState.STANDSTILL
    assert state.last_error


@dialects
async def test_an_approach_that_began_unconfirmed_goes_on_to_its_goal(dialect: Dialect, monkeypatch):
    async with dialect_rig(dialect, approach=APPROACH) as rig:
        await rig.power_on()
        lose_next(rig, monkeypatch, heard=True)
        with pytest.raises(OutcomeUnknown):
            await rig.send(MoveAbsolute(position=-5.0, velocity=10.0))
        await rig.until(lambda state: state.command is None)

    assert rig.position_mm == pytest.approx(-5.0, abs=STILL_MM)


@dialects
async def test_a_jog_that_began_unconfirmed_ends_with_its_hold(dialect: Dialect, monkeypatch):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        lose_next(rig, monkeypatch, heard=True)
        with pytest.raises(OutcomeUnknown):
            await rig.send(Jog(velocity=10.0, hold_s=1.0))
        state = await rig.until(lambda state: state.command is None)

    assert (state.state, rig.position_mm < 11.0) == (AxisState.STANDSTILL, True)
