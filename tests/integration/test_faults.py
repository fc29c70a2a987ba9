"""Every fault of the manuals' tables, from the simulated cause to the fault topic and back; on the jumping clock."""

import asyncio
from contextlib import asynccontextmanager

import pytest

from ldcnd.contract.commands import (
    Home,
    HomeMethod,
    HomeStop,
    MoveAbsolute,
    MoveAnalog,
    MoveRelative,
    Power,
    Reset,
    SetGains,
    SetPosition,
    SetPwm,
)
from ldcnd.contract.errors import DriveFault, NotReferenced, WrongState
from ldcnd.contract.questions import Why
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.drives.ldcn.faults import FaultCode, LdcnFault
from ldcnd.sim.ldcn.power import FaultCondition
from tests.support.dialect_rig import (
    AXIS,
    DIALECTS,
    GAINS,
    LS_173AP,
    LS_182AP,
    LS_182AP_22,
    PLANT,
    SC,
    V1,
    V4,
    adopting_rig,
    dialect_rig,
)

LOGOSOL = (LS_173AP, LS_182AP, LS_182AP_22)
FAR = MoveAbsolute(position=18.0, velocity=10.0)


def named(dialects):
    return pytest.mark.parametrize("dialect", dialects, ids=lambda dialect: dialect.name)


def remembered(code):
    """Return what is said of a cause that has switched the motor off and may be gone by now."""
    return LdcnFault(code, latched=True).remedy


def codes(sample):
    return [fault.code for fault in sample.active]


# -- the table of Logosol drives, Pic_ae = 1: what switched the power driver off ---------------------------------------


@named(LOGOSOL)
@pytest.mark.parametrize(
    ("condition", "code"),
    [
        (FaultCondition.STOP_INPUT, FaultCode.STOP_INPUT),
        (FaultCondition.MOTOR_SHORT, FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE),
        (FaultCondition.OVERVOLTAGE, FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE),
        (FaultCondition.OVERHEAT, FaultCode.OVERHEAT),
        (FaultCondition.OVERCURRENT, FaultCode.OVERCURRENT),
        (FaultCondition.ENCODER_LOSS, FaultCode.ENCODER_OR_HALL),
    ],
)
@pytest.mark.sweep(3)
async def test_what_switches_the_power_driver_off_is_named_and_recovered_from(dialect, condition, code):
    lost = code is FaultCode.ENCODER_OR_HALL
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        await rig.send(FAR)
        await asyncio.sleep(0.5)

        rig.condition(condition)
        sample = await rig.until_fault(lambda faults: faults.active)
        state = await rig.until(lambda state: state.state is AxisState.ERROR_STOP)

        assert (codes(sample), sample.first.code, sample.first.source) == ([code], code, "drive")
        assert (sample.first.text, sample.first.stops) == (remembered(code), True)
        assert (state.enabled, state.command, state.last_error) == (
            False,
            None,
            f"move_absolute: the drive reports a fault{'; its position is lost' * lost}",
        )
        with pytest.raises(WrongState) as refusal:
            await rig.send(FAR)
        assert remembered(code) in refusal.value.message

        rig.condition(condition, present=False)
        await rig.send(Reset())
        recovered = await rig.until(lambda state: state.state is AxisState.DISABLED)
        assert (await rig.until_fault(lambda faults: not faults.active)).first is None
        assert not recovered.enabled
        await rig.until(lambda state: state.moving is Moving.NO)
        await rig.send(Power(on=True))
        if lost:
            return
        assert (await rig.done(FAR)).state is AxisState.STANDSTILL


# -- Pic_ae = 0: what is wrong at present ------------------------------------------------------------------------------


@named(LOGOSOL)
@pytest.mark.parametrize(
    ("condition", "code"),
    [
        (FaultCondition.STOP_INPUT, FaultCode.STOP_INPUT),
        (FaultCondition.OVERVOLTAGE, FaultCode.OVERVOLTAGE),
        (FaultCondition.OVERHEAT, FaultCode.OVERHEAT),
    ],
)
@pytest.mark.sweep(2)
async def test_what_is_wrong_with_the_power_driver_off_is_named(dialect, condition, code):
    async with dialect_rig(dialect) as rig:
        await rig.until(lambda state: state.state is AxisState.DISABLED)

        rig.condition(condition)
        sample = await rig.until_fault(lambda faults: faults.active)

        assert (codes(sample), sample.first.text) == ([code], code.remedy)
        with pytest.raises(DriveFault) as refusal:
            await rig.send(Reset())
        assert code.remedy in refusal.value.message
        rig.condition(condition, present=False)
        await rig.send(Reset())
        assert (await rig.until(lambda state: state.state is AxisState.DISABLED)).state is AxisState.DISABLED


async def test_too_high_a_supply_is_not_called_a_missing_one_and_its_end_moves_nothing():
    """A PIC-SERVO SC lets its amplifier go and keeps its loop closed: its motion would go on by itself."""
    async with dialect_rig(SC) as rig:
        await rig.power_on()
        await rig.send(FAR)
        await asyncio.sleep(0.5)

        rig.condition(FaultCondition.OVERVOLTAGE)
        sample = await rig.until_fault(lambda faults: faults.active)
        await rig.until(lambda state: not state.enabled)
        await rig.until(lambda state: state.moving is Moving.NO)
        stands = rig.position_mm
        rig.condition(FaultCondition.OVERVOLTAGE, present=False)
        await asyncio.sleep(1.0)

        assert codes(sample) == [FaultCode.OVERVOLTAGE]
        assert rig.position_mm == pytest.approx(stands, abs=0.05)


# -- position error and sensor fault -----------------------------------------------------------------------------------


@named(DIALECTS)
@pytest.mark.sweep(2)
async def test_a_jam_ends_in_a_position_error(dialect):
    async with dialect_rig(dialect, gains=GAINS | {"el": 500}) as rig:
        await rig.power_on()
        await rig.send(FAR)
        await asyncio.sleep(0.5)

        rig.condition(FaultCondition.STALLED)
        sample = await rig.until_fault(lambda faults: faults.active)

        assert (codes(sample), sample.first.text) == (["position_error"], FaultCode.POSITION_ERROR.remedy)
        why = await rig.rig.client.ask(Why(), AXIS)
        assert (why.causes[0].code, why.causes[0].remedy) == (
            "drive_fault",
            "look at it, for it may move unseen; remove the cause, then send reset",
        )
        assert (await rig.until(lambda state: state.state is AxisState.ERROR_STOP)).enabled is False
        rig.condition(FaultCondition.STALLED, present=False)
        await rig.send(Reset())
        await rig.send(Power(on=True))
        with pytest.raises(NotReferenced):  # an encoder that is dead shows the same as a jam
            await rig.send(FAR)
        assert (await rig.done(MoveRelative(distance=1.0))).state is AxisState.STANDSTILL


@named((LS_182AP, V4))
async def test_an_axis_that_may_be_stopped_by_what_it_meets_keeps_its_reference(dialect):
    async with dialect_rig(dialect, gains=GAINS | {"el": 500}, settle={"stalls": True}) as rig:
        await rig.power_on()
        await rig.send(FAR)
        await asyncio.sleep(0.5)
        rig.condition(FaultCondition.STALLED)
        await rig.until_fault(lambda faults: faults.active)
        rig.condition(FaultCondition.STALLED, present=False)
        await rig.send(Reset())
        await rig.send(Power(on=True))
        assert (await rig.done(FAR)).state is AxisState.STANDSTILL


@named(DIALECTS)
@pytest.mark.sweep(4)
async def test_a_shaft_that_moved_on_beside_a_dead_encoder_has_no_place_behind_the_reset(dialect):
    async with dialect_rig(dialect, gains=GAINS | {"el": 500}) as rig:
        await rig.power_on()
        await rig.send(FAR)
        await asyncio.sleep(0.5)
        rig.condition(FaultCondition.ENCODER_STUCK)
        await rig.until_fault(lambda faults: faults.active)
        rig.condition(FaultCondition.ENCODER_STUCK, present=False)
        await rig.send(Reset())
        state = await rig.until(lambda state: state.state is AxisState.DISABLED)
        assert (state.referenced, state.reference_lost) == (False, True)


@named(LOGOSOL)
@pytest.mark.sweep(2)
async def test_a_sensor_lost_in_an_analog_move_is_named(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        await rig.send(MoveAnalog(target=200, velocity=2.0))
        await asyncio.sleep(0.5)

        rig.condition(FaultCondition.SENSOR_LOST)
        sample = await rig.until_fault(lambda faults: faults.active)

        assert (codes(sample), sample.first.text) == (["sensor_fault"], remembered(FaultCode.SENSOR_FAULT))
        await rig.until(lambda state: state.state is AxisState.ERROR_STOP)
        rig.condition(FaultCondition.SENSOR_LOST, present=False)
        await rig.send(Reset())
        await rig.send(Power(on=True))
        assert (await rig.done(FAR)).state is AxisState.STANDSTILL


@named(LOGOSOL)
@pytest.mark.sweep(2)
async def test_a_sensor_lost_in_any_other_move_disturbs_nothing(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        rig.condition(FaultCondition.SENSOR_LOST)

        state = await rig.done(FAR)

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)


# -- the position is lost ----------------------------------------------------------------------------------------------


@named(LOGOSOL)
@pytest.mark.sweep(2)
async def test_an_encoder_that_was_lost_takes_the_reference_with_it_until_the_axis_is_homed(dialect):
    async with dialect_rig(dialect, PLANT.model_copy(update={"index_width_counts": 40})) as rig:
        await rig.power_on()
        assert (await rig.rig.client.state(AXIS)).referenced
        await rig.send(FAR)
        await asyncio.sleep(0.5)

        rig.condition(FaultCondition.ENCODER_LOSS)
        state = await rig.until(lambda state: state.state is AxisState.ERROR_STOP)
        with pytest.raises(WrongState, match="its position is lost") as refusal:
            await rig.send(SetPosition(position=3.0))
        rig.condition(FaultCondition.ENCODER_LOSS, present=False)
        await rig.send(Reset())
        await rig.until(lambda state: state.moving is Moving.NO)
        await rig.send(Power(on=True))
        with pytest.raises(NotReferenced):
            await rig.send(FAR)
        homed = await rig.done(Home(method=HomeMethod.INDEX, velocity=1.4, stop=HomeStop.SMOOTH))

        assert not state.referenced
        assert refusal.value.remedy == "send reset first"
        assert (homed.referenced, homed.last_error) == (True, None)
        nearer = MoveAbsolute(position=5.0, velocity=10.0)  # from the index; FAR would lead onto the hard stop
        assert (await rig.done(nearer)).state is AxisState.STANDSTILL


@asynccontextmanager
async def near_the_end_of_the_counter(dialect, plant=PLANT):
    """Take over a drive that an earlier host has left 500 counts before its counter wraps; no profile goes there."""
    bounds = {"pwm": {"duty": 0.1}, "acceleration": 2000}
    async with dialect_rig(dialect, plant, **bounds) as before:
        before.drive.loop.renumber((1 << 31) - 500)
    async with adopting_rig(dialect, before, **bounds) as rig:
        await rig.power_on()
        await rig.send(SetPosition(position=0.0))
        yield rig


@named((V1, LS_182AP))
async def test_a_counter_that_wrapped_means_nothing_before_a_new_reference(dialect):
    async with near_the_end_of_the_counter(dialect) as rig:
        await rig.send(SetPwm(duty=0.1, duration_s=0.3))  # no profile would go there
        await rig.until_fault(lambda faults: faults.active)
        await rig.until(lambda state: state.command is None)
        await rig.send(Power(on=True))

        with pytest.raises(NotReferenced):
            await rig.send(MoveAbsolute(position=0.0))
        with pytest.raises(WrongState, match="its position is lost"):
            await rig.send(SetPosition(position=3.0))
        await rig.send(Reset())
        await rig.send(SetPosition(position=3.0))
        where = rig.position_mm
        state = await rig.done(MoveAbsolute(position=4.0))

        assert (state.state, state.referenced) == (AxisState.STANDSTILL, True)
        assert rig.position_mm == pytest.approx(where + 1.0, abs=0.1)  # it was still settling


@named((V4, LS_182AP))
@pytest.mark.sweep(2)
async def test_a_counter_that_wrapped_can_be_homed_with_the_warning_standing(dialect):
    far_index = PLANT.model_copy(
        update={"index_width_counts": 40, "index_at_counts": 8000, "index_spacing_counts": 100_000}
    )
    async with near_the_end_of_the_counter(dialect, far_index) as rig:
        await rig.send(SetPwm(duty=0.1, duration_s=0.3))
        await rig.until_fault(lambda faults: faults.active)
        await rig.until(lambda state: state.command is None)
        await rig.send(Power(on=True))

        homed = await rig.done(Home(method=HomeMethod.INDEX, velocity=1.4, stop=HomeStop.SMOOTH))

        assert (homed.referenced, homed.last_error) == (True, None)
        assert not (await rig.until_fault(lambda faults: not faults.active)).active


# -- PIC-SERVO ---------------------------------------------------------------------------------------------------------


@named((V1, V4, SC))
@pytest.mark.sweep(2)
async def test_motor_power_lost_is_named_and_nothing_lurches_when_it_returns(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        await rig.send(FAR)
        await asyncio.sleep(0.5)

        rig.condition(FaultCondition.MOTOR_POWER_OFF)
        sample = await rig.until_fault(lambda faults: faults.active)
        assert (codes(sample), sample.first.text) == (["power_lost"], remembered(FaultCode.POWER_LOST))
        await asyncio.sleep(2.0)
        where = rig.position_mm
        rig.condition(FaultCondition.MOTOR_POWER_OFF, present=False)
        await asyncio.sleep(1.0)

        assert rig.position_mm == pytest.approx(where, abs=0.01)
        assert (await rig.rig.client.state(AXIS)).state is AxisState.ERROR_STOP
        await rig.send(Reset())
        await rig.send(Power(on=True))
        assert (await rig.done(FAR)).state is AxisState.STANDSTILL


@named((V1, V4, SC))
@pytest.mark.sweep(2)
async def test_current_limiting_is_a_warning_that_reset_clears_with_the_loop_closed(dialect):
    hard_stop = PLANT.model_copy(update={"forward_limit_counts": 1000, "stop_margin_counts": 100})
    gains = GAINS | {"cl": 101, "el": 16_000}
    async with dialect_rig(dialect, hard_stop, gains=gains, settle={"stalls": True}) as rig:
        await rig.power_on()

        await rig.send(MoveAbsolute(position=3.0, velocity=5.0))
        sample = await rig.until_fault(lambda faults: faults.active)

        assert (codes(sample), sample.first.stops) == (["current_limit"], False)
        assert (await rig.until(lambda state: state.command is None)).state is AxisState.STANDSTILL
        assert (await rig.done(MoveRelative(distance=-1.0))).referenced
        await rig.send(Reset())
        assert (await rig.until_fault(lambda faults: not faults.active)).first is None
        assert rig.drive.loop.servo_on


# -- warnings and causes of causes -------------------------------------------------------------------------------------


@named(DIALECTS)
@pytest.mark.sweep(2)
async def test_a_counter_that_wraps_is_a_warning(dialect):
    async with near_the_end_of_the_counter(dialect) as rig:
        await rig.send(SetPwm(duty=0.1, duration_s=0.3))  # no profile would go there
        sample = await rig.until_fault(lambda faults: faults.active)

        (wrapped,) = sample.active
        assert (wrapped.code, wrapped.stops, wrapped.text) == (
            "position_wrap",
            False,
            FaultCode.POSITION_WRAP.remedy,
        )
        state = await rig.rig.client.state(AXIS)
        assert (state.state, state.referenced) == (AxisState.CONTINUOUS_MOTION, False)


@named(DIALECTS)
@pytest.mark.sweep(2)
async def test_a_late_servo_cycle_is_a_warning_that_reset_clears(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()

        rig.condition(FaultCondition.SLOW_PROCESSOR)
        rig.condition(FaultCondition.SLOW_PROCESSOR, present=False)
        sample = await rig.until_fault(lambda faults: faults.active)

        assert (codes(sample), sample.first.stops) == (["servo_overrun"], False)
        assert (await rig.rig.client.state(AXIS)).state is AxisState.STANDSTILL
        await rig.send(Reset())
        assert (await rig.until_fault(lambda faults: not faults.active)).first is None
        assert rig.drive.loop.servo_on


async def test_the_first_cause_is_kept_while_others_come_and_go():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        rig.condition(FaultCondition.OVERHEAT)
        await rig.until_fault(lambda faults: faults.active)

        with pytest.raises(DriveFault):
            await rig.send(Reset())
        rig.condition(FaultCondition.STOP_INPUT)
        rig.condition(FaultCondition.OVERHEAT, present=False)
        sample = await rig.until_fault(lambda faults: codes(faults) == ["stop_input"])

        assert sample.first.code == "overheat"


async def test_a_latched_cause_outlives_its_condition_until_reset():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        rig.condition(FaultCondition.STOP_INPUT)
        await rig.until_fault(lambda faults: faults.active)

        rig.condition(FaultCondition.STOP_INPUT, present=False)
        await asyncio.sleep(1.0)

        sample = await rig.until_fault(lambda _: True)
        assert codes(sample) == ["stop_input"]


async def test_reset_follows_the_printed_order_and_closes_nothing():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        rig.condition(FaultCondition.OVERCURRENT)
        await rig.until_fault(lambda faults: faults.active)
        rig.condition(FaultCondition.OVERCURRENT, present=False)

        await rig.send(Reset())

        assert (rig.drive.stage.enabled, rig.drive.stage.latched, rig.drive.loop.servo_on) == (False, None, False)


async def test_closing_the_loop_over_a_standing_cause_is_refused_with_its_name():
    async with dialect_rig(LS_182AP) as rig:
        await rig.until(lambda state: state.state is AxisState.DISABLED)
        rig.condition(FaultCondition.ENCODER_LOSS)  # not shown while the power driver is off

        with pytest.raises(DriveFault, match="encoder or Hall signals were lost"):
            await rig.send(Power(on=True))

        sample = await rig.until_fault(lambda faults: faults.active)
        assert codes(sample) == ["encoder_or_hall"]


async def test_a_loop_that_opens_without_a_reason_is_a_fault_of_its_own():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        await rig.until(lambda state: state.state is AxisState.STANDSTILL)

        rig.drive.restart()  # somebody else has switched it off

        state = await rig.until(lambda state: state.state is AxisState.ERROR_STOP)
        assert not state.enabled


async def test_a_drive_that_lost_power_leaves_its_axis_in_error_stop_until_reset():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        rig.drive.restart()
        await rig.until(lambda state: state.state is AxisState.ERROR_STOP)
        rig.drive.power(on=False, at_s=asyncio.get_running_loop().time())
        await rig.until(lambda state: state.link is LinkState.DOWN)
        rig.drive.power(on=True, at_s=asyncio.get_running_loop().time())
        await rig.until(lambda state: state.link is LinkState.UP)

        with pytest.raises(WrongState, match="error stop"):
            await rig.send(Power(on=True))

        await rig.send(Reset())
        await rig.send(Power(on=True))
        await rig.until(lambda state: state.state is AxisState.STANDSTILL)


async def test_a_position_error_limit_of_0_says_so_at_power_on():
    async with dialect_rig(V4) as rig:
        await rig.until(lambda state: state.link == "up")
        await rig.send(SetGains(el=0))
        await rig.send(Power(on=True))
        await rig.send(FAR)

        sample = await rig.until_fault(lambda faults: faults.active)

        assert codes(sample) == ["position_error"]
