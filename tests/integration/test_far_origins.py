"""A place may be called by no number at which its counts could not be told apart: every later motion would fail."""

import math

import pytest

from ldcnd.contract.commands import Home, Jog, MoveAbsolute, MoveRelative, Power, SetPosition
from ldcnd.contract.errors import ErrorCode, LdcndError, ValueOutOfRange
from ldcnd.contract.samples import LinkState, Moving
from ldcnd.sim.ldcn.chain import build_chain
from tests.integration.test_intruders import four_drives
from tests.support.chain_rig import rig_on, simulated_config


@pytest.mark.parametrize("command", [MoveAbsolute(position=1e308), MoveRelative(distance=-1e307)])
async def test_a_motion_farther_than_any_counter_counts_is_refused_with_the_nearest(command):
    limits = {"velocity": 200, "acceleration": 2000}
    async with rig_on(build_chain(four_drives()), simulated_config({"reference": "at_reset", "limits": limits})) as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP and state.moving is Moving.NO)
        await rig.client.command("x", Power(on=True))
        with pytest.raises(ValueOutOfRange) as refused:
            await rig.client.command("x", command)
        state = await rig.client.state("x")

    assert refused.value.nearest == pytest.approx(math.copysign((2**31 - 1) / 1000, refused.value.value), abs=1)
    assert state.moving is Moving.NO


@pytest.mark.parametrize("axis", ["x", "z"])
async def test_a_position_that_no_count_can_tell_is_refused_and_the_nearest_works(axis):
    limits = {"velocity": 200, "acceleration": 2000}
    async with rig_on(build_chain(four_drives()), simulated_config({"reference": "at_reset", "limits": limits})) as rig:
        await rig.until(axis, lambda state: state.link is LinkState.UP and state.moving is Moving.NO)
        await rig.client.command(axis, Power(on=True))
        for command in (SetPosition(position=1e308), Home(position=-1e300)):
            with pytest.raises(ValueOutOfRange) as refused:
                await rig.client.command(axis, command)
            state = await rig.client.state(axis)
            assert state is not None
            assert state.referenced

        assert refused.value.nearest is not None
        codes = list[ErrorCode]()
        await rig.client.command(axis, SetPosition(position=refused.value.nearest))
        for command in (MoveRelative(distance=0.5), Jog(velocity=1.0), MoveAbsolute(position=0.0)):
            try:
                reply = await rig.client.command(axis, command)
                await rig.client.wait_for_end(axis, reply.command_id)
            except LdcndError as error:
                codes.append(error.code)
        assert ErrorCode.INTERNAL not in codes
