"""PyLabRobot's own front end drives the centrifuge through whole cycles, and meets what can go wrong with one."""

import asyncio
import math
import sys

import pytest
from pylabrobot.centrifuge import Centrifuge
from pylabrobot.serializer import deserialize

from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import IoSample, Quality, TelemetryItem
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.testing import run, simulated_rig
from tests.support.process import ROOT

sys.path.insert(0, str(ROOT / "examples"))
from pylabrobot_centrifuge import LdcndCentrifuge

pytestmark = pytest.mark.edges
SAFE = 0.2
"""Revolutions a second; faster than the hunting of a rotor that stands."""


def revolutions_of(g):
    return math.sqrt(g * 9.80665 / 0.1) / math.tau


class Looker:
    """Looks at the machine itself in every hundredth of a second, as a console and a recorder look on."""

    def __init__(self, rig):
        self.rig = rig
        self.fastest = 0.0
        self.seen = 0
        self.io = rig.lines["line0"].modules[1]
        self.drive = rig.lines["line0"].modules[0]

    @property
    def door(self):
        self.io.catch_up(asyncio.get_running_loop().time())
        return self.io.around.at("door")

    async def look(self):
        while True:
            speed = abs(self.rig.truth("rotor").velocity)
            assert speed < SAFE or self.door == 0.0, f"{speed} rev/s with an open door"
            self.fastest = max(self.fastest, speed)
            await asyncio.sleep(0.01)

    async def record(self):
        async for _, sample in self.rig.client.samples():
            self.seen += isinstance(sample, IoSample)


def cycled(program):
    async def whole():
        async with simulated_rig(ROOT / "config" / "centrifuge.toml") as rig, asyncio.TaskGroup() as tasks:
            looker = Looker(rig)
            looking = [tasks.create_task(looker.look()), tasks.create_task(looker.record())]
            centrifuge = Centrifuge(backend=LdcndCentrifuge(), name="centrifuge", size_x=1, size_y=1, size_z=1)
            await centrifuge.setup()
            await program(centrifuge, looker)
            await centrifuge.stop()
            assert not rig.truth("rotor").energised
            for task in looking:
                task.cancel()
            return looker

    return run(whole())


def test_buckets_are_loaded_and_spun_at_100_g_and_at_1000_g():
    async def cycles(centrifuge, looker):
        for g, bucket in ((100, 0.1), (1000, 0.6)):
            await (centrifuge.go_to_bucket1 if g == 100 else centrifuge.go_to_bucket2)()
            assert looker.rig.truth("rotor").position % 1 == pytest.approx(bucket, abs=0.003)
            assert centrifuge.door_open or looker.door == 1.0
            await centrifuge.lock_bucket()
            await centrifuge.unlock_bucket()
            await centrifuge.close_door()
            looker.fastest = 0.0
            await centrifuge.spin(g=g, duration=20, acceleration=1.0)
            assert looker.fastest == pytest.approx(revolutions_of(g), rel=0.02)
            assert looker.door == 0.0

    assert cycled(cycles).seen > 100


def test_a_rotor_out_of_balance_ends_its_spin_and_the_next_one_runs():
    async def unbalanced(centrifuge, looker):
        now_s = asyncio.get_running_loop().time
        looker.drive.set_condition(FaultCondition.UNBALANCED, present=True, at_s=now_s())
        with pytest.raises(LdcndError, match="interlock balance"):
            await centrifuge.spin(g=1000, duration=20, acceleration=1.0)
        await looker.rig.at_rest("rotor")
        looker.drive.set_condition(FaultCondition.UNBALANCED, present=False, at_s=now_s())
        await centrifuge.go_to_bucket1()
        await centrifuge.spin(g=100, duration=5)

    assert cycled(unbalanced).fastest == pytest.approx(revolutions_of(100), rel=0.05)


def test_a_door_that_jams_is_said_and_nothing_turns():
    async def jammed(centrifuge, looker):
        await centrifuge.open_door()
        looker.io.jam("door", jammed=True, at_s=asyncio.get_running_loop().time())
        looker.fastest = 0.0
        with pytest.raises(RuntimeError, match="door_closed"):
            await centrifuge.spin(g=100, duration=5)
        assert looker.fastest < SAFE
        looker.io.jam("door", jammed=False, at_s=asyncio.get_running_loop().time())
        await centrifuge.close_door()

    cycled(jammed)


def test_a_door_that_is_shut_is_locked_although_a_reply_of_the_cabinet_was_lost():
    async def loses_a_reply(centrifuge, looker):
        await centrifuge.close_door()
        line = looker.rig.lines["line0"]
        async with looker.rig.client.samples("cabinet", TelemetryItem.IO) as samples:
            line.mute(2, on=True)
            async for _, sample in samples:
                if sample.quality is Quality.UNCERTAIN:
                    break
        line.mute(2, on=False)
        await centrifuge.lock_door()

    cycled(loses_a_reply)


def test_a_program_that_comes_while_the_rotor_spins_brings_it_to_rest_before_it_opens_anything():
    async def arrives():
        async with simulated_rig(ROOT / "config" / "centrifuge.toml") as rig:
            first = Centrifuge(backend=LdcndCentrifuge(), name="first", size_x=1, size_y=1, size_z=1)
            await first.setup()
            spinning = asyncio.create_task(first.spin(g=1000, duration=600, acceleration=1.0))
            await rig.until(lambda: abs(rig.truth("rotor").velocity) > 30)
            spinning.cancel()
            await asyncio.gather(spinning, return_exceptions=True)
            await first.stop()
            second = Centrifuge(backend=LdcndCentrifuge(), name="second", size_x=1, size_y=1, size_z=1)
            await second.setup()
            await second.go_to_bucket1()
            await second.stop()

    run(arrives())


def test_the_backend_is_made_again_from_what_pylabrobot_keeps_of_it():
    kept = LdcndCentrifuge("tcp/127.0.0.1:7447", bucket1=0.12).serialize()

    again = deserialize(kept)

    assert isinstance(again, LdcndCentrifuge)
    assert again.serialize() == kept
