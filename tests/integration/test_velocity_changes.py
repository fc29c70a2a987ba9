"""`move_velocity` on an axis that jogs changes the velocity on the fly."""

import asyncio

import pytest

from ldcnd.contract.commands import Halt, MoveAbsolute, MoveVelocity, SetGains, SetPwm
from ldcnd.contract.errors import LdcndError, PositionLimit, WrongState
from ldcnd.contract.samples import AxisState
from ldcnd.sim.plant import MotorPlant
from tests.support.dialect_rig import AXIS, LS_173AP, LS_182AP, SC, V1, V4, DialectRig, dialect_rig

PWM = {"duty": 0.3, "duration_s": 5.0}
LIMITS = {"position_min": -15, "position_max": 15}
NEVER_A_SWITCH = MotorPlant(reverse_limit_counts=-(2**40), forward_limit_counts=2**40)
dialects = pytest.mark.parametrize("dialect", [V1, V4, SC, LS_173AP, LS_182AP], ids=lambda dialect: dialect.name)


async def speed(rig: DialectRig) -> float:
    """Return the velocity of the shaft over the next tenth of a second, mm/s."""
    loop = asyncio.get_running_loop()
    rig.drive.catch_up(loop.time())
    before = rig.position_mm
    await asyncio.sleep(0.1)
    rig.drive.catch_up(loop.time())
    return (rig.position_mm - before) / 0.1


@dialects
@pytest.mark.sweep(2)
async def test_a_jog_gets_faster_slower_and_turns_round_without_a_stop_in_between(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        seen = []

        for velocity in (4.0, 8.0, 2.0, -5.0, 0.5):
            reply = await rig.send(MoveVelocity(velocity=velocity))
            await asyncio.sleep(0.5)
            seen.append(await speed(rig))
            assert reply.velocity == pytest.approx(velocity, abs=0.001)
            assert (await rig.rig.client.state(AXIS)).state is AxisState.CONTINUOUS_MOTION
        await rig.send(Halt())
        state = await rig.until(lambda state: state.command is None)

        assert seen == pytest.approx([4.0, 8.0, 2.0, -5.0, 0.5], abs=0.2)
        assert (state.state, state.last_error) == (AxisState.STANDSTILL, "move_velocity: aborted by halt")


@dialects
@pytest.mark.parametrize("velocity", [10.0, -10.0, 0.5])
@pytest.mark.sweep(6)
async def test_a_changed_jog_ends_before_the_software_limit(dialect, velocity):
    async with dialect_rig(dialect, limits=LIMITS, jog_horizon_s=60) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=5.0))
        await asyncio.sleep(0.2)

        state = await rig.done(MoveVelocity(velocity=velocity))

        assert state.state is AxisState.STANDSTILL
        assert 10.0 < abs(rig.position_mm) < 15.05


@pytest.mark.parametrize("sent", [MoveVelocity(velocity=14.0), SetGains(kp=340), SetPwm(duty=0.2, duration_s=5.0)])
@pytest.mark.parametrize("dialect", [V4, LS_182AP], ids=lambda dialect: dialect.name)
async def test_commands_that_come_without_end_keep_no_stop_before_a_software_limit_back(dialect, sent):
    async with dialect_rig(dialect, limits=LIMITS, jog_horizon_s=60, line={"baud": 19_200}, pwm=PWM) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=5.0))
        await asyncio.sleep(0.2)
        begun = await rig.send(MoveVelocity(velocity=14.0))

        async def insist() -> None:
            while True:
                try:
                    await rig.send(sent)
                except LdcndError:
                    await asyncio.sleep(0.005)

        async with asyncio.TaskGroup() as group:
            senders = [group.create_task(insist(), name=f"sender {number}") for number in range(8)]
            await rig.rig.client.wait_for_end(AXIS, begun.command_id)
            farthest = 0.0
            for _ in range(40):
                await asyncio.sleep(0.1)
                rig.drive.catch_up(asyncio.get_running_loop().time())
                farthest = max(farthest, abs(rig.position_mm))
            for sender in senders:
                sender.cancel()

    assert farthest < 15.05


@dialects
@pytest.mark.sweep(2)
async def test_what_waits_for_a_motion_at_a_velocity_goes_on_waiting_while_that_gets_another(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=2.0, duration_s=5.0))
        waits = await rig.send(MoveAbsolute(position=0.0, buffer_mode="buffered"))
        await asyncio.sleep(0.3)
        await rig.send(MoveVelocity(velocity=4.0, duration_s=1.0))
        await asyncio.sleep(0.5)
        runs = await rig.rig.client.state(AXIS)
        ended = await rig.rig.client.wait_for_end(AXIS, waits.command_id)

        assert runs.state is AxisState.CONTINUOUS_MOTION
        assert ended.last_error is None
        assert rig.position_mm == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("dialect", [V4, LS_182AP], ids=lambda dialect: dialect.name)
async def test_a_changed_jog_without_limits_ends_at_the_horizon(dialect):
    async with dialect_rig(dialect, jog_horizon_s=2.0) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=2.0))
        await asyncio.sleep(0.2)

        began_s = asyncio.get_running_loop().time()
        state = await rig.done(MoveVelocity(velocity=3.0))

        assert state.state is AxisState.STANDSTILL
        assert 1.9 < asyncio.get_running_loop().time() - began_s < 2.6


async def test_a_change_too_near_to_the_limit_is_refused_and_the_jog_goes_on():
    async with dialect_rig(LS_182AP, limits=LIMITS) as rig:
        await rig.power_on()
        await rig.done(MoveAbsolute(position=14.0))
        await rig.send(MoveVelocity(velocity=0.1))

        with pytest.raises(PositionLimit, match="too near"):
            await rig.send(MoveVelocity(velocity=20.0))

        assert (await rig.rig.client.state(AXIS)).state is AxisState.CONTINUOUS_MOTION


@pytest.mark.parametrize(("limits", "way"), [({"position_max": 15}, 1), ({"position_min": -15}, -1)])
@pytest.mark.parametrize("dialect", [V4, LS_182AP], ids=lambda dialect: dialect.name)
async def test_a_jog_that_turns_away_from_its_only_limit_too_slowly_to_keep_it_is_refused(dialect, limits, way):
    """Its braking way of 12.5 mm leads beyond the limit that lies behind its new direction."""
    async with dialect_rig(dialect, NEVER_A_SWITCH, limits=limits) as rig:
        await rig.power_on()
        running = await rig.send(MoveVelocity(velocity=5.0 * way, acceleration=100.0))
        await asyncio.sleep(2.8)

        with pytest.raises(PositionLimit, match=f"limit {15 * way} mm is too near"):
            await rig.send(MoveVelocity(velocity=-5.0 * way, acceleration=1.0))

        state = await rig.rig.client.wait_for_end(AXIS, running.command_id)
        assert state.state is AxisState.STANDSTILL
        assert way * rig.position_mm == pytest.approx(15.0, abs=0.05)


async def test_other_motions_are_not_changed_on_the_fly():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=15.0, velocity=5.0))

        with pytest.raises(WrongState):
            await rig.send(MoveVelocity(velocity=2.0))


SLOW_RATES = {"position": 2, "velocity": 2, "adc": 0, "state": 2}
EVER = {"jog_horizon_s": 60, "rates": SLOW_RATES, "limits": LIMITS}


@dialects
@pytest.mark.parametrize("velocity", [20.0, -20.0, 7.0])
@pytest.mark.sweep(2)
async def test_a_changed_jog_ends_before_the_software_limit_however_seldom_its_axis_is_polled(dialect, velocity):
    async with dialect_rig(dialect, NEVER_A_SWITCH, **EVER) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=5.0))
        await asyncio.sleep(0.2)

        await rig.send(MoveVelocity(velocity=velocity))
        await asyncio.sleep(6.0)

        assert 5.0 < abs(rig.position_mm) < 15.05


@pytest.mark.parametrize("duty", [0.9, 0.2, -0.2])
@pytest.mark.parametrize("dialect", [V4, LS_182AP], ids=lambda dialect: dialect.name)
@pytest.mark.sweep(2)
async def test_a_duty_ends_before_the_software_limit_however_seldom_its_axis_is_polled(dialect, duty):
    limits = {"position_min": -200, "position_max": 200}
    pwm = {"duty": 1.0, "duration_s": 20.0}
    async with dialect_rig(dialect, NEVER_A_SWITCH, rates=SLOW_RATES, limits=limits, pwm=pwm, acceleration=4000) as rig:
        await rig.power_on()

        await rig.send(SetPwm(duty=duty, duration_s=10.0))
        farthest = 0.0
        for _ in range(1_200):
            await asyncio.sleep(0.01)
            rig.drive.catch_up(asyncio.get_running_loop().time())
            farthest = max(farthest, abs(rig.position_mm))

        assert 50.0 < farthest < 200.0
        assert (await rig.rig.client.state(AXIS)).command is None


async def test_a_duty_towards_a_limit_that_is_reached_is_refused():
    async with dialect_rig(V4, limits={"position_max": 0.0}, pwm={"duty": 1.0}) as rig:
        await rig.power_on()

        with pytest.raises(PositionLimit):
            await rig.send(SetPwm(duty=0.5, duration_s=1.0))

        assert rig.drive.loop.pwm == 0
