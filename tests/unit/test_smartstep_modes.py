import asyncio

import pytest

from ldcnd.drivers.smartstep.addresses import OperatingMode
from ldcnd.drivers.smartstep.commands import set_operating_mode
from ldcnd.errors import BusyTracing, OutcomeUnknown, ReplyTimeout, WrongState
from ldcnd.model.parameters import CounterName
from ldcnd.sim.faults import Fault, FaultKind, FaultPlan
from ldcnd.sim.smartstep.unit import SimulatedUnit
from ldcnd.sim.smartstep.variant import SimulatedVariant
from ldcnd.wirelog.recorder import WireEvent
from tests.support.smartstep_line import simulated, smartstep_line


def turned(variant: SimulatedVariant | None = None) -> SimulatedUnit:
    """A drive that has run and stands now, before the line opens at 0."""
    unit = simulated(1, variant)
    unit.drive.set_run(0.0, on=True)
    unit.drive.motor.command_units = 700.0
    unit.drive.motor.position = 2800.0
    return unit


@pytest.mark.parametrize("counter", list(CounterName))
async def test_a_clear_sets_one_counter_to_zero_and_leaves_the_other(counter):
    unit = turned()
    async with smartstep_line([unit]) as line:
        value = await line.axis("u1").parameters.clear_counter(counter)

    left = {CounterName.COMMAND: unit.drive.feedback_counter, CounterName.FEEDBACK: unit.drive.command_counter}[counter]
    assert value == 0
    assert left > 0
    assert unit.drive.mode is OperatingMode.NORMAL


async def test_a_turning_motor_keeps_its_counters():
    unit = turned()
    unit.drive.set_pulse_rate(500.0, 0.0)
    async with smartstep_line([unit]) as line:
        await asyncio.sleep(1.0)
        with pytest.raises(WrongState, match="r/min"):
            await line.axis("u1").parameters.clear_counter(CounterName.FEEDBACK)

    assert unit.drive.feedback_counter > 2800


async def test_a_tracing_drive_is_left_alone():
    async with smartstep_line([turned()]) as line:
        await line.bus.execute(set_operating_mode(1, OperatingMode.DATA_TRACE))

        with pytest.raises(BusyTracing):
            await line.axis("u1").parameters.clear_counter(CounterName.FEEDBACK)


async def test_a_clear_that_does_not_end_is_left_again():
    unit = turned(SimulatedVariant(clear_s=100.0))
    async with smartstep_line([unit]) as line:
        with pytest.raises(OutcomeUnknown, match="was not cleared"):
            await line.axis("u1").parameters.clear_counter(CounterName.FEEDBACK)

    assert unit.drive.mode is OperatingMode.NORMAL


@pytest.mark.parametrize("seed", range(12))
async def test_a_bad_line_leaves_no_mode_armed_and_executes_once_at_most(seed):
    unit = turned()
    faults = FaultPlan((Fault(FaultKind.REQUEST_LOST, 0.15), Fault(FaultKind.REPLY_LOST, 0.15)), seed=seed)
    async with smartstep_line([unit], faults=faults) as line:
        try:
            value = await line.axis("u1").parameters.clear_counter(CounterName.FEEDBACK)
        except (OutcomeUnknown, ReplyTimeout):
            value = None
        sent = [record.data for record in line.bus.wire_log.records() if record.event is WireEvent.SENT]

    assert value in (0, None)
    assert sum(data.startswith(b"W112001") for data in sent) <= 1
    assert unit.drive.mode is OperatingMode.NORMAL
