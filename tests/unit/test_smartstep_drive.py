"""One drive as the daemon sees it: what its words say together, and its monitors read once."""

from dataclasses import replace

import pytest

from ldcnd.contract.samples import MonitorName
from ldcnd.drives.smartstep.monitors import CounterValue
from ldcnd.drives.smartstep.poller import UnitWords
from ldcnd.drives.smartstep.profiles import SMARTSTEP
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.smartstep_line import simulated, smartstep_line

PRESENT_ALARM, INPUTS, OUTPUTS, SPEED = 0x850A, 0x8005, 0x8006, 0x8000


def words(alarm: int, outputs: int) -> UnitWords:
    return UnitWords({PRESENT_ALARM: alarm, INPUTS: 0x0010, OUTPUTS: outputs, SPEED: 0}, CounterValue(0))


@pytest.mark.parametrize("code", [0x0091, 0x0092])
async def test_a_warning_with_an_active_alarm_output_stops(code):
    async with smartstep_line([simulated(1)]) as line:
        axis = line.axis("u1")

        assert axis.interpret(words(code, outputs=0)).enabled
        assert not axis.interpret(words(code, outputs=1)).enabled
        assert axis.interpret(words(code, outputs=1)).faults[0].stops


async def test_any_monitor_is_read_once_the_auto_tuning_result_too():
    drive = simulated(1)
    drive.drive.set_run(0.0, on=True)
    async with smartstep_line([drive]) as line:
        access = line.axis("u1").parameters
        everything = {value.reading.monitor: value.reading for value in await access.monitors(())}
        one = await access.monitors((MonitorName.AUTO_TUNING_RESULT,))

    assert set(everything) == set(MonitorName)
    (read,) = (value.reading for value in one)
    assert (read.value, read.unit, read.title) == (100, "%", "Auto-tuning result")


async def test_a_signal_is_active_by_the_level_of_the_profile_and_not_by_being_high():
    drive = simulated(1)
    drive.drive.set_run(0.0, on=True)
    async with smartstep_line([drive]) as line:
        signals = await line.axis("u1").parameters.monitors((MonitorName.INPUT_SIGNALS, MonitorName.OUTPUT_SIGNALS))

    inputs, outputs = (value.reading for value in signals)
    assert (inputs.high, inputs.active) == (("RESET",), ("RUN",))
    assert (outputs.high, outputs.active) == (("INP", "BKIR"), ())


@pytest.mark.parametrize(
    ("active_low", "high", "active"),
    [
        (False, ("INP", "BKIR"), ("INP", "BKIR")),
        (True, (), ("INP", "BKIR")),
        (None, ("INP", "BKIR"), ()),  # no setting says it
    ],
)
async def test_outputs_are_active_by_the_levels_that_settings_give_them(active_low, high, active):
    levels = {"inp_active_low": active_low, "bkir_active_low": active_low}
    drive = simulated(1, SimulatedVariant(**{name: bool(low) for name, low in levels.items()}))
    drive.drive.set_run(0.0, on=True)
    async with smartstep_line([drive], profile=SMARTSTEP.with_unit(**levels)) as line:
        (outputs,) = await line.axis("u1").parameters.monitors((MonitorName.OUTPUT_SIGNALS,))

    assert (outputs.reading.high, outputs.reading.active) == (high, active)


async def test_a_position_that_was_corrected_is_uncertain():
    async with smartstep_line([simulated(1)]) as line:
        shown = line.axis("u1").interpret(replace(words(0x0099, 0), position=CounterValue(65_536, resolved=True)))

    assert (shown.position_counts, shown.position_uncertain) == (65_536, True)
