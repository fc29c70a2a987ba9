"""The modes beside profiles: analog positioning and raw duty; on the jumping clock."""

import asyncio
import contextlib

import pytest

from ldcnd.contract.commands import Halt, Home, MoveAbsolute, MoveAnalog, SetPwm, Track, Verb
from ldcnd.contract.errors import (
    DriveFault,
    LdcndError,
    NotSupported,
    OutcomeUnknown,
    PositionLimit,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.sim.ldcn.power import FaultCondition
from tests.integration.test_unconfirmed_start import lose_next
from tests.support.dialect_rig import (
    AXIS,
    CMC,
    DIALECTS,
    LS_173AP,
    LS_182AP,
    LS_182AP_22,
    PLANT,
    SC,
    V1,
    V4,
    dialect_rig,
)

PWM = {"duty": 0.3, "duration_s": 5.0}


def named(dialects):
    return pytest.mark.parametrize("dialect", dialects, ids=lambda dialect: dialect.name)


@named(DIALECTS)
async def test_the_capabilities_tell_what_the_model_can_do(dialect):
    async with dialect_rig(dialect) as rig:
        (info,) = await rig.rig.client.axes()

    special = {Verb.MOVE_ANALOG, Verb.TRACK, Verb.SET_OUTPUTS, Verb.SET_PWM}
    expected = {Verb.SET_PWM}
    if dialect in (LS_173AP, LS_182AP, LS_182AP_22):
        expected.add(Verb.MOVE_ANALOG)
    if dialect is not V1:
        expected.add(Verb.TRACK)
    if dialect in (V4, CMC):
        expected.add(Verb.SET_OUTPUTS)
    assert special & set(info.capabilities) == expected


# -- absolute positioning on the A/D value ---------------------------------------------------------------------------


@named((LS_173AP, LS_182AP, LS_182AP_22))
@pytest.mark.parametrize("share", [0.65, 0.35])
@pytest.mark.sweep(2)
async def test_an_analog_move_finds_its_direction_and_ends_at_the_value(dialect, share):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        full_scale = 1023 if dialect is not LS_173AP else 255
        target = round(share * full_scale)

        reply = await rig.send(MoveAnalog(target=target, velocity=5.0))
        assert (await rig.rig.client.state(AXIS)).state is AxisState.DISCRETE_MOTION
        state = await rig.rig.client.wait_for_end(AXIS, reply.command_id)

        assert (state.state, state.last_error, reply.target) == (AxisState.STANDSTILL, None, target)
        assert rig.position_mm == pytest.approx(share * 50 - 25, abs=0.3)


@named((V4, SC))
async def test_an_analog_move_needs_a_drive_that_knows_it(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()

        with pytest.raises(NotSupported, match="cannot move_analog"):
            await rig.send(MoveAnalog(target=100))


@pytest.mark.parametrize(("dialect", "target", "nearest"), [(LS_182AP, 7, 8), (LS_182AP, 1016, 1015), (LS_173AP, 1, 2)])
async def test_an_analog_target_where_the_sensor_counts_as_broken_is_refused(dialect, target, nearest):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()

        with pytest.raises(ValueOutOfRange, match="takes its sensor for broken") as refusal:
            await rig.send(MoveAnalog(target=target))

        assert refusal.value.nearest == nearest


async def test_an_analog_move_is_refused_while_the_sensor_is_disconnected():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        rig.condition(FaultCondition.SENSOR_LOST)

        with pytest.raises(DriveFault, match="the analog sensor reads 0"):
            await rig.send(MoveAnalog(target=500))

        state = await rig.rig.client.state(AXIS)
        assert (state.state, rig.drive.loop.trajectory.velocity) == (AxisState.STANDSTILL, 0)


async def test_an_analog_move_stops_before_a_software_limit():
    async with dialect_rig(LS_182AP, limits={"position_max": 4}) as rig:
        await rig.power_on()

        state = await rig.done(MoveAnalog(target=900, velocity=5.0))

        assert (state.state, state.last_error) == (
            AxisState.STANDSTILL,
            "move_analog: stopped before a software limit",
        )
        assert 2.0 < rig.position_mm < 4.0


DEAD_SENSOR = PLANT.model_copy(update={"pot_span_counts": (-(1 << 40), 1 << 40), "forward_limit_counts": 1 << 30})
"""A coupling that slips: the sensor stays where it is."""


@pytest.mark.parametrize(
    ("bounds", "failure", "way_mm"),
    [
        ({"timeout_s": 2.0}, "not there within 2 s", 10.0),
        ({"distance": 3.0}, "not there within 3 mm", 3.0),
        ({}, "not there within 10 s", 50.0),
    ],
)
@pytest.mark.sweep(2)
async def test_an_analog_move_whose_sensor_does_not_follow_ends_at_its_bounds(bounds, failure, way_mm):
    async with dialect_rig(LS_182AP, DEAD_SENSOR, reference="required") as rig:
        await rig.power_on()

        state = await rig.done(MoveAnalog(target=900, velocity=5.0, **bounds))

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, f"move_analog: {failure}")
        assert rig.position_mm == pytest.approx(way_mm, abs=0.8)


async def test_an_analog_move_takes_its_bounds_from_the_configuration():
    async with dialect_rig(LS_182AP, DEAD_SENSOR, analog={"timeout_s": 60, "distance": 2}) as rig:
        await rig.power_on()

        state = await rig.done(MoveAnalog(target=900, velocity=5.0))

        assert state.last_error == "move_analog: not there within 2 mm"


async def test_an_analog_move_that_went_out_of_sight_is_ended_when_the_line_is_back():
    loss = {"bus": "run_to_target"}
    async with dialect_rig(LS_182AP, DEAD_SENSOR, analog={"timeout_s": 3}, loss=loss) as rig:
        await rig.power_on()
        await rig.send(MoveAnalog(target=900, velocity=5.0))
        await asyncio.sleep(0.5)

        rig.chain.unplug(asyncio.get_running_loop().time(), 4.0)
        await rig.until(lambda state: state.link is LinkState.DOWN)
        await rig.until(lambda state: state.link is LinkState.UP)
        await asyncio.sleep(1.0)
        where = rig.position_mm
        await asyncio.sleep(5.0)

        assert rig.position_mm == pytest.approx(where, abs=0.01)


async def test_a_plain_move_after_an_analog_one_ignores_the_sensor():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        await rig.done(MoveAnalog(target=600, velocity=5.0))
        await rig.done(MoveAbsolute(position=0.5))
        rig.condition(FaultCondition.SENSOR_LOST)

        state = await rig.done(MoveAbsolute(position=1.0))

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)


# -- raw duty --------------------------------------------------------------------------------------------------------


@named(DIALECTS)
@pytest.mark.parametrize("duty", [0.1, -0.1])
@pytest.mark.sweep(2)
async def test_a_duty_turns_the_motor_for_its_time_and_then_the_axis_holds(dialect, duty):
    async with dialect_rig(dialect, pwm=PWM, acceleration=2000) as rig:
        await rig.power_on()

        reply = await rig.send(SetPwm(duty=duty, duration_s=0.1))
        running = await rig.rig.client.state(AXIS)
        await asyncio.sleep(0.09)
        assert rig.drive.loop.pwm == round(duty * 255)
        state = await rig.rig.client.wait_for_end(AXIS, reply.command_id)

        assert (running.state, running.command.verb) == (AxisState.CONTINUOUS_MOTION, "set_pwm")
        assert reply.duty == pytest.approx(duty, abs=0.002)
        assert (state.state, state.enabled, state.last_error) == (AxisState.STANDSTILL, True, None)
        assert rig.position_mm * duty > 0
        assert (await rig.until_fault(lambda _: True)).first is None


@pytest.mark.parametrize("direction", ["forward", "reverse"])
async def test_a_duty_at_its_limit_keeps_it_and_one_that_is_none_leaves_the_loop_closed(direction):
    async with dialect_rig(V4, pwm=PWM | {"duty": 0.305}, direction=direction, acceleration=2000) as rig:
        await rig.power_on()
        with pytest.raises(ValueOutOfRange) as refusal:
            await rig.send(SetPwm(duty=-0.001, duration_s=1.0))
        assert refusal.value.nearest == pytest.approx(-1 / 255)
        assert (await rig.rig.client.state(AXIS)).state is AxisState.STANDSTILL

        reply = await rig.send(SetPwm(duty=0.305, duration_s=0.1))
        await asyncio.sleep(0.09)

        assert rig.drive.loop.pwm == (77 if direction == "forward" else -77)
        assert reply.duty == pytest.approx(77 / 255)


@named((V4, CMC, SC, LS_182AP))
async def test_a_raw_duty_runs_its_time_where_limit_switches_would_stop_it(dialect):
    """The drive has a capture armed then, and its open loop passed for one that a position error had opened."""
    async with dialect_rig(dialect, pwm=PWM, acceleration=2000, limit_switches="stop") as rig:
        await rig.power_on()
        state = await rig.done(SetPwm(duty=0.1, duration_s=0.1))

        assert (state.state, state.enabled, state.last_error) == (AxisState.STANDSTILL, True, None)
        assert rig.position_mm > 0


@named((V4, LS_182AP))
@pytest.mark.parametrize("side", [1, -1])
async def test_a_duty_that_its_load_overcomes_is_stopped_before_the_software_limit_behind_it(dialect, side):
    load = PLANT.model_copy(update={"load_nm": -0.12 * side})
    limits = {"position_min": -5, "position_max": 100} if side > 0 else {"position_min": -100, "position_max": 5}
    async with dialect_rig(dialect, pwm=PWM, acceleration=2000, limits=limits) as rig:
        await rig.power_on()
        rig.drive.shaft.become(load)

        state = await rig.done(SetPwm(duty=0.03 * side, duration_s=5.0))

        assert (state.state, state.enabled) == (AxisState.STANDSTILL, True)
        assert -5.0 <= rig.position_mm * side < 0.0


@named((V4, LS_182AP))
@pytest.mark.parametrize("direction", ["forward", "reverse"])
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.sweep(3)
async def test_no_duty_and_no_analog_move_that_begins_near_a_software_limit_passes_it(dialect, direction, side):
    """How fast either becomes is known by readings only, the first of which come when it is under way."""
    limits = {"position_min": -15, "position_max": 15}
    commands = [SetPwm(duty=0.3 * side, duration_s=0.5)]
    commands += [MoveAnalog(target=900 if side > 0 else 100, velocity=20.0)] if dialect is LS_182AP else []
    for command in commands:
        for place in (10.0, 12.5, 14.5, 14.9):
            async with dialect_rig(dialect, pwm=PWM, direction=direction, limits=limits) as rig:
                await rig.power_on()
                await rig.done(MoveAbsolute(position=place * side))
                with contextlib.suppress(PositionLimit):
                    await rig.done(command)
                assert abs(rig.position_mm) <= 15.0


async def test_a_duty_leads_away_from_a_software_limit_that_the_axis_stands_at():
    async with dialect_rig(V4, pwm=PWM, acceleration=2000, limits={"position_min": 0, "position_max": 100}) as rig:
        await rig.power_on()

        await rig.done(SetPwm(duty=0.1, duration_s=0.1))

        assert rig.position_mm > 0.5


async def test_a_duty_on_a_reversed_axis_turns_the_other_way():
    async with dialect_rig(V4, pwm=PWM, direction="reverse", acceleration=2000) as rig:
        await rig.power_on()

        await rig.done(SetPwm(duty=0.1, duration_s=0.1))

        assert rig.position_mm < 0


async def test_polls_between_the_packets_of_a_duty_do_not_end_it():
    rates = {"position": 1000, "velocity": 1000, "state": 1000}
    async with dialect_rig(V4, pwm=PWM, acceleration=2000, rates=rates) as rig:
        await rig.power_on()

        await rig.send(SetPwm(duty=0.05, duration_s=0.2))
        await asyncio.sleep(0.18)

        assert rig.drive.loop.pwm == 13


async def test_a_stop_ends_a_duty_at_once():
    async with dialect_rig(LS_182AP, pwm=PWM, acceleration=2000) as rig:
        await rig.power_on()
        await rig.send(SetPwm(duty=0.05, duration_s=5.0))
        await asyncio.sleep(0.1)

        await rig.rig.client.stop(AXIS)
        state = await rig.until(lambda state: state.state is AxisState.STANDSTILL)

        assert (state.enabled, state.stop_latched) == (True, True)
        where = rig.position_mm
        await asyncio.sleep(6.0)
        assert rig.position_mm == pytest.approx(where, abs=0.02)


@pytest.mark.promise("stop-in-any-state")
@pytest.mark.parametrize("turns", range(1, 20, 2))
@pytest.mark.parametrize(
    "command",
    [
        SetPwm(duty=0.05, duration_s=3.0),
        Home(method="forward_limit", velocity=5.0),
        MoveAnalog(target=800, velocity=5.0),
        Track(position=0.1),
    ],
)
@pytest.mark.sweep(6)
async def test_whenever_a_stop_comes_nothing_moves_afterwards(command, turns):
    async with dialect_rig(LS_182AP, pwm=PWM, tracking={"step": 0.5, "rate": 50.0}, acceleration=2000) as rig:
        await rig.power_on()
        axis = rig.rig.daemon.rig.axes[AXIS]

        async with asyncio.TaskGroup() as group:
            group.create_task(_ignoring_refusals(axis.execute(command)))
            await asyncio.sleep(turns * 0.0004)
            await rig.rig.daemon.rig.stop((AXIS,))
        await rig.until(lambda state: state.state is AxisState.STANDSTILL)
        await asyncio.sleep(1.0)
        where = rig.position_mm
        await asyncio.sleep(3.0)

        assert rig.position_mm == pytest.approx(where, abs=0.003)
        assert abs(where) < 0.3
        assert (rig.drive.loop.servo_on, rig.drive.loop.search) == (True, None)


async def _ignoring_refusals(work):
    with contextlib.suppress(LdcndError):
        await work


async def test_a_duty_may_be_replaced_while_it_runs():
    async with dialect_rig(V4, pwm=PWM, acceleration=2000) as rig:
        await rig.power_on()
        await rig.send(SetPwm(duty=0.05, duration_s=0.1))

        reply = await rig.send(SetPwm(duty=-0.05, duration_s=0.2))
        await asyncio.sleep(0.15)

        assert rig.drive.loop.pwm == -13
        assert (await rig.rig.client.wait_for_end(AXIS, reply.command_id)).state is AxisState.STANDSTILL


@named((V4, LS_182AP))
@pytest.mark.parametrize(("duration_s", "unplugged_s"), [(4.0, 0.5), (0.5, 1.5)])
@pytest.mark.sweep(2)
async def test_a_duty_does_not_survive_the_loss_of_the_line(dialect, duration_s, unplugged_s):
    async with dialect_rig(dialect, pwm=PWM, acceleration=2000) as rig:
        await rig.power_on()
        await rig.send(SetPwm(duty=0.05, duration_s=duration_s))
        await asyncio.sleep(0.2)

        rig.chain.unplug(asyncio.get_running_loop().time(), unplugged_s)
        await asyncio.sleep(unplugged_s - 0.1)
        assert rig.drive.loop.pwm == 13
        await asyncio.sleep(3.0)

        assert rig.drive.loop.pwm == 0
        assert not rig.drive.stage.enabled


async def test_halt_ends_a_duty():
    async with dialect_rig(V4, pwm=PWM, acceleration=2000) as rig:
        await rig.power_on()
        await rig.send(SetPwm(duty=0.05, duration_s=5.0))

        state = await rig.done(Halt())

        assert (state.state, state.enabled, state.last_error) == (
            AxisState.STANDSTILL,
            True,
            "set_pwm: aborted by halt",
        )


async def test_a_move_during_a_duty_is_refused():
    async with dialect_rig(V4, pwm=PWM) as rig:
        await rig.power_on()
        await rig.send(SetPwm(duty=0.0, duration_s=1.0))

        with pytest.raises(WrongState, match="is moving at a velocity"):
            await rig.send(MoveAbsolute(position=1.0))


async def test_the_end_of_a_duty_does_not_disturb_what_came_after_a_reset():
    async with dialect_rig(LS_182AP, pwm=PWM) as rig:
        await rig.power_on()
        await rig.send(SetPwm(duty=0.0, duration_s=1.0))
        await rig.send(Halt())
        await rig.until(lambda state: state.state is AxisState.STANDSTILL)

        state = await rig.done(MoveAbsolute(position=15.0, velocity=5.0))

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)


@pytest.mark.parametrize("heard", [True, False])
async def test_a_duty_that_was_not_begun_for_want_of_a_reply_leaves_the_loop_closed(heard, monkeypatch):
    """What is started before it, to put an acceleration in force, moves nothing: there is nothing to end."""
    async with dialect_rig(LS_182AP, pwm=PWM) as rig:
        await rig.power_on()
        lose_next(rig, monkeypatch, heard=heard)
        with pytest.raises(OutcomeUnknown):
            await rig.send(SetPwm(**PWM))
        await asyncio.sleep(1.0)
        state = await rig.rig.client.state(AXIS)
        rig.drive.catch_up(asyncio.get_running_loop().time())

        assert (state.state, state.enabled, rig.drive.loop.servo_on) == (AxisState.STANDSTILL, True, True)
