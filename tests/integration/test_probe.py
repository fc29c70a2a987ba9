"""`probe`: a move that ends at an input, with the position that the drive has latched and its bound."""

import asyncio

import pytest

from ldcnd.contract.commands import Probe
from ldcnd.contract.errors import MalformedRequest, NotSupported, VelocityLimit
from ldcnd.contract.samples import AxisState, LatchSample, TelemetryItem
from tests.support.dialect_rig import AXIS, LS_173AP, LS_182AP, LS_182AP_22, PLANT, SC, V1, V2, V4, dialect_rig

able = pytest.mark.parametrize("dialect", [V1, V2, V4, SC, LS_182AP, LS_182AP_22], ids=lambda dialect: dialect.name)


async def latched(rig) -> LatchSample:
    sample = await rig.rig.client.last(AXIS, TelemetryItem.LATCH)
    assert isinstance(sample, LatchSample)
    return sample


@able
@pytest.mark.parametrize("velocity", [1.0, 10.0])
@pytest.mark.sweep(12)
async def test_a_switch_is_latched_within_its_bound_and_the_reference_stays(dialect, velocity):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()

        reply = await rig.send(Probe(sources=("forward_limit",), position=23.0, velocity=velocity))
        state = await rig.rig.client.wait_for_end(AXIS, reply.command_id)
        latch = await latched(rig)

        assert (state.state, state.last_error, state.referenced) == (AxisState.STANDSTILL, None, True)
        assert latch.command_id == reply.command_id
        assert 0.0 <= latch.value - 20.0 <= latch.error
        assert latch.error == pytest.approx(velocity * 0.000512 + 0.001, rel=0.01)
        assert rig.position_mm < 20.0 + velocity**2 / 400 + 0.06 * velocity + 0.1


async def test_of_several_sources_the_first_that_comes_counts():
    plant = PLANT.model_copy(update={"index_at_counts": 3000, "index_spacing_counts": 100_000})
    async with dialect_rig(V4, plant) as rig:
        await rig.power_on()

        state = await rig.done(Probe(sources=("forward_limit", "index"), distance=23.0, velocity=1.0))

        assert state.last_error is None
        assert (await latched(rig)).value == pytest.approx(3.0, abs=0.006)


async def test_a_probe_that_finds_nothing_has_failed_and_stands_at_its_end():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()

        state = await rig.done(Probe(sources=("forward_limit",), distance=5.0))

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, "probe: no input came on the way")
        assert rig.position_mm == pytest.approx(5.0, abs=0.02)
        assert await rig.rig.client.last(AXIS, TelemetryItem.LATCH) is None


@pytest.mark.long
async def test_the_limit_switch_ahead_ends_a_probe_for_something_else():
    async with dialect_rig(
        LS_182AP,
        PLANT.model_copy(update={"index_at_counts": -15_000, "index_spacing_counts": 100_000}),
        limit_switches="stop",
    ) as rig:
        await rig.power_on()

        state = await rig.done(Probe(sources=("index",), distance=24.0, velocity=1.0))

        assert state.last_error == "probe: the drive stopped at the forward limit switch"
        assert rig.position_mm == pytest.approx(20.0, abs=0.05)
        assert await rig.rig.client.last(AXIS, TelemetryItem.LATCH) is None


async def test_what_cannot_be_latched_is_refused():
    async with dialect_rig(LS_173AP) as rig:
        await rig.power_on()

        with pytest.raises(NotSupported, match="cannot latch on forward_limit; it can on index"):
            await rig.send(Probe(sources=("forward_limit",), distance=5.0))
        with pytest.raises(VelocityLimit, match="can miss an index pulse"):
            await rig.send(Probe(sources=("index",), distance=5.0, velocity=10.0))
        with pytest.raises(MalformedRequest, match="exactly one"):
            await rig.send(Probe(sources=("index",), distance=5.0, position=5.0))


@pytest.mark.parametrize("dialect", [V4, SC, LS_182AP], ids=lambda dialect: dialect.name)
@pytest.mark.sweep(2)
async def test_a_probe_ends_at_the_input_when_the_host_is_dead(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        await rig.send(Probe(sources=("forward_limit",), distance=24.0, velocity=10.0))
        await asyncio.sleep(0.5)
        rig.chain.unplug(asyncio.get_running_loop().time())
        await asyncio.sleep(5.0)

        rig.drive.catch_up(asyncio.get_running_loop().time())
        assert rig.position_mm == pytest.approx(20.25, abs=0.05)
