"""Every motion ends within its stated bound when the host falls silent, but for the two that the docs name."""

import asyncio
import contextlib

import pytest

from ldcnd.errors import LdcndError
from ldcnd.model.commands import Home, MoveAbsolute, MoveAnalog, MoveRelative, MoveVelocity, SetPwm, Track
from tests.support.dialect_rig import LS_173AP, LS_182AP, SC, V1, V2, V4, DialectRig, dialect_rig

HORIZON_S = 3.0
BRAKING_S = 1.0
"""To come to rest and to settle behind a bound."""
PERIOD_S = 0.1
AXIS = {
    "jog_horizon_s": HORIZON_S,
    "tracking": {"step": 0.5, "rate": 50},
    "pwm": {"duty": 0.1, "duration_s": HORIZON_S},
}
BOUNDED = {
    "move_absolute": (MoveAbsolute(position=15.0, velocity=10.0), 1.6),
    "move_relative": (MoveRelative(distance=-10.0, velocity=10.0), 1.1),
    "move_velocity": (MoveVelocity(velocity=5.0), HORIZON_S),
    "home": (Home(method="index", velocity=-1.0, timeout_s=HORIZON_S), 1.1 * HORIZON_S),
    "track": (Track(position=0.4), 0.2),
}
UNBOUNDED = {
    "set_pwm": SetPwm(duty=0.05, duration_s=HORIZON_S),
    "move_analog": MoveAnalog(target=3, velocity=2.0, timeout_s=HORIZON_S),
}
INSTANTS_S = (0.0015, 0.0045, 0.3)
"""After the command was sent: among its packets, and in mid-motion."""


async def sent_into_silence(rig: DialectRig, command: object, instant_s: float, *, powered: bool = False) -> None:
    """Send a command, and let the host fall silent for good so much later."""
    if not powered:
        await rig.power_on()
    loop = asyncio.get_running_loop()

    async def send() -> None:
        with contextlib.suppress(LdcndError):
            await rig.send(command)

    async with asyncio.TaskGroup() as group:
        group.create_task(send(), name="command")
        await asyncio.sleep(instant_s)
        rig.chain.unplug(loop.time())


async def travelled(rig: DialectRig, for_s: float) -> float:
    """Return how far the shaft goes from now on, in mm; the chain has no host that would move its clock on."""
    loop = asyncio.get_running_loop()
    rig.drive.catch_up(loop.time())
    before = rig.position_mm
    await asyncio.sleep(for_s)
    rig.drive.catch_up(loop.time())
    return abs(rig.position_mm - before)


@pytest.mark.parametrize("dialect", [V1, V2, V4, SC, LS_173AP, LS_182AP], ids=lambda dialect: dialect.name)
@pytest.mark.parametrize("verb", BOUNDED)
async def test_a_motion_ends_within_its_bound_without_a_host(dialect, verb):
    command, bound_s = BOUNDED[verb]
    for instant_s in INSTANTS_S:
        async with dialect_rig(dialect, **AXIS) as rig:
            if command.verb not in rig.rig.daemon.rig.axis("x").driver.capabilities:
                return
            await sent_into_silence(rig, command, instant_s)
            await asyncio.sleep(bound_s + BRAKING_S)

            assert await travelled(rig, 5.0) < 0.01, (verb, instant_s)


@pytest.mark.parametrize("verb", UNBOUNDED)
async def test_the_two_motions_that_the_docs_name_run_on_without_a_host(verb):
    async with dialect_rig(LS_173AP if verb == "move_analog" else V4, **AXIS) as rig:
        await sent_into_silence(rig, UNBOUNDED[verb], 0.3)

        assert await travelled(rig, HORIZON_S + BRAKING_S) > 1.0


@pytest.mark.parametrize(("dialect", "runs_on"), [(SC, False), (V4, True), (LS_182AP, True)])
async def test_a_jog_that_was_changed_on_its_way_ends_without_a_host_on_sc_alone(dialect, runs_on):
    async with dialect_rig(dialect, **AXIS) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=2.0))
        await asyncio.sleep(0.2)
        await sent_into_silence(rig, MoveVelocity(velocity=3.0), 0.3, powered=True)
        await asyncio.sleep(HORIZON_S + BRAKING_S)

        assert (await travelled(rig, 2.0) > 1.0) is runs_on
