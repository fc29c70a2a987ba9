"""An encoder that misses counts in a motion and comes back leaves no place behind; a healthy one keeps it.

On the jumping clock; the simulated shaft decides where an axis is.
"""

import asyncio
import random
from contextlib import suppress
from pathlib import Path

import pytest

from ldcnd.client.axis import Axis
from ldcnd.client.motion import State
from ldcnd.contract.errors import LdcndError
from ldcnd.testing import run, simulated_rig

SIMULATED = Path("config/simulated.toml")


@pytest.mark.parametrize(
    ("axis", "velocity", "goal", "at", "for_s"),
    [
        ("x", 5.0, 12.0, 6.0, 0.4),
        ("z", 10.0, 30.0, 5.0, 0.2),
        ("x", 20.0, 80.0, 79.0, 0.5),
        ("x", 20.0, 80.0, 79.95, 3.0),
        ("z", 10.0, 30.0, 29.5, 1.0),
        ("y", 10.0, 20.0, 12.0, 0.3),
        ("c", 0.54, 2.0, 0.5, 1.5),
        ("z", 0.06, 0.3, 0.05, 1.5),
        ("z", 10.0, 30.0, 29.8, 0.6),
        ("z", 10.0, 30.0, 29.9, 1.0),
        ("z", 10.0, 30.0, 29.98, 0.3),
        ("x", 5.0, 12.0, 11.98, 0.6),
        ("y", 10.0, 20.0, 19.98, 0.3),
    ],
)
def test_an_encoder_that_stuck_for_a_while_in_a_motion_leaves_no_place(axis, velocity, goal, at, for_s):
    async def program() -> tuple[bool, float]:
        async with simulated_rig(SIMULATED, seed=1) as rig, rig.client.control(axis, client="test") as moved:
            await moved.power(on=True)
            begins = rig.truth(axis).counts
            rig.faults.encoder_stuck(axis, at=at, for_s=for_s)
            with suppress(LdcndError):
                await (await moved.move_absolute(goal, velocity=velocity)).done()
            await asyncio.sleep(5)
            with suppress(LdcndError):  # it may be refused, where readings contradict each other
                await moved.reset()
                await moved.power(on=True)
            await asyncio.sleep(1)
            shown = moved.position.sample
            return moved.state.sample.referenced, abs(rig.truth(axis).counts - begins - shown.counts)

    referenced, off_counts = run(program())
    assert off_counts > 500, "nothing was missed"
    assert not referenced


@pytest.mark.parametrize("trouble", ["encoder", "jam"])
def test_a_motor_is_switched_off_whose_axis_has_lost_its_place_in_a_motion_and_the_motion_has_failed(trouble):
    async def program() -> tuple[str, State, float]:
        async with simulated_rig(SIMULATED, seed=1) as rig, rig.client.control("x", client="test") as moved:
            await moved.power(on=True)
            begin = rig.faults.encoder_stuck if trouble == "encoder" else rig.faults.jam
            begin("x", at=6.0)
            motion = await moved.move_absolute(60.0, velocity=5.0)
            with pytest.raises(LdcndError) as raised:
                await motion.done()
            await rig.until(lambda: not rig.truth("x").energised)
            return str(raised.value), moved.state, rig.truth("x").position

    why, state, position = run(program())
    assert "send reset and home" in why
    assert not state.referenced
    assert trouble == "encoder" or abs(position - 6) < 0.5


def test_gains_of_a_client_that_are_too_soft_for_the_friction_are_no_jam():
    async def program() -> tuple[bool, bool]:
        async with simulated_rig(SIMULATED, seed=1) as rig, rig.client.control("x", client="test") as moved:
            await moved.power(on=True)
            rig.faults.friction("x", 30)
            await moved.set_gains(kp=3, kd=0, ki=0, ol=5)
            await (await moved.move_relative(2.0, velocity=10.0)).done()
            await asyncio.sleep(3)
            return moved.state.enabled, moved.state.referenced

    assert run(program()) == (True, True)


@pytest.mark.parametrize("axis", ["x", "z"])
def test_friction_that_holds_an_axis_short_of_its_target_is_no_jam(axis):
    async def program() -> tuple[bool, bool, list[bool | None]]:
        async with simulated_rig(SIMULATED, seed=1) as rig, rig.client.control(axis, client="test") as moved:
            await moved.power(on=True)
            rig.faults.friction(axis, 25)
            await moved.set_gains(kp=60, kd=600, ki=0)
            settled = []
            for goal in (5.0, -3.0, 4.0):
                settled.append((await (await moved.move_absolute(goal, velocity=8.0)).done()).settled)
                await asyncio.sleep(2)
            return moved.state.enabled, moved.state.referenced, settled

    assert run(program()) == (True, True, [False, False, False])


@pytest.mark.parametrize("seed", range(24))
@pytest.mark.sweep(6)
def test_a_healthy_axis_keeps_its_place_whatever_friction_it_has(seed):
    async def program() -> list[str]:
        dice, axis = random.Random(seed), "xyz"[seed % 3]
        async with simulated_rig(SIMULATED, seed=seed) as rig, rig.client.control(axis, client="test") as moved:
            await moved.power(on=True)
            if (times := dice.choice((1, 1, 3, 8))) > 1:
                rig.faults.friction(axis, times)
            did = []
            for _ in range(10):
                did.append(await moves_on(moved, dice))
                if not moved.state.sample.referenced:
                    return [f"friction times {times}", *did]
            return []

    assert run(program()) == []


async def moves_on(axis: Axis, dice: random.Random) -> str:
    """Move an axis somehow; return how."""
    velocity, sign, for_s = 10 ** dice.uniform(-1.5, 1.3), dice.choice((-1, 1)), dice.uniform(0.05, 1.0)
    how = dice.choice(("absolute", "relative", "halt", "quick_stop"))
    if how == "absolute":
        await (await axis.move_absolute(dice.uniform(-20, 20), velocity=velocity)).done()
    elif how == "relative":
        await (await axis.move_relative(sign * 10 ** dice.uniform(-2.5, 0.9), velocity=velocity)).done()
    else:
        await axis.move_velocity(sign * velocity)
        await asyncio.sleep(for_s)
        await getattr(axis, how)()
    await asyncio.sleep(1.0)
    if how == "quick_stop":
        await axis.reset()
    return f"{how} at {velocity:.3g}"
