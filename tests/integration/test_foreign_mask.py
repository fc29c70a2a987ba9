"""Another program has told a drive to add items to each reply: what it says to a stop is not understood any more."""

import asyncio
from contextlib import suppress

import pytest

from ldcnd.contract.commands import MoveVelocity, Reset
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import LinkState, Moving
from ldcnd.drives.ldcn.packet import StatusItem
from tests.support.dialect_rig import AXIS, LS_182AP, SC, V4, dialect_rig


@pytest.mark.promise("stop-until-confirmed")
@pytest.mark.parametrize("dialect", [V4, LS_182AP, SC], ids=lambda each: each.name)
async def test_its_stop_is_confirmed_and_it_is_understood_again(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=2.0))
        await asyncio.sleep(0.5)
        rig.drive.items = StatusItem.POSITION
        await asyncio.sleep(0.5)
        with suppress(LdcndError):
            await rig.rig.client.stop(AXIS)

        async with asyncio.timeout(5.0):
            state = await rig.until(lambda state: state.link is LinkState.UP and not state.stop_pending)
            await rig.until(lambda state: state.moving is Moving.NO)
        assert state.stop_latched
        await rig.send(Reset())
        await rig.send(MoveVelocity(velocity=1.0))
