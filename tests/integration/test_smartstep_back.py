"""A SmartStep whose supply fails for a moment while its pulses come: it answers again, whatever was lost meanwhile."""

import asyncio

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.samples import LinkState, Moving
from ldcnd.sim.smartstep.cable import smartstep_chain
from tests.support.rig import running_rig
from tests.support.smartstep_line import simulated

FEED = {"name": "feed", "address": 1, "model": "smartstep", "unit": "mm", "counts_per_unit": 800}
RIG = {
    "rig": "bench",
    "bus": [{"name": "steps", "port": "sim:steps", "family": "smartstep", "axis": [FEED]}],
    "sim": [{"name": "steps", "unit": [{"number": 1}]}],
}


@pytest.mark.parametrize("off_s", [1.5, 1.9, 2.0, 2.2, 3.0, 4.0])
@pytest.mark.parametrize("at_s", [12.0, 12.1, 12.23, 12.37, 12.5, 12.71])
@pytest.mark.sweep(5)
async def test_a_drive_that_turns_and_loses_its_power_for_a_moment_answers_again(off_s, at_s):
    unit, began_s = simulated(1), asyncio.get_running_loop().time()
    unit.drive.set_run(began_s, on=True)
    unit.drive.set_pulse_rate(2000.0, began_s)
    unit.schedule(began_s + at_s, unit.power_off)
    unit.schedule(began_s + at_s + off_s, unit.power_on)
    async with running_rig(RigConfig.model_validate(RIG), chains={"steps": smartstep_chain([unit])}) as rig:
        await asyncio.sleep(10.0)
        before = await rig.client.state("feed")
        await asyncio.sleep(20.0)
        after = await rig.client.state("feed")

    assert (before.link, before.moving) == (LinkState.UP, Moving.YES)
    assert after.link is LinkState.UP
