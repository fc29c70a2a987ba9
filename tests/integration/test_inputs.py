"""The inputs of a drive as a topic: what every poll carries anyway, published when it changes."""

import asyncio
from collections.abc import Callable

import pytest

from ldcnd.contract.commands import MoveAbsolute, Stop
from ldcnd.contract.samples import InputsSample, TelemetryItem
from ldcnd.sim.ldcn.power import FaultCondition
from tests.support.dialect_rig import AXIS, LS_182AP, PLANT, SC, V4, DialectRig, dialect_rig

dialects = pytest.mark.parametrize("dialect", [V4, SC, LS_182AP], ids=lambda dialect: dialect.name)


async def inputs(rig: DialectRig, wanted: Callable[[InputsSample], bool] = lambda _: True) -> InputsSample:
    async with asyncio.timeout(5.0), rig.rig.client.samples(AXIS, TelemetryItem.INPUTS) as samples:
        async for _, sample in samples:
            assert isinstance(sample, InputsSample)
            if wanted(sample):
                return sample
    raise AssertionError


@dialects
@pytest.mark.sweep(2)
async def test_a_limit_switch_shows_in_the_poll_that_carries_it(dialect):
    async with dialect_rig(dialect, rates={"position": 100, "state": 1}) as rig:
        await rig.power_on()
        before = await inputs(rig, lambda sample: sample.forward_limit is False)
        await rig.send(MoveAbsolute(position=21.0, velocity=10.0))
        at_switch = await inputs(rig, lambda sample: sample.forward_limit is True)
        seen_at = rig.position_mm

        assert (before.reverse_limit, before.amplifier_enable) == (False, True)
        assert at_switch.reverse_limit is False
        assert 20.0 <= seen_at < 20.3  # one poll at 10 mm/s is 0.1 mm, with state alone it were 10


async def test_the_stop_input_shows_while_the_power_driver_is_off_and_limits_while_it_is_on():
    async with dialect_rig(LS_182AP) as rig:
        off = await inputs(rig, lambda sample: sample.amplifier_enable is False)
        rig.drive.set_condition(FaultCondition.STOP_INPUT, present=True, at_s=asyncio.get_running_loop().time())
        open_circuit = await inputs(rig, lambda sample: sample.stop_input is True)

        assert (off.stop_input, off.forward_limit) == (False, None)
        assert open_circuit.forward_limit is None


async def test_the_amplifier_enable_follows_power_and_stops():
    async with dialect_rig(V4) as rig:
        assert (await inputs(rig)).amplifier_enable is False
        await rig.power_on()
        await inputs(rig, lambda sample: sample.amplifier_enable is True)
        await rig.send(Stop())
        assert (await inputs(rig)).amplifier_enable is True


@dialects
@pytest.mark.parametrize("on_index", [True, False])
async def test_the_index_is_shown_as_a_level_whatever_bit_the_drive_sends(dialect, on_index):
    plant = PLANT.model_copy(update={"index_at_counts": 0 if on_index else 500, "index_width_counts": 8})
    async with dialect_rig(dialect, plant, start_counts=4.0) as rig:
        await rig.power_on()

        assert (await inputs(rig, lambda sample: sample.index is not None)).index is on_index
