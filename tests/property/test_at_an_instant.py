"""Where an axis was at an instant: the bounds hold the simulated shaft, and are no wider than they must be."""

import asyncio
import json
import math
import random
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

from ldcnd.axis.status import AxisStatus
from ldcnd.client.axis import Axis
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.errors import LdcndError, MalformedRequest
from ldcnd.contract.samples import LinkState, Moving
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.testing import run, simulated_rig
from ldcnd.testing.rig import BEGINS_NS, SimulatedRig

AXES = ("x", "y", "z", "c")
UNITS = ("feed", "spool")
LOOKS = 8
"""Instants in a row of one axis."""
KNOWN_AFTER_S = 4.0
"""By then two polls have followed an instant, also of a SmartStep."""
FAST_HZ = 20
SLOW_RATIO = 2.8
"""Where ramps begin and end between two polls, see `judge`."""
KINDS = {"move_absolute": "move", "move_relative": "move", "move_velocity": "jog", "home": "home", "halt": "stop"}


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


async def _turn(rig: SimulatedRig, unit: str, rng: random.Random) -> None:
    """Let the pulses that a SmartStep follows, which come from elsewhere, change their rate every now and then."""
    while True:
        rate = rng.choice((0.0, 0.0, 1.0)) * rng.uniform(-20_000, 20_000)
        rig.machine(unit).unit.drive.set_pulse_rate(rate, asyncio.get_running_loop().time())
        await asyncio.sleep(rng.uniform(0.3, 6))


async def _look(rig: SimulatedRig, axis: str) -> tuple[int, float, float]:
    """Return when the shaft was where it is seen, in which servo cycle that is, its place and its speed."""
    now_s, ago_s = asyncio.get_running_loop().time(), 0.0
    if axis not in UNITS:
        drive = rig.machine(axis).servo
        since_s, cycle_s = (
            now_s - drive.settings.phase_s,
            drive.profile.servo_cycle_s * (1 + drive.settings.drift_ppm * 1e-6),
        )
        ago_s = since_s - math.floor(since_s / cycle_s + 1e-6) * cycle_s
    truth = rig.truth(axis)
    return BEGINS_NS + round((rig.now_s - ago_s) * 1e9), truth.position, truth.velocity


class Judged(NamedTuple):
    """An instant that was asked for; lengths in counts."""

    kind: str
    inside: bool
    speed_inside: bool
    half: float
    error: float


def _kind(axis: str, status: AxisStatus) -> str:
    if axis in UNITS:
        return "follow"
    verb = status.command.verb.value if status.command else ""
    return KINDS.get(verb, "stand") if status.moving is not Moving.NO or verb else "stand"


def _judge(rig: SimulatedRig, seen: tuple[str, str, int, float, float]) -> Judged | None:
    name, kind, t, place, speed = seen
    axis = rig.daemon.rig.axes[name]
    found, per_unit = (
        axis.readings.at(t),
        abs(axis.tracker.status.scale.counts_per_unit),
    )
    at, speeds = found.position, found.velocity
    if at is None or speeds is None:
        return None
    inside, speed_inside = at.lower <= place <= at.upper, speeds.lower <= speed <= speeds.upper
    return Judged(kind, inside, speed_inside, (at.upper - at.lower) / 2 * per_unit, abs(at.value - place) * per_unit)


async def _day(config: RigConfig, count: int, seed: int) -> list[Judged | None]:
    """Ask for instants of axes that move, jog, stop, home and stand, and compare with their shafts."""
    rng, judged = random.Random(seed), []
    async with simulated_rig(config, seed=seed) as rig:
        every = tuple(rig.daemon.rig.axes)
        async with rig.client.control(*(name for name in every if name not in UNITS), client="day") as held:
            axes = (held,) if isinstance(held, Axis) else held
            lives = [asyncio.create_task(_live(axis, random.Random(seed * 10 + i))) for i, axis in enumerate(axes)]
            units = [name for name in every if name in UNITS]
            lives += [asyncio.create_task(_turn(rig, name, random.Random(f"{seed} {name}"))) for name in units]
            await asyncio.sleep(2)
            seen: list[tuple[str, str, int, float, float]] = []
            while len(judged) < count:
                name = rng.choice(every)
                for _ in range(LOOKS):
                    kind = _kind(name, rig.daemon.rig.axes[name].tracker.status)
                    seen.append((name, kind, *(await _look(rig, name))))
                    await asyncio.sleep(rng.uniform(0.001, 0.02))
                known = BEGINS_NS + (rig.now_s - KNOWN_AFTER_S) * 1e9
                while seen and seen[0][2] < known:
                    judged.append(_judge(rig, seen.pop(0)))
            for life in lives:
                life.cancel()
            await asyncio.gather(*lives, return_exceptions=True)
            for axis in axes:
                await axis.stop()
    return judged


def _ratio(judged: Sequence[Judged], least: float) -> float:
    return statistics.median(each.half / max(each.error, least) for each in judged)


def judge(name: str, hz: float, count: int, seed: int, share: float, most_ratio: float = 2.0) -> list[Judged]:
    """Judge a rig that polls so often, say how its bounds were, and return all instants.

    Their ratio is half the width between the bounds over the error of the value, |value - truth|, in the median of all
    instants. An error of less than a count counts as one, for a counter tells no less; the ratio to fractions of a
    count, which no bound can promise, is printed beside it.
    """
    config = load_config(Path("config") / f"{name}.toml")
    asked = run(_day(with_rate(config, hz), count, seed))
    judged = [each for each in asked if each]
    kinds = {kind: [each for each in judged if each.kind == kind] for kind in sorted({each.kind for each in judged})}
    for kind, some in {**kinds, "all": judged}.items():
        inside, speeds = statistics.fmean(e.inside for e in some), statistics.fmean(e.speed_inside for e in some)
        print(
            f"{name} at {hz:g} Hz, seed {seed}, {kind}: {len(some)} instants, {inside:.3%} inside, velocities"
            f" {speeds:.3%}; half width {statistics.median(e.half for e in some):.2f} counts, error"
            f" {statistics.median(e.error for e in some):.2f}; ratio {_ratio(some, 1.0):.2f}, of fractions of a count"
            f" {_ratio(some, 1e-3):.2f}"
        )
    assert len(judged) >= 0.97 * len(asked)
    assert statistics.fmean(each.inside for each in judged) >= share
    assert statistics.fmean(each.speed_inside for each in judged) >= share - 0.002
    assert _ratio(judged, 1.0) <= most_ratio
    return judged


def with_rate(config: RigConfig, hz: float) -> RigConfig:
    """Return a rig whose axes are read so often; a SmartStep answers a twentieth as often, with its monitors."""

    def axis(each: AxisConfig) -> AxisConfig:
        rate = hz / 20 if each.name in UNITS else hz
        return each.model_copy(update={"rates": each.rates.model_copy(update={"position": rate})})

    buses = [bus.model_copy(update={"axis": tuple(axis(each) for each in bus.axis)}) for bus in config.bus]
    return config.model_copy(update={"bus": tuple(buses)})


@pytest.mark.parametrize("rig", ["simulated", "mixed"])
def test_a_shaft_was_within_the_bounds_of_an_instant(rig: str):
    judge(rig, 20, 200, 3, 0.99)


@pytest.mark.long
@pytest.mark.parametrize("hz", [5, 20, 100])
def test_the_shaft_was_within_the_bounds_of_4000_instants(hz: float):
    judge("simulated", hz, 4000, 3, 0.997, 2.0 if hz >= FAST_HZ else SLOW_RATIO)


@pytest.mark.soak
def test_the_shaft_was_within_the_bounds_of_100000_instants():
    judged: list[Judged] = []
    for rig, hz in (*(("simulated", hz) for hz in (5, 10, 20, 50, 100)), ("mixed", 20)):
        judged += judge(rig, hz, 17_000, 4, 0.999, 2.0 if hz >= FAST_HZ else SLOW_RATIO)
    inside, ratio = statistics.fmean(each.inside for each in judged), _ratio(judged, 1.0)
    print(f"all rates: {len(judged)} instants, {inside:.4%} inside, ratio {ratio:.3f}")
    assert inside >= 0.999
    assert ratio <= 2.0


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


@pytest.mark.long
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


def test_a_query_of_a_range_answers_its_ends_and_every_reading_and_refuses_too_many():
    async def program() -> None:
        async with simulated_rig(Path("config/simulated.toml"), seed=1) as rig, rig.network.session() as session:
            await asyncio.sleep(60)
            now = BEGINS_NS + round(rig.now_s * 1e9)
            t, until = now - 3 * 10**9, now - 10**9
            told = await session.query("ldcn/sim/tele/x/at", parameters={"_time": f"[{t}..{until}]"})
            found = [json.loads(each.payload) for each in told]
            instants = [each["t"] for each in found]
            assert (instants[0], instants[-1]) == (t, until)
            assert instants == sorted(set(instants))
            assert 36 <= len(found) <= 46  # 2 s of 20 polls a second, and what was read besides
            assert all(each["position"]["lower"] <= 0.0 <= each["position"]["upper"] for each in found)
            assert [each.t for each in (await rig.client.between(t, until))["x"]] == instants
            (many,) = await session.query("ldcn/sim/tele/*/at", parameters={"_time": "[now(-59s)..now(-1s)]"})
            assert many.is_error
            assert "1000" in json.loads(many.payload)["message"]
            for none in ("[now(-1s)..now(-2s)]", "[now(-2s)..]", "[]", "now(-2s)..now(-1s)"):
                (refused,) = await session.query("ldcn/sim/tele/x/at", parameters={"_time": none})
                assert refused.is_error, none

    run(program())


async def _shuttle(rig: SimulatedRig, rng: random.Random, moves: int) -> list[tuple[int, float, float]]:
    """Let an axis go to and fro, and turn it round on its way; return where its shaft was."""
    seen: list[tuple[int, float, float]] = []

    async def look() -> None:
        while True:
            seen.append(await _look(rig, "x"))
            await asyncio.sleep(0.01)

    async with rig.client.control("x", client="day") as x:
        await x.power(on=True)
        await asyncio.sleep(3)
        looking = asyncio.create_task(look())
        for _ in range(moves):
            await x.move_relative(rng.uniform(-10, 10))
            await asyncio.sleep(rng.uniform(0.05, 0.6))
            await (await x.move_relative(rng.uniform(-10, 10), buffer_mode="aborting")).done()
            for distance in (0.5, -0.5):
                await (await x.move_relative(distance)).done()
        await asyncio.sleep(3)
        looking.cancel()
    return seen


@pytest.mark.parametrize("hz", [1, 2, 5])
def test_the_bounds_of_an_axis_that_is_read_too_seldom_hold_motions_between_two_readings(hz: float):
    async def program() -> None:
        config = with_rate(load_config(Path("config/simulated.toml")), hz)
        async with simulated_rig(config, seed=hz) as rig:
            seen = await _shuttle(rig, random.Random(hz), 6)
            await asyncio.sleep(4 / hz)
            judged = [_judge(rig, ("x", "move", *each)) for each in seen]
            known = [each for each in judged if each]
            print(f"{hz} Hz: {len(known)} of {len(judged)} known")
            print(statistics.fmean(e.inside for e in known), statistics.fmean(e.speed_inside for e in known), "Hz:")
            assert len(known) > 0.9 * len(judged)
            assert statistics.fmean(each.inside and each.speed_inside for each in known) >= 0.999

    run(program())


def test_where_an_axis_was_before_it_was_lost_stays_known_and_a_lost_place_is_not_good():
    async def program() -> None:
        async with simulated_rig(Path("config/simulated.toml"), seed=1) as rig:
            async with rig.client.control("x", client="day") as x:
                await x.power(on=True)
                await x.set_position(5.0)
                await (await x.move_absolute(7.0)).done()
                await asyncio.sleep(1)
                t = BEGINS_NS + round((rig.now_s - 0.5) * 1e9)
                before = await x.at(t)
                assert (before.quality, before.referenced) == ("good", True)
                rig.faults.power_loss("x", for_s=1.0)
                status = rig.daemon.rig.axes["x"].tracker
                await rig.until(lambda: status.status.reference_lost and status.status.link is LinkState.UP)
                await asyncio.sleep(3)
                assert await x.at(t) == before
                since = await x.at(BEGINS_NS + round((rig.now_s - 1) * 1e9))
                assert (since.quality, since.referenced) == ("uncertain", False)

    run(program())


def test_an_instant_has_the_quality_of_then():
    async def program() -> None:
        async with simulated_rig(Path("config/simulated.toml"), seed=1) as rig:
            async with rig.client.control("x", client="day") as x:
                await asyncio.sleep(2)
                t = BEGINS_NS + round((rig.now_s - 1) * 1e9)
                assert (await x.at(t)).quality == "good"
                rig.faults.mute("x")
                status = rig.daemon.rig.axes["x"].tracker
                await rig.until(lambda: status.status.link is LinkState.DEGRADED)
                assert (await x.at(t)).quality == "good"  # though the drive does not answer by now

    run(program())
