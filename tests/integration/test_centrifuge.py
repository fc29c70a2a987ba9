"""The centrifuge of `config/centrifuge.toml` cannot be operated against its rules; each row of them is needed."""

import asyncio
from collections.abc import Callable
from contextlib import suppress

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.errors import InterlockViolated, LdcndError, LeaseExpired
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.io import SimulatedIo
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.testing import run, simulated_rig
from tests.support.process import ROOT

CENTRIFUGE = load_config(ROOT / "config" / "centrifuge.toml")
CLOSED = 4
"""Line of the sensor of the closed door."""
FAST = 10.0


class Centrifuge:
    """Its simulated machine, and a client that has the rotor."""

    def __init__(self, rig, rotor):
        self.rig, self.rotor = rig, rotor
        self.drive, self.io = rig.lines["line0"].modules
        assert isinstance(self.drive, SimulatedDrive)
        assert isinstance(self.io, SimulatedIo)

    async def high(self, *names):
        await self.rig.client.set_io("cabinet", high=names)

    async def spin(self):
        motion = await self.rotor.move_velocity(FAST, acceleration=10, duration_s=60)
        await self.rig.until(lambda: self.speed > FAST - 0.5)
        return motion

    async def shut_door_opens(self):
        await self.high("unlock")
        await self.sees(locked=False)
        await self.high("door")
        await self.sees(door_open=True)

    async def sees(self, **wanted):
        async with asyncio.timeout(5), self.rig.client.samples("cabinet", "io") as samples:
            async for _, sample in samples:
                if all(sample.named[name] is value for name, value in wanted.items()):
                    return

    @property
    def speed(self) -> float:
        return abs(self.rig.truth("rotor").velocity)

    def part(self, name) -> float:
        self.io.catch_up(asyncio.get_running_loop().time())
        return self.io.around.at(name)


def operated(what: Callable, without: str | None = None):
    """Return what an operation returns on the centrifuge, of whose rules one may be left away."""

    async def program():
        rules = tuple(each for each in CENTRIFUGE.interlock if each.name != without)
        async with (
            simulated_rig(CENTRIFUGE.model_copy(update={"interlock": rules})) as rig,
            rig.client.control("rotor", client="test") as rotor,
        ):
            found = Centrifuge(rig, rotor)
            await found.sees(locked=True, door_closed=True)
            await rotor.power(on=True)
            await (await rotor.home()).done()
            result = await what(found)
            await (await rotor.halt()).done()
            await rig.at_rest("rotor")
            return result

    return run(program())


async def turns_with_an_open_door(machine):
    await machine.shut_door_opens()
    with suppress(InterlockViolated):
        await (await machine.rotor.move_velocity(1.0, duration_s=1)).done()
        return True
    return False


async def goes_on_out_of_balance(machine):
    now_s = asyncio.get_running_loop().time
    machine.drive.set_condition(FaultCondition.UNBALANCED, present=True, at_s=now_s())
    with suppress(LdcndError, TimeoutError):
        await machine.rotor.move_velocity(20, acceleration=10, duration_s=10)
        await machine.rig.until(lambda: machine.speed > 19, within_s=5)
    return machine.speed > 19


async def opens_against_its_lock(machine):
    with suppress(InterlockViolated):
        await machine.high("door")
        return True
    return False


async def unlocks_in_a_spin(machine):
    await machine.spin()
    with suppress(InterlockViolated):
        await machine.high("unlock")
    await asyncio.sleep(1.0)
    return machine.part("lock") < 1.0


async def drops_its_pin_into_a_spin(machine):
    await machine.spin()
    with suppress(InterlockViolated):
        await machine.high("pin")
    await asyncio.sleep(1.0)
    return machine.part("pin") > 0.0


NEEDS = {
    "door_shut": turns_with_an_open_door,
    "balance": goes_on_out_of_balance,
    "door_opens": opens_against_its_lock,
    "lock_opens": unlocks_in_a_spin,
    "pin_goes_in": drops_its_pin_into_a_spin,
}


def test_each_row_is_asked_below():
    assert set(NEEDS) == {each.name for each in CENTRIFUGE.interlock}


@pytest.mark.parametrize("row", NEEDS)
def test_what_a_row_forbids_happens_only_without_it(row):
    assert not operated(NEEDS[row])
    assert operated(NEEDS[row], without=row)


def test_a_sensor_that_falls_out_in_a_spin_brings_the_rotor_to_rest_behind_the_locked_door():
    async def falls_out(machine):
        motion = await machine.spin()
        machine.io.drive_line(CLOSED, high=False, at_s=asyncio.get_running_loop().time())
        with pytest.raises(LdcndError):
            await motion.done()
        with pytest.raises(InterlockViolated):
            await machine.high("unlock")
        await machine.rig.at_rest("rotor")
        return machine.part("door"), machine.part("lock")

    assert operated(falls_out) == (0.0, 1.0)


def test_a_client_that_dies_in_a_spin_leaves_a_rotor_that_comes_to_rest_behind_its_locked_door():
    async def dies(machine):
        await machine.spin()
        ends.append(machine)
        machine.rig.faults.client_lost()
        await asyncio.sleep(60)

    ends: list[Centrifuge] = []
    with pytest.raises(LeaseExpired):
        operated(dies)
    (machine,) = ends
    assert (machine.io.around.at("door"), machine.io.around.at("lock")) == (0.0, 1.0)
