import random

import pytest

from ldcnd.drives.smartstep.addresses import OperatingMode
from ldcnd.drives.smartstep.monitors import (
    ALARMS,
    ELECTRICAL_ANGLE,
    GUARD_READS,
    HISTORY_LENGTH,
    NO_ALARM,
    POSITION_DEVIATION,
    AlarmHistory,
    AlarmKind,
    Counter,
    CounterReading,
    CounterValue,
    FunctionSwitch,
    InputSignal,
    OutputSignal,
    alarm,
    alarm_is_out,
    function_switches,
    gain_switch,
    input_levels,
    output_levels,
    reset_is_on,
    run_is_on,
    signed_word,
)
from ldcnd.drives.smartstep.profiles import SMARTSTEP, SmartStepProfile
from tests.support.smartstep_monitors import MONITORS


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


def test_healthy_drive_with_run_on_has_low_levels():
    profile = SmartStepProfile()

    assert run_is_on(profile, InputSignal.RESET)
    assert not run_is_on(profile, InputSignal.RUN)
    assert reset_is_on(profile, InputSignal.RUN)
    assert not alarm_is_out(profile, OutputSignal.INP)
    assert alarm_is_out(profile, OutputSignal.ALM)


def test_levels_can_be_turned_round_by_the_profile():
    profile = SMARTSTEP.with_unit(run_active_low=False, reset_active_low=False, alarm_output_high=False)

    assert run_is_on(profile, InputSignal.RUN)
    assert reset_is_on(profile, InputSignal.RESET)
    assert not alarm_is_out(profile, OutputSignal.ALM)


CODES = [0x04, 0x10, 0x30, 0x32, 0x40, 0x51, 0x70, 0x73, 0x74, 0x7A, 0xBF, 0xC1, 0xC2, 0xC3, 0xD0, 0x91, 0x92, 0x99]


def test_table_has_the_manuals_codes():
    assert [known.code for known in ALARMS] == CODES


@pytest.mark.parametrize("known", ALARMS, ids=lambda known: f"{known.code:04X}")
def test_listed_code_is_found(known):
    assert alarm(known.code) is known


def test_0099_means_that_there_is_no_alarm():
    assert alarm(NO_ALARM).kind is AlarmKind.NONE


def test_91_and_92_are_warnings():
    assert {known.code for known in ALARMS if known.kind is AlarmKind.WARNING} == {0x91, 0x92}


def test_unlisted_code_keeps_its_number():
    unknown = alarm(0x1234)

    assert (unknown.code, unknown.kind) == (0x1234, AlarmKind.UNKNOWN)
    assert "1234" in unknown.text


def read(
    counter: Counter, raw_at_read, last_at_rest: int | None = None, at_read_s=float
) -> tuple[CounterValue | None, int]:
    """Feed a reading from functions of the read's number to the raw value at that instant, and to the instant."""
    reading = CounterReading(counter, last_at_rest)
    reads = 0
    while reading.wanted:
        raw = raw_at_read(reads) & 0xFFFF_FFFF
        reading.take(raw >> 16 if reading.wanted is counter.high else raw & 0xFFFF, at_read_s(reads))
        reads += 1
    return reading.value, reads


def test_standing_counter_takes_three_reads():
    value, reads = read(Counter.COMMAND, lambda _: 0x1234_5678)

    assert value == CounterValue(0x1234_5678)
    assert reads == 3


def test_counter_moved_back_from_zero_is_negative():
    value, _ = read(Counter.FEEDBACK, lambda _: -500)

    assert value is not None
    assert (value.raw, value.signed) == (0xFFFF_FE0C, -500)
    assert not value.latched


@pytest.mark.parametrize("step", [30_000, -30_000, 8_000, -8_000, 100])
def test_moving_counter_is_read_at_some_instant_of_the_reading(step):
    rng = random.Random(1)
    for _ in range(300):
        start = rng.randrange(2**32)

        value, reads = read(Counter.COMMAND, lambda number, start=start: start + number * step)

        assert value is not None
        assert value.raw in {(start + number * step) & 0xFFFF_FFFF for number in range(reads)}


def test_trembling_on_a_boundary_is_never_off_by_65536():
    rng = random.Random(2)
    for _ in range(500):
        boundary = rng.randrange(1, 2**16) << 16

        value, _ = read(Counter.COMMAND, lambda number, at=boundary: at - (number % 2))

        assert value is not None
        assert value.raw in (boundary, boundary - 1)


def test_random_trembling_is_hardly_ever_off_by_65536():
    rng = random.Random(3)
    wrong = 0
    for _ in range(2000):
        value, _ = read(Counter.COMMAND, lambda _: 0x0005_0000 - rng.randrange(2))
        wrong += value is None or value.raw not in (0x0005_0000, 0x0004_FFFF)

    assert wrong <= 10


LATE_LOW_S = (0.0, 0.3, 0.345, 0.39, 0.435, 0.48)
"""Others have had the line before the low half; then nobody."""


@pytest.mark.parametrize(
    ("places", "value", "reads"),
    [
        # 34,464 is the low half of 100,000, and of a place 65536 before that
        ((60_000, 100_000, 106_000, 112_000, 118_000, 124_000), 118_000, 6),
        ((106_000, 66_000, 60_000, 54_000, 48_000, 42_000), 48_000, 6),
        # nothing is in doubt where both high halves agree, or near a boundary
        ((70_000, 110_000, 116_000), 110_000, 3),
        ((65_535, 65_536, 65_536), 65_536, 3),
        ((65_536, 65_535, 65_535), 65_535, 3),
    ],
)
def test_halves_of_a_moving_counter_with_a_pause_between_them_are_read_again(places, value, reads):
    found = read(Counter.FEEDBACK, places.__getitem__, at_read_s=LATE_LOW_S.__getitem__)

    assert found == (CounterValue(value), reads)


def test_counter_too_fast_to_tell_gives_no_value():
    value, reads = read(Counter.COMMAND, lambda number: number * 0x0002_0000)

    assert value is None
    assert reads == 15


def test_one_jump_between_halves_is_read_again():
    value, reads = read(Counter.COMMAND, lambda number: 0 if number < 2 else 0x0007_1234)

    assert value == CounterValue(0x0007_1234)
    assert reads == 6


def test_high_halves_meet_across_zero():
    value, _ = read(Counter.COMMAND, lambda number: -300 + 200 * number)

    assert value is not None
    assert value.signed == -100


def test_value_from_standstill_corrects_a_whole_65536():
    value, _ = read(Counter.COMMAND, lambda _: 0x0006_0001, last_at_rest=0x0005_0000)

    assert value == CounterValue(0x0005_0001, resolved=True)


def test_a_whole_65536_far_from_a_boundary_is_a_motion():
    value, _ = read(Counter.COMMAND, lambda _: 0x0006_4321, last_at_rest=0x0005_4321)

    assert value is not None
    assert value.raw == 0x0006_4321


def test_value_from_standstill_leaves_other_differences_alone():
    value, _ = read(Counter.COMMAND, lambda _: 0x0009_4321, last_at_rest=0x0005_0000)

    assert value == CounterValue(0x0009_4321, resolved=False)


def test_each_counter_is_cleared_by_its_own_mode():
    assert Counter.COMMAND.clear_mode is OperatingMode.COMMAND_COUNTER_CLEAR
    assert Counter.FEEDBACK.clear_mode is OperatingMode.FEEDBACK_COUNTER_CLEAR


def test_words_after_the_end_are_ignored():
    reading = CounterReading(Counter.COMMAND)
    for at_s, word in enumerate((1, 0x8000, 1)):
        reading.take(word, at_s)

    reading.take(99, 3)

    assert reading.value == CounterValue(0x0001_8000)


def test_counter_that_stands_near_a_boundary_is_read_in_three_words_once_it_is_known():
    _, at_first = read(Counter.FEEDBACK, lambda _: 0)
    value, afterwards = read(Counter.FEEDBACK, lambda _: 0, last_at_rest=0)

    assert value == CounterValue(0)
    assert (at_first, afterwards) == (3 + GUARD_READS, 3)


def test_counter_that_has_come_near_a_boundary_is_still_suspect():
    _, reads = read(Counter.FEEDBACK, lambda _: 0x0005_0000, last_at_rest=0x0004_8000)

    assert reads == 3 + GUARD_READS


def test_trembling_where_it_stood_is_never_off_by_65536():
    rng = random.Random(4)
    uncertain = 0
    for _ in range(2000):
        value, _ = read(Counter.FEEDBACK, lambda _: 0x0005_0000 - rng.randrange(2), last_at_rest=0x0005_0000)

        assert value is not None
        assert value.raw in (0x0005_0000, 0x0004_FFFF)
        uncertain += value.resolved

    assert uncertain <= 10


NONE = NO_ALARM


def history(*codes: int) -> tuple[int, ...]:
    return (*codes, *[NONE] * (HISTORY_LENGTH - len(codes)))


@pytest.mark.parametrize(
    ("before", "now", "added"),
    [
        (history(), history(), ()),
        (history(), history(0x10), (0x10,)),
        (history(0x10), history(0x70, 0x51, 0x10), (0x51, 0x70)),
        (history(0x10, 0x51), history(0x10, 0x10, 0x51), (0x10,)),
        (tuple(range(1, 11)), (0x70, *range(1, 10)), (0x70,)),
        (tuple(range(1, 11)), (*range(2, 11), 0x70), (0x70,)),
    ],
    ids=["as before", "first", "two, oldest first", "the same again", "full", "newest last"],
)
def test_what_the_alarm_history_has_gained_is_told_oldest_first(before, now, added):
    grown = AlarmHistory()

    assert grown.take(before) == ()
    assert grown.take(now) == added
    assert grown.take(now) == ()


def test_a_history_that_was_torn_by_an_alarm_is_read_again():
    before = tuple(range(1, 11))
    torn, whole = (*before[:4], *before[3:9]), (0x70, *before[:9])
    grown = AlarmHistory()
    grown.take(before)

    assert grown.take(torn) is None
    assert grown.take(whole) == (0x70,)


def test_the_history_of_another_drive_is_no_news():
    other = tuple(range(0x31, 0x3B))
    grown = AlarmHistory()
    grown.take(tuple(range(1, 11)))

    assert grown.take(other) is None
    assert grown.take(other) == ()
    assert grown.take((0x70, *other[:9])) == (0x70,)
