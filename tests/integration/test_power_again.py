"""Power that is switched on again directly behind a stop stays on; on the jumping clock."""

import asyncio

import pytest

from ldcnd.contract.commands import Power, Reset
from ldcnd.contract.samples import AxisState
from tests.support.rig import running_rig


@pytest.mark.parametrize("between", [(), (Reset(),), (Power(on=False),), (Power(on=False), Reset())], ids=str)
async def test_power_that_is_switched_on_within_a_poll_of_its_end_stays_on(between):
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.state is AxisState.DISABLED)
        await rig.client.command("x", Power(on=True))
        seen = []
        for pause_ms in range(0, 60, 1):
            await asyncio.sleep(0.2 + 0.0007 * pause_ms)
            await rig.client.command("x", Power(on=False))
            await asyncio.sleep(0.3 if len(between) == 1 else 0.0)  # it may have been seen to be off before
            for command in between:
                await rig.client.command("x", command)
            await asyncio.sleep(pause_ms / 1000)
            await rig.client.command("x", Power(on=True))
            await asyncio.sleep(0.3)
            seen.append((await rig.client.state("x")).state)
        assert seen == [AxisState.STANDSTILL] * len(seen)
