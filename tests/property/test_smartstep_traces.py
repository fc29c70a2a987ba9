"""Traces of drives that behave in every way the manual leaves open: what is published as good is right."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ldcnd.contract.errors import BadReply, ReplyTimeout
from ldcnd.contract.traces import TakeTrace
from ldcnd.drives.smartstep.parameters import PN202, PN203
from ldcnd.drives.smartstep.profiles import (
    ByteOrder,
    CommandPulseGear,
    CountUnit,
    SmartStepProfile,
    StringChecksum,
    TraceWordLayout,
)
from ldcnd.drives.smartstep.trace_check import Reading, Samples, Shown, comparisons, judge
from ldcnd.drives.smartstep.trace_data import (
    DataObject,
    IoObject,
    TraceConstants,
    TracePoint,
    decode_word,
    encode_word,
    scale,
)
from ldcnd.drives.smartstep.trace_result import DATA, SIGNALS, assign
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.smartstep_line import simulated, smartstep_line

LAYOUTS = [TraceWordLayout.MSB_IO, TraceWordLayout.LSB_IO_SHIFT, TraceWordLayout.LSB_IO_MASK]
CHECKSUMS = [StringChecksum.HEADER, StringChecksum.ALL, StringChecksum.TRAILER]


def swapped(word: int) -> int:
    return (word >> 8 | word << 8) & 0xFFFF


TRACES = st.lists(
    st.fixed_dictionaries(
        {
            "channel": st.sampled_from(list(DATA)),
            "signal": st.sampled_from(list(SIGNALS)),
            "level": st.booleans(),
            "start": st.integers(-6000, 6000),
            "step": st.integers(-20, 20),
            "shown_at": st.lists(st.integers(10, 480), max_size=6),
        }
    ),
    min_size=1,
    max_size=3,
)
DRIVES = {
    "layout": st.sampled_from(LAYOUTS),
    "order": st.sampled_from(list(ByteOrder)),
    "gear": st.sampled_from(list(CommandPulseGear)),
    "numerator": st.integers(1, 8),
    "traces": TRACES,
}


@given(**DRIVES)
@settings(max_examples=60, deadline=None)
def test_what_a_trace_publishes_as_good_is_right(**case):
    good_is_right(**case)


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("order", list(ByteOrder))
@pytest.mark.parametrize("layout", LAYOUTS)
@given(**{name: drawn for name, drawn in DRIVES.items() if name not in {"layout", "order"}})
@settings(max_examples=1_700, deadline=None)
def test_what_ten_thousand_drives_publish_as_good_is_right(layout, order, **case):
    good_is_right(layout, order, **case)


def good_is_right(layout, order, gear, numerator, traces):
    """Judge traces of one drive, each knowing those before it, and hold what is good against the truth."""
    constants = TraceConstants(250, 300, 4500, numerator, 1)
    assumed = SmartStepProfile()
    drive = SmartStepProfile(trace_word_layout=layout, trace_byte_order=order, command_pulse_gear=gear)
    possible = None
    for each in traces:
        channel, signal, level = each["channel"], each["signal"], each["level"]
        assignment = assign("u1", (channel, signal))
        kept = ~1 if layout is TraceWordLayout.LSB_IO_MASK else ~0
        counts = [max(-12_000, min(12_000, each["start"] + each["step"] * place)) & kept for place in range(500)]
        words = [encode_word(TracePoint(count, level), layout) for count in counts]
        split = tuple(word if order is assumed.trace_byte_order else swapped(word) for word in words)
        truth = scale(drive, constants, DATA[channel])
        value, bit = comparisons(assignment)
        shown = []
        for place in each["shown_at"]:
            at_s = place * 0.004
            shown.append(Shown(value, float(round(counts[place] * truth)), at_s - 0.02, at_s + 0.02))
            shown.append(Shown(bit, float(level), at_s - 0.02, at_s + 0.02))

        judgement = judge(assumed, constants, assignment, Samples((split,), 0.004, 0.0, 0.004), shown, possible)

        possible = judgement.possible
        assert possible is None or Reading(layout, order, gear, 8000) in possible
        if not judgement.problems:
            published = [scale(assumed, constants, DATA[channel]) * read for read in decoded(assumed, split)]
            assert published == pytest.approx([count * truth for count in counts])
            assert {bool(point) for point in bits(assumed, split)} == {level}


def decoded(profile: SmartStepProfile, words: tuple[int, ...]) -> list[int]:
    return [decode_word(word, profile.trace_word_layout).value for word in words]


def bits(profile: SmartStepProfile, words: tuple[int, ...]) -> list[bool | None]:
    return [decode_word(word, profile.trace_word_layout).io for word in words]


LINES = {
    "layout": st.sampled_from(LAYOUTS),
    "order": st.sampled_from(list(ByteOrder)),
    "checksum": st.sampled_from(CHECKSUMS),
    "count_unit": st.sampled_from(list(CountUnit)),
    "longest": st.sampled_from([1000, 200, 64]),
    "gear": st.sampled_from(list(CommandPulseGear)),
    "pulses": st.integers(-6000, 6000),
    "run": st.booleans(),
    "channels": st.sampled_from(
        [("speed_feedback", "bkir"), ("command_pulse_speed",), ("torque_reference", "position_deviation", "run")]
    ),
}


@given(**LINES)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
async def test_a_trace_over_the_line_is_right_or_marked(**case):
    await right_or_marked(**case)


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("layout", LAYOUTS)
@given(**{name: drawn for name, drawn in LINES.items() if name != "layout"})
@settings(max_examples=340, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
async def test_a_thousand_traces_over_the_line_are_right_or_marked(layout, **case):
    await right_or_marked(layout, **case)


async def right_or_marked(layout, order, checksum, count_unit, longest, gear, pulses, run, channels):  # noqa: PLR0917
    """Take one trace of a drive that behaves so, and hold what is good against what it has recorded."""
    variant = SimulatedVariant(
        trace_word_layout=layout,
        trace_byte_order=order,
        string_checksum=checksum,
        string_count_unit=count_unit,
        longest_string_bytes=longest,
        command_pulse_gear=gear,
    )
    unit = simulated(1, variant, {PN202: 4, PN203: 1})
    unit.drive.set_run(0.0, on=run)
    unit.drive.set_pulse_rate(float(pulses), 0.0)
    recorded_points: list[TracePoint] = []
    sample = unit.drive._trace_point

    def witness(data: DataObject, io: IoObject) -> TracePoint:
        point = sample(data, io)
        recorded_points.append(point)
        return point

    unit.drive._trace_point = witness
    async with smartstep_line([unit], profile=SmartStepProfile(trace_chunk_bytes=1000)) as line:
        armed = await line.axis("u1").tracer.arm(TakeTrace(channels=channels, interval_s=0.004))
        try:
            result = await armed.record(lambda _phase, _uploaded: None)
        except BadReply:
            return
        except ReplyTimeout:  # strings of another length than expected: only where the drive counts words
            assert count_unit is CountUnit.WORDS
            return

    if result.problems:
        return
    truth = SmartStepProfile(trace_word_layout=layout, command_pulse_gear=gear)
    constants = TraceConstants(250, 300, 4500, 4, 1)
    for column, name in zip(result.values, channels, strict=True):
        memory = assign("u1", channels).memory(name)
        points = recorded_points[memory::2]
        if name in DATA:
            kept = ~1 if layout is TraceWordLayout.LSB_IO_MASK else ~0
            factor = scale(truth, constants, DATA[name])
            assert all(
                abs(value - (point.value & kept) * factor) <= 1e-6 for value, point in zip(column, points, strict=True)
            )
        else:
            assert list(column) == [float(point.io) for point in points]
