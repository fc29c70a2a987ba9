"""What no drive ends by itself is ended by a daemon that starts."""

import asyncio

import pytest

from ldcnd.contract.commands import MoveAnalog, MoveVelocity, SetPwm
from ldcnd.drives.ldcn.received import AddPathPoints, LoadTrajectory
from ldcnd.drives.ldcn.trajectory import Trajectory
from tests.integration.test_modes import DEAD_SENSOR
from tests.support.dialect_rig import AXIS, LS_182AP, SC, V4, DialectRig, adopting_rig, dialect_rig

PWM = {"duty": 0.5, "duration_s": 60.0}
RUN_ON = {"daemon": "run_to_target"}


async def true_speed(rig: DialectRig) -> float:
    """Return how fast the shaft turns, in mm a second."""
    loop = asyncio.get_running_loop()
    rig.chain.advance(loop.time())
    before = rig.position_mm
    await asyncio.sleep(0.2)
    rig.chain.advance(loop.time())
    rig.drive.catch_up(loop.time())
    return (rig.position_mm - before) / 0.2


@pytest.mark.promise("motions-without-end")
@pytest.mark.parametrize("dialect", [V4, LS_182AP], ids=lambda dialect: dialect.name)
async def test_a_duty_that_a_daemon_has_left_is_ended_by_the_next_one(dialect):
    """A daemon that ends halts it, whatever its policy: it was killed here, or another program has begun the duty."""
    async with dialect_rig(dialect, pwm=PWM, acceleration=2000, loss=RUN_ON) as rig:
        await rig.power_on()
        await rig.send(SetPwm(duty=0.02, duration_s=60.0))
        await asyncio.sleep(0.3)
    assert abs(await true_speed(rig)) < 0.1
    rig.drive.execute(LoadTrajectory(Trajectory(pwm_or_target=6, servo=False, start_now=True)))
    await asyncio.sleep(0.3)
    assert abs(await true_speed(rig)) > 0.1

    async with adopting_rig(dialect, rig, pwm=PWM, acceleration=2000, loss=RUN_ON) as again:
        await asyncio.sleep(1.5)
        assert abs(await true_speed(again)) < 0.1
        assert not (await again.rig.client.state(AXIS)).stop_pending


@pytest.mark.promise("motions-without-end")
@pytest.mark.parametrize(
    ("dialect", "commands", "runs_on"),
    [
        (V4, [MoveVelocity(velocity=5.0)], True),
        (V4, [MoveVelocity(velocity=5.0), MoveVelocity(velocity=8.0)], False),
        (LS_182AP, [MoveVelocity(velocity=5.0), MoveVelocity(velocity=8.0)], False),
        (LS_182AP, [MoveAnalog(target=900, velocity=5.0)], False),
        (SC, [MoveVelocity(velocity=5.0), MoveVelocity(velocity=8.0)], True),
    ],
    ids=["trapezoid", "velocity mode", "velocity mode, LS-182AP", "analog", "trapezoids, SC"],
)
async def test_a_daemon_that_ends_lets_only_that_run_on_which_the_drive_ends(dialect, commands, runs_on):
    async with dialect_rig(dialect, DEAD_SENSOR, loss=RUN_ON) as rig:
        await rig.power_on()
        for command in commands:
            await rig.send(command)
            await asyncio.sleep(0.3)

    assert (abs(await true_speed(rig)) > 0.1) is runs_on


async def test_a_closed_loop_is_left_closed_by_a_take_over():
    async with dialect_rig(V4, loss=RUN_ON) as rig:
        await rig.power_on()
    async with adopting_rig(V4, rig, loss=RUN_ON) as again:
        await asyncio.sleep(0.5)
        assert (await again.rig.client.state(AXIS)).enabled


async def test_a_path_that_a_host_has_left_is_stopped():
    async with dialect_rig(SC, loss=RUN_ON) as rig:
        await rig.power_on()
    slow = 400 << 3  # counts in 32 servo cycles: 24 mm/s; 126 points last for 2 s
    for _ in range(18):
        rig.drive.execute(AddPathPoints((slow,) * 7))
    rig.drive.execute(AddPathPoints(()))

    async with adopting_rig(SC, rig, loss=RUN_ON) as again:
        assert again.drive.loop.trajectory.path.running
        await asyncio.sleep(0.9)

        assert not again.drive.loop.trajectory.path.running
        assert abs(await true_speed(again)) < 0.1
