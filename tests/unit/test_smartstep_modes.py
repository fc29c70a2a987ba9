import asyncio

import pytest

from ldcnd.contract.errors import BusyTracing, OutcomeUnknown, ReplyTimeout, WrongState
from ldcnd.contract.parameters import CounterName
from ldcnd.drives.smartstep.addresses import OperatingMode
from ldcnd.drives.smartstep.commands import set_operating_mode
from ldcnd.drives.smartstep.packet import ResponseStatus
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.smartstep.unit import SimulatedUnit
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.smartstep_line import executes_in_a_fresh_mode_only, losing_once, simulated, smartstep_line


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
    assert value.value == 0
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


@pytest.mark.parametrize("lost", ["request", "reply"])
async def test_a_clear_whose_execute_got_lost_is_carried_out_within_seconds(lost):
    unit = losing_once(1, b"W112001", lost)
    unit.drive.motor.position = 2800.0
    async with smartstep_line([unit]) as line:
        async with asyncio.timeout(5.0):
            value = await line.axis("u1").parameters.clear_counter(CounterName.FEEDBACK)

    assert value.value == 0
    assert unit.drive.mode is OperatingMode.NORMAL


async def test_a_clear_mode_that_a_dead_host_left_behind_is_left_first():
    unit = turned()
    unit.drive.mode = OperatingMode.COMMAND_COUNTER_CLEAR
    async with smartstep_line([unit]) as line:
        value = await line.axis("u1").parameters.clear_counter(CounterName.FEEDBACK)

    assert value.value == 0
    assert unit.drive.command_counter == 700
    assert unit.drive.mode is OperatingMode.NORMAL


@pytest.mark.parametrize("mode", [OperatingMode.DATA_TRACE, OperatingMode.FEEDBACK_COUNTER_CLEAR])
async def test_a_mode_that_was_left_behind_ends_on_demand(mode):
    unit = turned()
    unit.drive.mode = mode
    async with smartstep_line([unit]) as line:
        ended = await line.axis("u1").tracer.disarm()
        again = await line.axis("u1").tracer.disarm()

    assert (ended, again) == (True, False)
    assert unit.drive.mode is OperatingMode.NORMAL
    assert unit.drive.feedback_counter == 2800


@pytest.mark.parametrize("mode", [OperatingMode.DATA_TRACE, OperatingMode.COMMAND_COUNTER_CLEAR])
async def test_a_mode_that_was_left_behind_ends_at_bring_up(mode):
    unit = turned()
    unit.drive.mode = mode
    async with smartstep_line([unit]) as line:
        report = await line.network.bring_up()

    assert unit.drive.mode is OperatingMode.NORMAL
    assert unit.drive.command_counter == 700
    assert any(f"{mode:04X}H" in remark for remark in report.remarks)


@pytest.mark.parametrize("counter", list(CounterName))
async def test_no_counter_is_cleared_while_command_pulses_come_in_although_run_is_off(counter):
    unit = simulated(1)
    unit.drive.set_pulse_rate(5000.0, 0.0)
    async with smartstep_line([unit]) as line:
        with pytest.raises(WrongState, match="command pulses"):
            await line.axis("u1").parameters.clear_counter(counter)


async def test_a_counter_that_is_not_zero_after_its_clear_is_remarked_upon():
    unit = turned()
    async with smartstep_line([unit]) as line:
        clear = unit.drive._execute

        def pulses_begin(value: int) -> ResponseStatus:
            status = clear(value)
            unit.drive.motor.pulse_rate = 2000.0
            return status

        unit.drive._execute = pulses_begin
        cleared = await line.axis("u1").parameters.clear_counter(CounterName.COMMAND)

    assert cleared.value > 0
    assert "came in" in cleared.remarks[0]


@pytest.mark.parametrize("seed", range(12))
async def test_a_bad_line_leaves_no_mode_armed_and_executes_in_a_fresh_mode_only(seed):
    unit = turned()
    faults = FaultPlan((LineFault(FaultKind.REQUEST_LOST, 0.15), LineFault(FaultKind.REPLY_LOST, 0.15)), seed=seed)
    async with smartstep_line([unit], faults=faults) as line:
        try:
            value = await line.axis("u1").parameters.clear_counter(CounterName.FEEDBACK)
        except (OutcomeUnknown, ReplyTimeout):
            value = None
        sent = [record.data for record in line.bus.wire_log.records() if record.event is WireEvent.SENT]

    assert value is None or value.value == 0
    assert executes_in_a_fresh_mode_only(sent)
    assert unit.drive.mode is OperatingMode.NORMAL
