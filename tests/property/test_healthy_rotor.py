"""A rotor that coasts and is well: whatever a person asks of it, in whatever order, no watch finds it broken."""

import asyncio
import random
from contextlib import suppress

import pytest
from structlog.testing import capture_logs

from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import Moving
from ldcnd.testing import run, simulated_rig
from tests.integration.test_centrifuge import CENTRIFUGE, made_ready
from tests.support.process import ROOT

SPEEDS = (0.2, 0.5, 1.0, 2.0, 5.0, 8.0, 16.0, 25.0, 40.0)
PAUSES_S = (0.1, 0.3, 1.0, 2.0, 4.0)
LONGEST_REST_S = 120.0


async def asked(machine, dice):
    """Ask one thing of the rotor, and return what; it may be refused."""
    rotor, kind = machine.rotor, dice.choice(("run", "run", "run", "override", "stop", "move", "wait"))
    with suppress(LdcndError):
        if kind == "run":
            speed = dice.choice(SPEEDS) * dice.choice((1, 1, 1, -1))
            await rotor.move_velocity(
                speed, acceleration=dice.choice((1, 4, 10)), duration_s=dice.choice((2, 5, 10, 60))
            )
        elif kind == "override":
            await machine.rig.client.set_speed_override(dice.choice((10, 30, 50, 80, 100)))
        elif kind == "stop":
            await getattr(rotor, dice.choice(("halt", "quick_stop")))()
        elif kind == "move":
            way, velocity = dice.choice((0.1, 3.3, 20.0)), dice.choice((0.5, 5, 20))
            await rotor.move_relative(way, velocity=velocity, acceleration=dice.choice((2, 10)))
    return kind


def lives(seed):
    """Return the faults that a drawn day has ended with, and what was asked until then."""
    dice = random.Random(seed)

    async def day():
        async with simulated_rig(CENTRIFUGE, seed=seed) as rig, rig.client.control("rotor", client="test") as rotor:
            machine, story = await made_ready(rig, rotor), []
            for _ in range(dice.randrange(2, 8)):
                story.append(await asked(machine, dice))
                await asyncio.sleep(dice.choice(PAUSES_S))
            await rotor.halt()
            await rig.until(lambda: rotor.state.sample.moving is Moving.NO, within_s=LONGEST_REST_S)
            faults = (await rig.client.client.last("rotor", "fault")).active
            return [each.code for each in faults], rotor.state.sample.referenced, story

    with capture_logs():
        return run(day())


async def standing_still(dice):
    """Have the process of the daemon stand still every now and then, as if others had the processor."""
    while True:
        await asyncio.sleep(dice.uniform(0.005, 0.4))
        asyncio.get_running_loop().hold_up(dice.uniform(0.2, 0.9))


async def shuttled(rotor, dice):
    """Begin a motion with an end."""
    if dice.random() < 0.7:
        way, velocity = dice.choice((0.1, 0.3, 1.0, 3.3)), dice.choice((0.5, 2, 5))
        return await rotor.move_relative(way, velocity=velocity, acceleration=dice.choice((2, 10)))
    speed, rate = dice.choice((1, 5, 16)), dice.choice((1, 4, 10))
    return await rotor.move_velocity(speed, acceleration=rate, duration_s=dice.choice((2, 4)))


def shuttles(seed, config):
    """Return the faults with which motions of a daemon that stands still now and then have ended."""
    dice = random.Random(seed)

    async def day():
        async with (
            simulated_rig(config, seed=seed) as rig,
            rig.client.control("rotor", client="test", lease_s=60) as rotor,
        ):
            await made_ready(rig, rotor)
            still = asyncio.create_task(standing_still(random.Random(seed + 7)))
            for _ in range(25):
                await (await shuttled(rotor, dice)).done()
                await asyncio.sleep(dice.choice((0, 0.3, 1.0)))
            still.cancel()
            return [each.code for each in (await rig.client.client.last("rotor", "fault")).active]

    with capture_logs():
        return run(day())


@pytest.fixture(scope="session")
def patient(tmp_path_factory):
    """The centrifuge with interlocks that bear a host that stands still for a second."""
    file = tmp_path_factory.mktemp("patient") / "centrifuge.toml"
    text = (ROOT / "config" / "centrifuge.toml").read_text(encoding="utf-8")
    file.write_text(text.replace("within_ms = 500", "within_ms = 5000"), encoding="utf-8")
    return file


@pytest.mark.parametrize("seed", [17, 32, 74])
def test_no_motion_of_a_healthy_rotor_ends_with_a_fault_where_the_host_stands_still(patient, seed):
    assert shuttles(seed, patient) == []


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("batch", range(5))
def test_no_motion_of_a_healthy_rotor_ever_ends_with_a_fault_where_the_host_stands_still(patient, batch):
    for seed in range(60 * batch, 60 * (batch + 1)):
        assert shuttles(seed, patient) == [], f"seed {seed}"


@pytest.mark.parametrize("seed", range(12))
def test_no_day_of_a_healthy_rotor_ends_with_a_fault(seed):
    faults, referenced, story = lives(seed)
    assert (faults, referenced) == ([], True), f"seed {seed}: {story}"


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("batch", range(10))
def test_no_day_of_a_healthy_rotor_ever_ends_with_a_fault(batch):
    for seed in range(100 * batch, 100 * (batch + 1)):
        faults, referenced, story = lives(seed)
        assert (faults, referenced) == ([], True), f"seed {seed}: {story}"
