"""Where an axis was at an instant: the bounds hold the simulated shaft, and are no wider than they must be."""

import asyncio
import json
import math
import random
import statistics
from pathlib import Path

import pytest

from ldcnd.contract.errors import LdcndError, MalformedRequest
from ldcnd.testing import run, simulated_rig
from ldcnd.testing.rig import BEGINS_NS, SimulatedRig

AXES = ("x", "y", "z", "c")
LOOKS = 8
"""Instants in a row of one axis, in about the time between two polls; the widest bound is compared with the largest
error of these, of at least a count: a shaft that stands has none."""


async def _move(axis, rng: random.Random) -> None:
    """Let an axis do one thing of a day."""
    match rng.randrange(6):
        case 0:
            await (await axis.move_absolute(rng.uniform(-40, 40))).done()
        case 1:
            await (await axis.move_relative(rng.choice((-1, 1)) * 10 ** rng.uniform(-2.5, 0.5))).done()
        case 2:
            await axis.move_velocity(rng.uniform(1, 10) * rng.choice((-1, 1)))
            await asyncio.sleep(rng.uniform(0.05, 1.5))
            await axis.halt()
        case 3:
            await axis.move_absolute(rng.uniform(-40, 40))
            await asyncio.sleep(rng.uniform(0.02, 0.6))
            await axis.stop()
            await asyncio.sleep(0.3)
            await axis.reset()
            await axis.power(on=True)
        case 4:
            async with asyncio.timeout(20):
                await (await axis.home()).done()
        case _:
            await asyncio.sleep(rng.uniform(0.2, 3))


async def _live(axis, rng: random.Random) -> None:
    await axis.power(on=True)
    while True:
        try:
            await _move(axis, rng)
        except (LdcndError, TimeoutError):
            await asyncio.sleep(0.5)
            try:
                await axis.reset()
                await axis.power(on=True)
            except LdcndError:
                await asyncio.sleep(0.5)


async def _look(rig: SimulatedRig, axis: str) -> tuple[int, float, float]:
    """Return the servo cycle in which the shaft was seen, its place and its speed."""
    drive, now_s = rig.machine(axis).servo, asyncio.get_running_loop().time()
    since_s, cycle_s = (
        now_s - drive.settings.phase_s,
        drive.profile.servo_cycle_s * (1 + drive.settings.drift_ppm * 1e-6),
    )
    ago_s = since_s - math.floor(since_s / cycle_s + 1e-6) * cycle_s
    truth = rig.truth(axis)
    return BEGINS_NS + round((rig.now_s - ago_s) * 1e9), truth.position, truth.velocity


def judge(count: int, seed: int, share: float) -> None:
    """Ask for instants of axes that move, stop, home and stand, and compare with their shafts."""

    async def program() -> list[tuple[bool, bool, float, float]]:
        rng, judged, unknown = random.Random(seed), [], 0
        async with simulated_rig(Path("config/simulated.toml"), seed=seed) as rig:
            async with rig.client.control(*AXES, client="day") as axes:
                lives = [asyncio.create_task(_live(axis, random.Random(seed * 10 + i))) for i, axis in enumerate(axes)]
                await asyncio.sleep(2)
                seen: list[tuple[str, int, float, float]] = []
                while len(judged) < count:
                    name = rng.choice(AXES)
                    for _ in range(LOOKS):
                        seen.append((name, *(await _look(rig, name))))
                        await asyncio.sleep(rng.uniform(0.001, 0.02))
                    while seen and seen[0][1] < BEGINS_NS + (rig.now_s - 0.5) * 1e9:
                        name, t, place, speed = seen.pop(0)
                        axis = rig.daemon.rig.axes[name]
                        status = axis.tracker.status
                        found = axis.readings.history.at(t, status.scale, status.quality)
                        if not (found.position and found.velocity):
                            unknown += 1
                            continue
                        at, speeds = found.position, found.velocity
                        count_width = 1 / abs(status.scale.counts_per_unit)
                        judged.append(
                            (
                                at.lower <= place <= at.upper,
                                speeds.lower <= speed <= speeds.upper,
                                (at.upper - at.lower) / 2 / count_width,
                                max(abs(at.value - place) / count_width, 1.0),
                            )
                        )
                for life in lives:
                    life.cancel()
                await asyncio.gather(*lives, return_exceptions=True)
        assert unknown <= len(judged) / 100
        return judged

    judged = run(program())
    inside, speeds_inside = (statistics.fmean(each[i] for each in judged) for i in (0, 1))
    polls = [list(zip(*judged[i : i + LOOKS], strict=True)) for i in range(0, len(judged), LOOKS)]
    ratio = statistics.median(max(half) / max(error) for _, _, half, error in polls)
    widest = statistics.median(half for _, _, half, _ in judged)
    print(f"seed {seed}: {len(judged)} instants, {inside:.4%} inside, velocities {speeds_inside:.4%},"
          f" half width over error {ratio:.2f}, median half width {widest:.2f} counts")  # fmt: skip
    assert inside >= share
    assert speeds_inside >= share
    assert ratio <= 3.0


@pytest.mark.long
def test_the_shaft_was_within_the_bounds_of_an_instant():
    judge(4000, 3, 0.997)


@pytest.mark.soak
def test_the_shaft_was_within_the_bounds_of_100000_instants():
    judge(100_000, 4, 0.999)


def test_a_query_of_an_instant_answers_with_bounds_and_refuses_what_is_none():
    async def program() -> None:
        async with simulated_rig(Path("config/simulated.toml"), seed=1) as rig, rig.network.session() as session:
            await asyncio.sleep(2)
            (answer,) = await session.query("ldcn/sim/tele/x/at", parameters={"_time": "now(-1s)"})
            found = json.loads(answer.payload)
            assert found["position"]["lower"] <= 0.0 <= found["position"]["upper"]
            assert found["inputs"]["amplifier_enable"] is False
            assert len(await session.query("ldcn/sim/tele/*/at", parameters={"_time": "now(-1s)"})) == len(AXES)
            (unknown,) = await session.query("ldcn/sim/tele/x/at", parameters={"_time": "now(-900s)"})
            assert json.loads(unknown.payload)["reason"]
            for none in ({}, {"_time": "1960-01-01"}, {"_time": "now(-9000000000s)"}, {"_time": "9" * 30}):
                (refused,) = await session.query("ldcn/sim/tele/x/at", parameters=none)
                assert refused.is_error

    run(program())


def test_a_program_asks_where_axes_were_and_what_is_not_known_is_not_guessed():
    async def program() -> None:
        async with simulated_rig(Path("config/simulated.toml"), seed=1) as rig:
            async with rig.client.control("x", client="day") as x:
                await x.power(on=True)
                await x.set_position(5.0)
                await asyncio.sleep(2)
                t = BEGINS_NS + round((rig.now_s - 0.5) * 1e9)
                found = await x.at(t)
                assert found.t == t
                assert found.position.lower <= 5.0 <= found.position.upper
                assert found.position.upper - found.position.lower < 0.01
                assert set(await rig.client.at(t)) == set(AXES)
                rig.faults.mute("x")
                await asyncio.sleep(3)
                silent = await x.at(BEGINS_NS + round((rig.now_s - 1) * 1e9))
                assert (silent.quality, silent.position) == ("bad", None)
                with pytest.raises(MalformedRequest):
                    await x.at("yesterday")

    run(program())
