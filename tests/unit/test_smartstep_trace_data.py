import pytest

from ldcnd.contract.errors import BadReply, ValueOutOfRange
from ldcnd.drives.smartstep.profiles import (
    SMARTSTEP,
    ByteOrder,
    CommandPulseGear,
    TraceWordLayout,
)
from ldcnd.drives.smartstep.trace_data import (
    POINTS,
    Chunk,
    DataObject,
    IoObject,
    TraceConstants,
    TracePoint,
    chunk_plan,
    decode_word,
    encode_word,
    first_point,
    is_beyond_full_scale,
    join_words,
    object_word,
    period_s,
    require_pre_trigger,
    sampling_interval,
    scale,
    split_words,
    trigger_level,
    unit_of,
    unwrap,
)

MSB, SHIFT, MASK, RAW = TraceWordLayout


@pytest.mark.parametrize(
    ("layout", "word", "value", "io"),
    [
        (MSB, 0x0000, 0, False),
        (MSB, 0x8001, 1, True),
        (MSB, 0x7FFF, -1, False),
        (MSB, 0xFFFF, -1, True),
        (MSB, 0x3A98, 15000, False),
        (MSB, 0xBA98, 15000, True),
        (MSB, 0x4568, -15000, False),
        (MSB, 0xC568, -15000, True),
        (SHIFT, 0x0000, 0, False),
        (SHIFT, 0x8001, -16384, True),
        (SHIFT, 0x7FFF, 16383, True),
        (SHIFT, 0xFFFF, -1, True),
        (MASK, 0x0000, 0, False),
        (MASK, 0x8001, -32768, True),
        (MASK, 0x7FFF, 32766, True),
        (MASK, 0xFFFF, -2, True),
        (RAW, 0x8001, 0x8001, None),
    ],
)
def test_word_in_each_layout(layout, word, value, io):
    assert decode_word(word, layout) == TracePoint(value, io)
    assert encode_word(TracePoint(value, io), layout) == word


def test_byte_order_says_which_half_comes_first():
    assert split_words(b"\x80\x01\x7f\xff", ByteOrder.BIG) == (0x8001, 0x7FFF)
    assert split_words(b"\x80\x01\x7f\xff", ByteOrder.LITTLE) == (0x0180, 0xFF7F)
    assert join_words((0x8001,), ByteOrder.LITTLE) == b"\x01\x80"


def test_half_a_word_is_bad():
    with pytest.raises(BadReply):
        split_words(b"\x00\x01\x02", ByteOrder.BIG)


def test_value_beyond_full_scale_makes_the_layout_uncertain():
    assert not is_beyond_full_scale([TracePoint(15_000, None), TracePoint(-15_000, None)])
    assert is_beyond_full_scale([TracePoint(-15_001, None)])


def test_default_chunks_fetch_a_trace_in_five():
    plan = chunk_plan(1, 200)

    assert [chunk.address for chunk in plan] == [0x3000, 0x30C8, 0x3190, 0x3258, 0x3320]
    assert {chunk.byte_count for chunk in plan} == {200}
    assert chunk_plan(2, 200)[0].address == 0x3800


def test_last_chunk_may_be_shorter():
    plan = chunk_plan(1, 300)

    assert plan[-1] == Chunk(0x3384, 100)
    assert sum(chunk.byte_count for chunk in plan) == 1000


@pytest.mark.parametrize(("trace", "chunk_bytes"), [(0, 200), (3, 200), (1, 0), (1, 201), (1, 1002)])
def test_impossible_plans_are_refused(trace, chunk_bytes):
    with pytest.raises(ValueOutOfRange):
        chunk_plan(trace, chunk_bytes)


def test_refused_chunk_is_halved_down_to_one_word():
    assert Chunk(0x3000, 6).halves() == (Chunk(0x3000, 2), Chunk(0x3002, 4))
    assert Chunk(0x3000, 2).halves() is None


@pytest.mark.parametrize(
    ("trigger_address", "pre_trigger", "first"), [(20, 100, 420), (100, 100, 0), (0, 0, 0), (7, 0, 7), (0, 499, 1)]
)
def test_ring_begins_at_the_oldest_pre_trigger_point(trigger_address, pre_trigger, first):
    assert first_point(trigger_address, pre_trigger) == first


def test_trigger_sits_after_its_pre_trigger_points():
    ring = list(range(500))

    points = unwrap(ring, first_point(20, 100))

    assert points[100] == 20
    assert (points[0], points[99], points[499]) == (420, 19, 419)


def test_trigger_address_beyond_the_ring_is_a_bad_reply():
    with pytest.raises(BadReply):
        first_point(500, 0)


@pytest.mark.parametrize("points", [-1, 500])
def test_pre_trigger_must_leave_room_for_the_trigger(points):
    with pytest.raises(ValueOutOfRange):
        require_pre_trigger(points)


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
    assert POINTS * period_s(8, 250) == pytest.approx(1.0)


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
    profile = SMARTSTEP.with_trace(command_pulse_gear=gear)

    assert 50 * scale(profile, CONSTANTS, DataObject.COMMAND_PULSE_SPEED) == pytest.approx(rpm)


@pytest.mark.parametrize("gear", CommandPulseGear)
def test_all_readings_agree_at_gear_one(gear):
    profile = SMARTSTEP.with_trace(command_pulse_gear=gear)

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
