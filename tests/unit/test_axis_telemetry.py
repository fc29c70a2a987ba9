"""What is published of one axis, when, and what it is worth."""

from dataclasses import replace

import pytest

from ldcnd.axis.events import StopLatch
from ldcnd.contract.commands import MoveAbsolute
from ldcnd.contract.parameters import MonitorReading
from ldcnd.contract.samples import AxisState, MonitorName, Quality, TelemetryItem
from ldcnd.contract.traces import TraceChunk
from ldcnd.drives.driver import Fault, PartialReading
from ldcnd.drives.parameter_access import MonitorValue
from ldcnd.line.exchange import Timing
from tests.support.axis_bench import KEYS, RUNNING, AxisBench, axis_bench, put

POSITION, VELOCITY, ADC = TelemetryItem.POSITION, TelemetryItem.VELOCITY, TelemetryItem.ADC
STATE, FAULT = TelemetryItem.STATE, TelemetryItem.FAULT
TIMING = Timing(1.0, 1.0, 1.002, 1.003)
CHUNK = TraceChunk(
    t=0, t_error_ns=0, seq=0, quality=Quality.GOOD, trace_id="t", index=0, first=0, offsets_ns=(), values=(), raw=()
)


def poll(bench: AxisBench, *asked: TelemetryItem, **changes: object) -> None:
    bench.axis.readings.accept(replace(bench.drive.shown, **changes), frozenset(asked), TIMING)


@pytest.mark.parametrize("item", [POSITION, VELOCITY, ADC])
async def test_only_what_was_asked_for_is_published(item):
    async with axis_bench() as bench:
        poll(bench, item, adc_counts=512)

        published = [each for each in (POSITION, VELOCITY, ADC) if bench.published(each)]

    assert published == [item]


async def test_values_are_in_axis_units_and_stamped_with_the_middle_of_when_they_can_have_been_true():
    async with axis_bench(adc_volts=10.0, direction="reverse") as bench:
        put(bench.tracker, scale=replace(bench.tracker.status.scale, origin_counts=1000.0))
        poll(
            bench, POSITION, VELOCITY, ADC, position_counts=3000, velocity_counts_per_s=500.0, adc_counts=512,
            following_error_counts=20,
        )  # fmt: skip
        position, velocity, adc = (bench.published(item) for item in (POSITION, VELOCITY, ADC))

    assert (position.value, position.unit, position.counts, position.following_error) == (-2.0, "mm", 3000, -0.02)
    assert (velocity.value, velocity.unit, velocity.counts_per_s) == (-0.5, "mm/s", 500.0)
    assert (adc.counts, adc.full_scale, adc.volts) == (512, 1023, pytest.approx(512 / 1023 * 10.0))
    assert (position.t, position.t_error_ns) == (pytest.approx(1.001e9, abs=10), 1_000_000)


async def test_a_value_that_the_reading_does_not_have_is_not_published():
    async with axis_bench() as bench:
        poll(bench, POSITION, ADC)

        assert bench.published(ADC) is None
        assert bench.published(POSITION).following_error is None


async def test_state_and_faults_are_published_when_they_change_and_when_they_are_due():
    async with axis_bench() as bench:
        poll(bench)
        state, fault = bench.published(STATE), bench.published(FAULT)
        poll(bench)
        assert (bench.published(STATE), bench.published(FAULT)) == (state, fault)
        poll(bench, STATE)
        assert (bench.published(STATE).seq, bench.published(FAULT).seq) == (state.seq + 1, fault.seq + 1)
        poll(bench, faults=(Fault("position_wrap", "wrapped", stops=False),))
        assert bench.published(STATE).seq == state.seq + 1
        assert [entry.code for entry in bench.published(FAULT).active] == ["position_wrap"]
        bench.tracker.take(StopLatch())
        poll(bench, faults=(Fault("position_wrap", "wrapped", stops=False),))
        assert bench.published(STATE).stop_latched


async def test_a_state_names_the_command_with_its_target_and_its_expected_end():
    async with axis_bench() as bench:
        reply = await bench.send(MoveAbsolute(position=10.0), "move")
        await bench.pass_s(0.1, **RUNNING)
        command = bench.published(STATE).command

    assert (command.command_id, command.verb, command.target) == ("move", "move_absolute", 10.0)
    assert command.expected_end == command.since + round(reply.duration_s * 1e9)


SLIPS = Fault("encoder_slips", "it slips", stops=False, loses_position=True)


@pytest.mark.parametrize(("turn", "first"), [("began", STATE), ("lost", STATE), ("silent", STATE), ("found", POSITION)])
async def test_no_number_is_shown_beside_a_state_that_makes_another_place_of_it(turn, first):
    async with axis_bench(powered=turn != "began") as bench:
        put(bench.tracker, referenced=turn in {"lost", "silent"})
        if turn != "began":
            poll(bench, POSITION, STATE)
            bench.heard.clear()
        match turn:
            case "began":  # many have a state of an earlier run
                poll(bench, POSITION, STATE)
            case "lost":
                poll(bench, POSITION, STATE, faults=(SLIPS,))
            case "silent":
                bench.axis.disconnected()
            case "found":
                put(bench.tracker, referenced=True)
                poll(bench, POSITION, STATE)

    assert next(item for item in bench.heard if item in (POSITION, STATE)) == first
    assert {POSITION, STATE} <= {*bench.heard}
    assert turn == "silent" or bench.heard.count(STATE) == 1


async def test_what_a_drive_that_is_gone_has_shown_is_published_once_more_as_bad():
    async with axis_bench() as bench:
        poll(bench, POSITION, VELOCITY, ADC, position_counts=5, adc_counts=7)
        before = [bench.published(item) for item in (POSITION, VELOCITY, ADC)]
        bench.axis.readings.miss(None)
        assert [bench.published(item).quality for item in (POSITION, VELOCITY, ADC)] == [Quality.UNCERTAIN] * 3
        bench.axis.disconnected()
        after = [bench.published(item) for item in (POSITION, VELOCITY, ADC)]
        bench.axis.disconnected()
        again = [bench.published(item) for item in (POSITION, VELOCITY, ADC)]
        state = bench.published(STATE)

    assert [sample.quality for sample in before] == [Quality.GOOD] * 3
    assert [sample.quality for sample in after] == [Quality.BAD] * 3
    assert [sample.t for sample in after] == [sample.t for sample in before]  # true then, not now
    assert again == after
    assert (state.quality, state.state, state.referenced) == (Quality.BAD, AxisState.ERROR_STOP, False)


@pytest.mark.parametrize(
    ("resolved", "away", "quality"),
    [(False, False, Quality.GOOD), (True, False, Quality.UNCERTAIN), (True, True, Quality.BAD)],
)
async def test_a_counter_that_had_to_be_corrected_is_uncertain_and_one_of_a_lost_drive_is_bad(resolved, away, quality):
    value = MonitorValue(
        MonitorReading(monitor=MonitorName.SPEED_FEEDBACK, value=100, unit="rpm", title="speed"), resolved=resolved
    )
    async with axis_bench() as bench:
        if away:
            bench.axis.disconnected()
        bench.axis.readings.take_monitor(value, TIMING)
        sample = bench._publisher.last[KEYS.monitor("x", MonitorName.SPEED_FEEDBACK)]

    assert (sample.value, sample.unit, sample.quality) == (100, "rpm", quality)


async def test_a_position_that_had_to_be_corrected_is_uncertain_and_its_velocity_is_not():
    async with axis_bench() as bench:
        poll(bench, POSITION, VELOCITY, position_counts=65_536, position_uncertain=True)
        corrected = [bench.published(item).quality for item in (POSITION, VELOCITY)]
        poll(bench, POSITION, VELOCITY, position_counts=5)
        again = [bench.published(item).quality for item in (POSITION, VELOCITY)]

    assert corrected == [Quality.UNCERTAIN, Quality.GOOD]
    assert again == [Quality.GOOD, Quality.GOOD]


async def test_a_state_that_is_made_of_older_words_says_how_old_the_oldest_is():
    async with axis_bench() as bench:
        poll(bench, POSITION, STATE, pieces=PartialReading(1.5, position=True))
        position, state, fault = (bench.published(item) for item in (POSITION, STATE, FAULT))

    assert position.t_error_ns == 1_000_000
    assert state.t == fault.t == position.t
    assert state.t_error_ns == fault.t_error_ns == 1_501_000_000


async def test_an_axis_that_is_withdrawn_leaves_nothing_that_looks_alive():
    gone = []
    async with axis_bench() as bench:
        publisher = bench._publisher
        poll(bench, POSITION)
        for index in range(2):
            publisher.publish_trace_chunk("x", index, CHUNK)
        publisher.session.delete = gone.append
        publisher.withdraw("x")

        assert publisher.last == {}
        assert set(gone) >= {KEYS.telemetry("x", POSITION), KEYS.trace_chunk("x", 0), KEYS.trace_chunk("x", 1)}
