"""Each dialect through codec, simulated drive and daemon: enable, move, read back, home, stop, fault, recovery."""

import asyncio

import pytest

from ldcnd.contract.commands import Home, MoveAbsolute, MoveVelocity, Power, Reset
from ldcnd.contract.samples import AdcSample, AxisState, PositionSample, TelemetryItem, VelocitySample
from ldcnd.sim.ldcn.power import FaultCondition
from tests.support.dialect_rig import (
    AXIS,
    CMC,
    LS_173AP,
    LS_182AP,
    LS_182AP_22,
    PLANT,
    SC,
    V1,
    V2,
    V3,
    V4,
    Dialect,
    DialectRig,
    dialect_rig,
)

WIDE_INDEX = PLANT.model_copy(update={"index_width_counts": 40})


async def next_sample(rig: DialectRig, item: TelemetryItem):
    async with rig.rig.client.samples(AXIS, item) as samples:
        _, sample = await anext(samples)
    return sample


async def a_working_day(dialect: Dialect) -> None:
    """Take a drive of this dialect through all that a client does with it."""
    reports_position_error = dialect not in (V1, V2, V3, V4, CMC)
    full_scale = 1023 if dialect in (LS_182AP, LS_182AP_22) else 255
    async with dialect_rig(dialect, WIDE_INDEX) as rig:
        # identity and enabling
        (info,) = await rig.rig.client.axes()
        assert info.identity.endswith(f"version {dialect.version})")
        await rig.power_on()
        assert (await rig.until(lambda state: state.enabled)).state is AxisState.STANDSTILL

        # a move, and every item read back
        state = await rig.done(MoveAbsolute(position=-3.0))
        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        await asyncio.sleep(1.0)  # virtual
        assert rig.position_mm == pytest.approx(-3.0, abs=0.0021)
        position = await next_sample(rig, TelemetryItem.POSITION)
        assert isinstance(position, PositionSample)
        assert (position.value, position.counts) == (pytest.approx(-3.0, abs=0.0021), round(position.value * 1000))
        assert (position.following_error is not None) is reports_position_error
        adc = await next_sample(rig, TelemetryItem.ADC)
        assert isinstance(adc, AdcSample)
        assert adc.full_scale == full_scale

        # home
        state = await rig.done(Home(method="index", velocity=1.0, position=0.0))
        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)

        # stop in mid-move, forward velocities being positive
        await rig.send(MoveVelocity(velocity=10.0))
        await asyncio.sleep(0.5)
        velocity = await next_sample(rig, TelemetryItem.VELOCITY)
        assert isinstance(velocity, VelocitySample)
        assert velocity.value == pytest.approx(10.0, abs=2.1)
        assert (await rig.rig.client.stop(AXIS)).confirmed == (AXIS,)
        assert (await rig.until(lambda state: state.state is AxisState.STANDSTILL)).stop_latched
        await rig.send(Reset())

        # a fault, its recovery, and on with the work
        await rig.send(MoveAbsolute(position=0.0, velocity=2.0))
        condition = (
            FaultCondition.OVERHEAT if dialect in (LS_173AP, LS_182AP, LS_182AP_22) else FaultCondition.MOTOR_POWER_OFF
        )
        rig.condition(condition)
        faults = await rig.until_fault(lambda sample: sample.active)
        assert faults.first.code == ("overheat" if condition is FaultCondition.OVERHEAT else "power_lost")
        await rig.until(lambda state: state.state is AxisState.ERROR_STOP)
        rig.condition(condition, present=False)
        await rig.send(Reset())
        await rig.until(lambda state: state.state is AxisState.DISABLED)
        await rig.send(Power(on=True))
        state = await rig.done(MoveAbsolute(position=1.0))
        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)


async def test_pic_servo_v1():
    await a_working_day(V1)


async def test_pic_servo_v2():
    await a_working_day(V2)


async def test_pic_servo_v3():
    await a_working_day(V3)


async def test_pic_servo_v4():
    await a_working_day(V4)


async def test_pic_servo_cmc():
    await a_working_day(CMC)


async def test_pic_servo_sc():
    await a_working_day(SC)


async def test_ls_173ap():
    await a_working_day(LS_173AP)


async def test_ls_182ap():
    await a_working_day(LS_182AP)


async def test_ls_182ap_from_version_22_on():
    await a_working_day(LS_182AP_22)
