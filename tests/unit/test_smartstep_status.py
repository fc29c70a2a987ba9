import pytest

from ldcnd.drivers.smartstep.profiles import SmartStepProfile
from ldcnd.drivers.smartstep.status import (
    ELECTRICAL_ANGLE,
    MONITORS,
    POSITION_DEVIATION,
    DriverType,
    FunctionSwitch,
    InputSignal,
    OutputSignal,
    alarm_is_out,
    driver_type,
    function_switches,
    gain_switch,
    input_levels,
    output_levels,
    reset_is_on,
    run_is_on,
    signed_word,
)


def test_monitors_fill_8000h_to_800fh():
    assert [monitor.address for monitor in MONITORS] == list(range(0x8000, 0x8010))


def test_signed_monitors_are_those_of_the_manual():
    signed = [monitor.label for monitor in MONITORS if monitor.signed]

    assert signed == ["Un000", "Un001", "Un002", "Un007", "Un008"]


@pytest.mark.parametrize(("word", "value"), [(0, 0), (0x7FFF, 32767), (0x8000, -32768), (0xFFFF, -1)])
def test_signed_words_are_twos_complement(word, value):
    assert signed_word(word) == value
    assert POSITION_DEVIATION.value_of(word) == value
    assert ELECTRICAL_ANGLE.value_of(word) == word


def test_unused_signal_bits_are_dropped():
    assert input_levels(0xFFFF) == InputSignal.RUN | InputSignal.RESET == 0x0011
    assert output_levels(0xFFFF) == OutputSignal.ALM | OutputSignal.INP | OutputSignal.BKIR == 0x0043
    assert function_switches(0xFFFF) == 0x3F
    assert gain_switch(0xFFFA) == 0xA


def test_switch_6_is_bit_5():
    assert function_switches(0x20) is FunctionSwitch.PARAMETERS_RULE


def test_both_printed_types_are_one_word():
    assert driver_type(0x000C) is DriverType.R7D_AP
    assert driver_type(0x0001) == 1


def test_healthy_drive_with_run_on_has_low_levels():
    profile = SmartStepProfile()

    assert run_is_on(profile, InputSignal.RESET)
    assert not run_is_on(profile, InputSignal.RUN)
    assert reset_is_on(profile, InputSignal.RUN)
    assert not alarm_is_out(profile, OutputSignal.INP)
    assert alarm_is_out(profile, OutputSignal.ALM)


def test_levels_can_be_turned_round_by_the_profile():
    profile = SmartStepProfile(run_active_low=False, reset_active_low=False, alarm_output_high=False)

    assert run_is_on(profile, InputSignal.RUN)
    assert reset_is_on(profile, InputSignal.RESET)
    assert not alarm_is_out(profile, OutputSignal.ALM)
