"""An axis that something else than a command has moved outside its software limits says so, and can move back."""

import asyncio

import pytest

from ldcnd.axis.scale import AxisScale
from ldcnd.axis.status import SoftLimits
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.samples import LinkState, Moving
from ldcnd.contract.units import AxisUnits
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import build_chain
from tests.integration.test_intruders import codes, four_drives, standing_at
from tests.support.chain_rig import drive, rig_on, simulated_config

WRONG = "outside_limits"


async def pushed(chain: Chain, address: int, counts: int, pace: int = 20) -> None:
    """Turn the shaft of a motor that is off as a hand does, not at once."""
    shaft = drive(chain, address).shaft
    for _ in range(abs(counts) // pace):
        shaft.position_counts += pace if counts > 0 else -pace
        await asyncio.sleep(0.01)


@pytest.mark.parametrize(("position", "units"), [(98.0, 3), (-98.0, -3)])
async def test_an_axis_that_a_hand_has_pushed_over_its_limit_says_so_until_it_is_back(position, units):
    chain = build_chain(four_drives())
    async with rig_on(chain, simulated_config({"reference": "at_reset"})) as rig:
        await standing_at(rig, "x", position, on=False)
        scale = next(each for each in rig.line.axes if each.config.name == "x").tracker.status.scale
        assert WRONG not in codes(rig, "x")

        await pushed(chain, 1, round(units * scale.counts_per_unit))
        await rig.until("x", lambda state: state.moving is Moving.NO and state.link is LinkState.UP)
        outside = codes(rig, "x")
        place = await rig.client.state("x")
        await rig.client.command("x", Power(on=True))
        reply = await rig.client.command("x", MoveAbsolute(position=position))
        await rig.client.wait_for_end("x", reply.command_id)
        await asyncio.sleep(0.3)

        assert WRONG in outside
        assert place is not None
        assert place.referenced
        assert WRONG not in codes(rig, "x")
        assert drive(chain, 1).shaft.position_counts / scale.counts_per_unit == pytest.approx(position, abs=0.1)


@pytest.mark.parametrize("counts_per_unit", [10.0, -10.0])
def test_the_counts_that_limits_allow_are_right_for_either_direction_of_an_axis(counts_per_unit):
    scale = AxisScale(AxisUnits("mm", {}), counts_per_unit).with_position(500, 2.0)
    span = SoftLimits(-1.0, 4.0, 3.0).span(scale)
    ends = sorted((scale.counts(-1.0), scale.counts(4.0)))
    assert span == (ends[0] - 3, ends[1] + 3)


async def test_narrower_limits_mark_an_axis_that_stands_outside_them_and_wider_ones_do_not():
    chain = build_chain(four_drives())
    async with rig_on(chain, simulated_config({"reference": "at_reset"})) as rig:
        await standing_at(rig, "x", 50.0)
        service = next(each for each in rig.line.axes if each.config.name == "x")
        seen = []
        for highest in (40.0, 60.0):
            limits = service.config.limits.model_copy(update={"position_max": highest})
            service.reconfigure(service.config.model_copy(update={"limits": limits}))
            await asyncio.sleep(0.5)
            seen.append(WRONG in codes(rig, "x"))
        assert seen == [True, False]


async def test_a_warning_is_not_named_as_what_has_stopped_an_axis():
    chain = build_chain(four_drives())
    async with rig_on(chain, simulated_config({"reference": "at_reset"})) as rig:
        await standing_at(rig, "x", 98.0, on=False)
        scale = next(each for each in rig.line.axes if each.config.name == "x").tracker.status.scale
        await pushed(chain, 1, round(5 * scale.counts_per_unit))
        await rig.until("x", lambda state: state.moving is Moving.NO)
        assert WRONG in codes(rig, "x")

        chain.modules[0].power(on=False, at_s=asyncio.get_running_loop().time())
        await rig.until("x", lambda state: state.link is LinkState.DOWN)
        first = next(each for each in rig.line.axes if each.config.name == "x").tracker.status.first_fault
        assert first is not None
        assert first.code == "link_lost"
