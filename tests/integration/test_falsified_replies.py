"""Replies that noise has changed so that the checksum holds: never published, never planned from, never a fault."""

import asyncio
from dataclasses import replace

import pytest

from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import MoveRelative, Power
from ldcnd.contract.samples import AxisState, FaultSample, PositionSample, TelemetryItem
from ldcnd.drives.driver import AxisReading
from ldcnd.line.exchange import Timing
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import Chain, ChainSpec, ModuleSpec, build_chain
from tests.support.axis_bench import put
from tests.support.rig import SIMULATED, running_rig

FALSE_FROM_S = 5.0
SHARE = 0.05


def rig_config() -> RigConfig:
    return load_config(SIMULATED)


def chain(seed: int) -> Chain:
    models = ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")
    falsified = LineFault(FaultKind.REPLY_FALSIFIED, SHARE, from_s=FALSE_FROM_S)
    return build_chain(
        ChainSpec(tuple(ModuleSpec(model) for model in models), faults=FaultPlan((falsified,), seed), seed=seed)
    )


@pytest.mark.promise("reading-judged")
@pytest.mark.parametrize("seed", [1, 2, 4, 26])
@pytest.mark.sweep(4)
async def test_of_a_standing_rig_no_false_position_and_no_false_fault_is_published(seed: int):
    async with running_rig(rig_config(), {"line0": chain(seed)}) as rig:
        published: list[PositionSample] = []
        async with rig.client.samples("x", TelemetryItem.POSITION) as positions, asyncio.timeout(300):
            for axis in "xyzc":
                await rig.until(axis, lambda _: True)
                await rig.client.command(axis, Power(on=True))
            while len(published) < 600:
                _, sample = await anext(positions)
                assert isinstance(sample, PositionSample)
                published.append(sample)
        states = [await rig.client.state(axis) for axis in "xyzc"]
        withheld = sum(axis._plausibility.withheld for axis in rig.daemon.rig.axes.values())

    print(f"seed {seed}: {withheld} readings withheld")
    assert withheld > 10
    assert [sample for sample in published if abs(sample.value) > 0.02] == []
    assert [state.state for state in states if state] == [AxisState.STANDSTILL] * 4


@pytest.mark.promise("reading-judged")
@pytest.mark.long
async def test_relative_moves_go_as_far_as_they_are_told():
    async with running_rig(rig_config(), {"line0": chain(3)}) as rig:
        line = rig.daemon.rig.axes["x"]
        await rig.until("x", lambda _: True)
        await rig.client.command("x", Power(on=True))
        await asyncio.sleep(FALSE_FROM_S)
        came: list[float] = []
        for number in range(1, 16):
            put(line.tracker, target_counts=None)  # as after a stop: it plans from where the axis is
            await rig.client.command("x", MoveRelative(distance=1.0))
            await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
            await asyncio.sleep(0.5)
            last = await rig.client.last("x", TelemetryItem.POSITION)
            assert isinstance(last, PositionSample)
            came.append(last.value - number)

    assert [off for off in came if abs(off) > 0.1] == []


async def test_an_encoder_that_slips_on_a_standing_axis_is_a_fault_that_takes_the_reference():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.moving == "no")
        take = rig.daemon.rig.axes["x"].readings.judge

        def slipped(reading: AxisReading, asked: frozenset[TelemetryItem], timing: Timing) -> bool:
            """Stands in for the encoder: the simulated one cannot slip."""
            return take(replace(reading, position_counts=reading.position_counts + 100_000), asked, timing)

        rig.daemon.rig.buses[0]._pollers["x"]._deliver = slipped  # type: ignore[attr-defined]
        state = await rig.until("x", lambda state: state.state is AxisState.ERROR_STOP)
        fault = await rig.client.last("x", TelemetryItem.FAULT)

    assert not state.referenced
    assert isinstance(fault, FaultSample)
    assert [entry.code for entry in fault.active] == ["position_jump"]
