import pytest

from ldcnd.drivers.smartstep.profiles import SMARTSTEP, CommandPulseGear, SmartStepProfile
from ldcnd.drivers.smartstep.trace_scaling import TraceConstants, scale, trigger_level, unit_of
from ldcnd.drivers.smartstep.trace_setup import DataObject
from ldcnd.errors import BadReply, ValueOutOfRange

CONSTANTS = TraceConstants(cyclec_us=250, maxtrqc=300, osvelcc=4500, gear_numerator=4, gear_denominator=1)


@pytest.mark.parametrize(
    ("data", "full", "unit"),
    [
        (DataObject.TORQUE_REFERENCE, 300, "%"),
        (DataObject.SPEED_FEEDBACK, 4500, "r/min"),
        (DataObject.POSITION_DEVIATION, 15000, "command units"),
    ],
)
def test_data_15000_is_full_scale(data, full, unit):
    assert 15_000 * scale(SMARTSTEP, CONSTANTS, data) == pytest.approx(full)
    assert unit_of(data) == unit


@pytest.mark.parametrize(
    ("gear", "rpm"), [(CommandPulseGear.NUM_DEN, 3000), (CommandPulseGear.DEN_NUM, 187.5), (CommandPulseGear.NONE, 750)]
)
def test_50_pulses_in_two_time_units_by_each_reading_of_the_gear(gear, rpm):
    profile = SmartStepProfile(command_pulse_gear=gear)

    assert 50 * scale(profile, CONSTANTS, DataObject.COMMAND_PULSE_SPEED) == pytest.approx(rpm)


@pytest.mark.parametrize("gear", CommandPulseGear)
def test_all_readings_agree_at_gear_one(gear):
    profile = SmartStepProfile(command_pulse_gear=gear)

    assert scale(profile, TraceConstants(250, 300, 4500), DataObject.COMMAND_PULSE_SPEED) == pytest.approx(15.0)


@pytest.mark.parametrize(
    ("data", "level", "word"),
    [
        (DataObject.TORQUE_REFERENCE, 100.0, 5000),
        (DataObject.SPEED_FEEDBACK, -1500.0, 0x10000 - 5000),
        (DataObject.POSITION_DEVIATION, -1.0, 0xFFFF),
        (DataObject.COMMAND_PULSE_SPEED, 3000.0, 50),
    ],
)
def test_trigger_level_is_the_inverse_of_the_scale(data, level, word):
    assert trigger_level(SMARTSTEP, CONSTANTS, data, level) == word


def test_trigger_level_must_fit_16_bits():
    with pytest.raises(ValueOutOfRange):
        trigger_level(SMARTSTEP, CONSTANTS, DataObject.POSITION_DEVIATION, 32768.0)


def test_constants_of_zero_are_a_bad_reply():
    with pytest.raises(BadReply):
        TraceConstants(250, 0, 4500)
