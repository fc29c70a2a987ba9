import pytest

from ldcnd.drivers.smartstep.profiles import SMARTSTEP, SmartStepProfile, TriggerMap, TriggerWordSource
from ldcnd.drivers.smartstep.trace_setup import (
    DataObject,
    Edge,
    IoObject,
    TriggerObject,
    TriggerWord,
    duration_s,
    no_trigger,
    object_word,
    period_s,
    raw_trigger_word,
    sampling_interval,
    trigger_word,
)
from ldcnd.errors import NotSupported, ValueOutOfRange

MAP = TriggerMap(trace1=0x10, trace2=0x20, io=0x40, rising=0x01, falling=0x02)
MAPPED = SmartStepProfile(trigger_word=TriggerWordSource.CONFIGURED, trigger_map=MAP)


def test_object_word_has_io_left_and_data_right():
    assert object_word(DataObject.SPEED_FEEDBACK, IoObject.INP) == 0x8101
    assert object_word(DataObject.POSITION_DEVIATION, IoObject.ALM) == 0x8004


def test_codes_are_those_of_the_manual():
    assert [code.value for code in DataObject] == [0x00, 0x01, 0x03, 0x04]
    assert [code.value for code in IoObject] == [0x00, 0x06, 0x80, 0x81, 0x87]


@pytest.mark.parametrize(
    ("wanted_s", "smptms"), [(0.0005, 2), (0.002, 8), (0.0020001, 8), (0.000376, 2), (65535 * 250e-6, 65535)]
)
def test_interval_is_the_nearest_number_of_time_units(wanted_s, smptms):
    assert sampling_interval(wanted_s, 250) == smptms


@pytest.mark.parametrize("wanted_s", [0.0, 0.00025, 0.00037, 16.4, 1e9, -1.0])
def test_interval_that_the_drive_would_not_refuse_is_refused_here(wanted_s):
    with pytest.raises(ValueOutOfRange) as refused:
        sampling_interval(wanted_s, 250)

    assert refused.value.nearest is not None
    assert sampling_interval(refused.value.nearest, 250) in (2, 65535)


def test_impossible_time_unit_is_refused():
    with pytest.raises(ValueOutOfRange):
        sampling_interval(0.002, 0)


def test_trace_lasts_500_points():
    assert period_s(8, 250) == pytest.approx(0.002)
    assert duration_s(8, 250) == pytest.approx(1.0)


def test_no_trigger_is_zero():
    assert no_trigger() == TriggerWord(0, TriggerWordSource.NONE)


@pytest.mark.parametrize(
    ("watched", "edge", "word"),
    [
        (TriggerObject.TRACE_1, Edge.RISING, 0x11),
        (TriggerObject.TRACE_2, Edge.FALLING, 0x22),
        (TriggerObject.IO, Edge.BOTH, 0x43),
    ],
)
def test_trigger_word_comes_from_the_configured_map(watched, edge, word):
    assert trigger_word(MAPPED, watched, edge) == TriggerWord(word, TriggerWordSource.CONFIGURED)


def test_without_a_map_there_is_no_trigger():
    with pytest.raises(NotSupported):
        trigger_word(SMARTSTEP, TriggerObject.IO, Edge.RISING)


def test_raw_trigger_word_needs_the_profiles_leave():
    profile = SmartStepProfile(trigger_word=TriggerWordSource.RAW)

    assert raw_trigger_word(profile, 0x0102).source is TriggerWordSource.RAW
    with pytest.raises(NotSupported):
        raw_trigger_word(SMARTSTEP, 0x0102)
    with pytest.raises(ValueOutOfRange):
        raw_trigger_word(profile, 0x10000)
