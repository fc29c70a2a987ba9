"""A late reply makes no module one that has lost its power: what it was set to stays, and nothing is written to it."""

import asyncio
import random

import pytest

from ldcnd.client.events import latest_events
from ldcnd.config.rig import load_config
from ldcnd.testing import run, simulated_rig
from tests.support.process import ROOT

CENTRIFUGE = load_config(ROOT / "config" / "centrifuge.toml")
ROUGH_S = 60.0


async def restarts(rig) -> int:
    """Return for how many of its outputs the module was given the level of one that has lost its power."""
    events = await latest_events(rig.client.client, 1000, "cabinet")
    return sum("its level of reset" in (each.reason or "") for each in events)


async def history(seed: int) -> tuple[int, int]:
    """Have all modules lose their power once, and then a line that loses replies and brings others late."""
    draw = random.Random(seed)
    async with simulated_rig(CENTRIFUGE, seed=seed) as rig:
        module = rig.lines["line0"].modules[1]
        await asyncio.sleep(2.0)
        rig.faults.power_loss("rotor", after_s=0.5, for_s=1.0)
        module.power(on=False, at_s=rig.now_s)
        await asyncio.sleep(1.0)
        module.power(on=True, at_s=rig.now_s)
        rig.faults.noise(0.02, for_s=2.0)
        await asyncio.sleep(15.0 + draw.uniform(0.5, 3.0))
        before = await restarts(rig)
        rig.faults.late_replies(0.2, for_s=ROUGH_S)
        rig.faults.noise(draw.uniform(0.01, 0.05), for_s=ROUGH_S)
        rig.faults.lost_replies(draw.uniform(0.2, 0.6), for_s=ROUGH_S)
        await asyncio.sleep(ROUGH_S + 6.0)
        return before, await restarts(rig)


@pytest.mark.parametrize("seed", [5, *range(5), *range(6, 60)])
@pytest.mark.sweep(60)
def test_a_module_whose_answers_come_late_is_not_taken_for_one_that_has_restarted(seed: int):
    before, after = run(history(seed))

    assert before == after == 3
