"""The bits of the trigger word, found on simulated drives whose bits lie anywhere."""

import asyncio

import pytest

from ldcnd.contract.errors import DriveFault
from ldcnd.drives.smartstep.monitors import InputSignal
from ldcnd.drives.smartstep.profiles import TriggerMap
from ldcnd.drives.smartstep.trigger_search import Stimulus, find_trigger_map
from ldcnd.sim.smartstep.variant import BENCH_TRIGGER_MAP, SimulatedVariant
from tests.support.smartstep_line import simulated, smartstep_line

MAPS = [
    BENCH_TRIGGER_MAP,
    *(
        pytest.param(bits, marks=pytest.mark.soak)  # the further down its bits lie, the longer the search
        for bits in (
            TriggerMap(trace1=0x0000, trace2=0x0010, io=0x0020, rising=0x4000, falling=0x8000),
            TriggerMap(trace1=0x0002, trace2=0x0003, io=0x0000, rising=0x0020, falling=0x0010),
        )
    ),
]


def person(unit):
    """Do with the drive what the search asks of a person."""

    async def act(stimulus: Stimulus) -> None:
        drive, now_s = unit.drive, asyncio.get_running_loop().time()
        drive.advance(now_s)
        match stimulus:
            case Stimulus.TURN:
                drive.motor.speed = 4000.0
            case Stimulus.PRESS:
                drive.inputs &= ~InputSignal.RESET
            case Stimulus.RELEASE:
                drive.inputs |= InputSignal.RESET

    return act


@pytest.mark.parametrize("bits", MAPS)
async def test_the_bits_of_a_drive_are_found_and_nothing_is_left_armed(bits):
    unit = simulated(1, SimulatedVariant(trigger_map=bits))
    async with smartstep_line([unit]) as line:
        found = await find_trigger_map(line.axis("u1").words, person(unit))

    assert found == bits
    assert unit.drive.mode == 0
    assert sum(unit.drive.memory.writes.values()) == 0


async def test_a_person_who_does_nothing_finds_nothing():
    unit = simulated(1)

    async def nothing(_stimulus: Stimulus) -> None:
        return

    async with smartstep_line([unit]) as line:
        with pytest.raises(DriveFault, match="were not found"):
            await find_trigger_map(line.axis("u1").words, nothing)

    assert unit.drive.mode == 0
