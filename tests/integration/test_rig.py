"""The whole daemon on the jumping clock."""

import pytest

from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.samples import AxisState
from tests.support.rig import running_rig


async def test_a_newcomer_powers_an_axis_and_moves_it():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.state is AxisState.DISABLED)

        await rig.client.command("x", Power(on=True))
        reply = await rig.client.command("x", MoveAbsolute(position=10.0))
        state = await rig.client.wait_for_end("x", reply.command_id)

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        assert reply.position == pytest.approx(10.0)
