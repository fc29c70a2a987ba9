"""Traces by a SmartStep's own recorder, taken by a client through the whole daemon."""

import asyncio
from itertools import pairwise

import pytest

from ldcnd.client.traces import arm_trace, fetch_trace, take_trace, trace_header, wait_for_trace
from ldcnd.contract.codec import decode
from ldcnd.contract.errors import BusyTracing, DriveFault, NotSupported, ValueOutOfRange, WrongState
from ldcnd.contract.keys import Keys
from ldcnd.contract.parameters import WriteParameter
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.samples import TelemetryItem
from ldcnd.contract.traces import AbortTrace, TakeTrace, TracePhase, TraceTrigger, TriggerKind
from ldcnd.drives.smartstep.profiles import ByteOrder, CountUnit, StringChecksum, TraceWordLayout
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.rig import EPOCH_NS
from tests.support.trace_rig import trace_rig, trace_rig_over_zenoh

LAYOUTS = [TraceWordLayout.MSB_IO, TraceWordLayout.LSB_IO_SHIFT, TraceWordLayout.LSB_IO_MASK]
CHANNELS = ("speed_feedback", "position_deviation", "inp")
SPEEDING_UP = TraceTrigger(channel="speed_feedback", kind=TriggerKind.RISING, level=100.0)


def trace_request(**changes):
    return TakeTrace(
        **{"channels": CHANNELS, "interval_s": 0.002, "pre_trigger": 100, "trigger": SPEEDING_UP, **changes}
    )


async def accelerating_trace(under_test, before_s, request):
    """Arm, let the motor stand for a while, send pulses, and fetch the trace."""
    client = under_test.rig.client
    reply = await arm_trace(client, "feed", request)
    await asyncio.sleep(before_s)
    under_test.pulses(10_000.0)
    await wait_for_trace(client, "feed", reply.trace_id, 120)
    return await fetch_trace(client, "feed", reply.trace_id)


def counts(trace, column):
    return [round(value / trace.header.channels[column].scale) for value in trace.values[column]]


def settings_sent(under_test):
    """Return the setting commands on the line: those with function 1."""
    return [packet for packet in under_test.sent() if packet[2:3] == b"1"]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("before_s", "wrapped"), [(0.8, False), (1.95, True)])
@pytest.mark.sweep(6)
async def test_triggered_trace_equals_what_the_drive_recorded_sample_for_sample(layout, before_s, wrapped):
    async with trace_rig(SimulatedVariant(trace_word_layout=layout)) as under_test:
        trace = await accelerating_trace(under_test, before_s, trace_request(interval_s=0.004))
        points = under_test.witness.points

    check_against_record(trace, points, layout)
    assert (trace.header.drive.trgadr < 100) is wrapped


@pytest.mark.system
@pytest.mark.real_time
@pytest.mark.parametrize(("layout", "before_s", "wrapped"), [(LAYOUTS[0], 0.8, False), (LAYOUTS[2], 1.87, True)])
async def test_triggered_trace_over_real_zenoh_equals_what_the_drive_recorded(layout, before_s, wrapped):
    async with trace_rig_over_zenoh(SimulatedVariant(trace_word_layout=layout)) as under_test:
        trace = await accelerating_trace(under_test, before_s, trace_request(interval_s=0.004))
        points = under_test.witness.points

    check_against_record(trace, points, layout)
    assert (trace.header.drive.trgadr < 100) is wrapped


def check_against_record(trace, points, layout):
    """Hold a trace against every point that the drive has recorded."""
    header, info = trace.header, trace.header.drive
    trigger = len(points[0]) - 400
    expected = [recorded[trigger - 100 :] for recorded in points]
    kept = ~1 if layout is TraceWordLayout.LSB_IO_MASK else ~0
    for memory in (0, 1):
        assert counts(trace, memory) == [point.value & kept for point in expected[memory]]
    assert trace.values[2] == tuple(float(point.io) for point in expected[0])
    assert len(set(trace.values[0])) > 20
    assert len(set(trace.values[2])) == 2
    assert info.trgadr == trigger % 500
    assert (header.trigger_index, trace.offsets_ns[100]) == (100, 0)
    assert trace.values[0][99] < 100.0 <= trace.values[0][100]
    assert {later - earlier for earlier, later in pairwise(trace.offsets_ns)} == {4_000_000}
    assert info.word_layout == layout.value
    assert header.quality == "uncertain"


@pytest.mark.parametrize(
    "variant",
    [
        SimulatedVariant(trace_byte_order=ByteOrder.LITTLE),
        SimulatedVariant(string_count_unit=CountUnit.WORDS),
        SimulatedVariant(string_count_unit=CountUnit.CHARS),
        SimulatedVariant(string_checksum=StringChecksum.ALL),
        SimulatedVariant(string_checksum=StringChecksum.TRAILER),
        SimulatedVariant(longest_string_bytes=64),
        SimulatedVariant(cyclec_us=125, maxtrqc=250, osvelcc=3000),
    ],
    ids=["little", "words", "chars", "all", "trailer", "short strings", "constants"],
)
@pytest.mark.sweep(5)
async def test_untriggered_trace_is_read_rightly_from_every_kind_of_drive(variant):
    async with trace_rig(variant) as under_test:
        under_test.pulses(8_000.0)
        trace = await take_trace(
            under_test.rig.client,
            "feed",
            TakeTrace(channels=("torque_reference", "speed_feedback", "bkir", "run")),
            within_s=60,
        )
        points = under_test.witness.points

    assert [counts(trace, memory) for memory in (0, 1)] == [[point.value for point in each] for each in points]
    assert trace.values[2] == tuple(float(point.io) for point in points[0])
    assert trace.values[3] == tuple(float(point.io) for point in points[1])
    assert trace.header.interval_s == pytest.approx(2 * variant.cyclec_us * 1e-6)
    assert trace.values[0][7] == pytest.approx(points[0][7].value * variant.maxtrqc / 15_000)
    assert trace.values[1][7] == pytest.approx(points[1][7].value * variant.osvelcc / 15_000)
    assert trace.offsets_ns[0] == 0


@pytest.mark.parametrize(("gear", "rpm"), [("num/den", 240.0), ("den/num", 15.0), ("none", 60.0)])
@pytest.mark.sweep(2)
async def test_command_pulses_are_geared_to_motor_speed_as_configured(gear, rpm):
    async with trace_rig(assumed={"command_pulse_gear": gear}) as under_test:
        under_test.pulses(8_000.0)
        trace = await take_trace(
            under_test.rig.client, "feed", TakeTrace(channels=("speed_feedback", "command_pulse_speed")), within_s=60
        )

    # 8,000 units a second, a gear of 4 counts to a unit, 8,000 counts to a turn
    assert trace.values[0][-1] == pytest.approx(240.0, abs=0.3)
    assert trace.values[1][-1] == pytest.approx(rpm)
    assert (trace.header.drive.gear_numerator, trace.header.drive.gear_denominator) == (4, 1)


@pytest.mark.long
async def test_raw_words_are_kept_as_the_drive_has_them():
    async with trace_rig() as under_test:
        trace = await accelerating_trace(under_test, 0.5, trace_request())
        rings = under_test.units[0].drive.recorder.rings

    first = (trace.header.drive.trgadr - 100) % 500
    assert [list(column) for column in trace.raw] == [[*ring[first:], *ring[:first]] for ring in rings]


async def test_unknown_layout_leaves_words_undecoded():
    config = {"word_layout": TraceWordLayout.RAW}
    async with trace_rig(assumed=config) as under_test:
        trace = await take_trace(
            under_test.rig.client, "feed", TakeTrace(channels=("position_deviation", "inp")), within_s=60
        )

    assert trace.values[0] == trace.raw[0]
    assert set(trace.values[1]) == {None}
    assert trace.header.channels[0].unit == ""


@pytest.mark.long
async def test_values_that_cannot_be_make_the_layout_uncertain():
    async with trace_rig(assumed={"word_layout": TraceWordLayout.LSB_IO_SHIFT}) as under_test:
        under_test.pulses(-8_000.0)
        trace = await take_trace(under_test.rig.client, "feed", TakeTrace(channels=("speed_feedback",)), within_s=60)
        honest = await take_trace(under_test.rig.client, "feed", TakeTrace(channels=("speed_feedback",)), within_s=60)

    assert honest.header.quality == trace.header.quality == "uncertain"
    assert "hardly laid out as lsb-io-shift" in trace.header.problem


@pytest.mark.parametrize("after_s", [0.7, 1.7])
@pytest.mark.sweep(2)
async def test_instant_of_the_trigger_is_within_its_error(after_s):
    async with trace_rig() as under_test:
        loop = asyncio.get_running_loop()
        client = under_test.rig.client
        reply = await arm_trace(client, "feed", trace_request())
        await asyncio.sleep(after_s)
        pulses_at_ns = EPOCH_NS + round(loop.time() * 1e9)
        under_test.pulses(10_000.0)
        header = await wait_for_trace(client, "feed", reply.trace_id, 60)

    # the motor reaches the level within some 10 ms of the first pulse
    assert abs(header.t - pulses_at_ns - 5_000_000) <= header.t_error_ns + 10_000_000
    # the mode is read every 0.2 s, comparisons of the trace and slow polls come between
    assert header.t_error_ns < 600_000_000


@pytest.mark.long
async def test_second_unit_keeps_its_rate_while_a_trace_uploads():
    async def gaps_s(rig, number):
        stamps = []
        async with rig.client.samples("spool", TelemetryItem.POSITION) as samples:
            while len(stamps) <= number:
                stamps.append((await anext(samples))[1].t / 1e9)
        return [later - earlier for earlier, later in pairwise(stamps)]

    async with trace_rig(loaded=True) as under_test:
        rig = under_test.rig
        quiet = await gaps_s(rig, 20)
        reply = await arm_trace(rig.client, "feed", TakeTrace(channels=("speed_feedback", "inp")))
        await asyncio.sleep(1.0)
        uploading = await trace_header(rig.client, "feed")

        busy = await gaps_s(rig, 5)
        still = await trace_header(rig.client, "feed")
        end = await wait_for_trace(rig.client, "feed", reply.trace_id, 120)

    # a position is due every 2 s; one piece may be on the wire when it is its turn
    piece_s = (14 + 14 + 2 * 200) * 10 / 9600 + 0.02
    assert (uploading.phase, still.phase, end.phase) == (
        TracePhase.UPLOADING,
        TracePhase.UPLOADING,
        TracePhase.COMPLETE,
    )
    assert 0 <= uploading.uploaded < still.uploaded < 1
    assert end.uploaded is None
    assert max(busy) <= max(quiet) + piece_s
    assert sum(busy) <= 5 * 2.0 + max(quiet) - 2.0 + piece_s


@pytest.mark.long
async def test_stop_on_another_bus_is_not_delayed_by_an_upload():
    async def stop_times_s(rig, number):
        loop = asyncio.get_running_loop()
        times = []
        for _ in range(number):
            began_s = loop.time()
            await rig.client.stop("x")
            times.append(loop.time() - began_s)
            await asyncio.sleep(0.0371)
        return times

    async with trace_rig() as under_test:
        rig = under_test.rig
        (answer,) = await rig.session.query(Keys("mixed").budget)
        plan = decode(RigBudget, answer.payload, answer.encoding)
        (bound_s,) = [bus.stop_s for bus in plan.buses if bus.bus == "line0"]
        await arm_trace(rig.client, "feed", TakeTrace(channels=CHANNELS))
        await asyncio.sleep(0.6)

        busy = await stop_times_s(rig, 100)
        header = await trace_header(rig.client, "feed")

    assert header.phase is TracePhase.UPLOADING
    assert max(busy) <= bound_s


async def test_setting_during_a_trace_is_busy_tracing_and_commands_for_others_go_on():
    async with trace_rig() as under_test:
        client = under_test.rig.client
        await arm_trace(client, "feed", trace_request())
        write = WriteParameter(parameter="Pn102", value=50)

        with pytest.raises(BusyTracing, match="e=9"):
            await client.command("feed", write)
        reply = await client.command("spool", write)
        with pytest.raises(BusyTracing, match="trace run1-1 is waiting"):
            await arm_trace(client, "feed", trace_request())
        aborted = await client.command("feed", AbortTrace(), 10)
        after = await client.command("feed", write)
        header = await trace_header(client, "feed")

    assert (reply.written, after.written) == (True, True)
    assert (aborted.trace_id, header.phase, header.chunks) == ("run1-1", TracePhase.ABORTED, 0)


@pytest.mark.parametrize(
    ("request_", "error", "reason"),
    [
        (TakeTrace(channels=("position",)), ValueOutOfRange, "cannot trace 'position'; there are torque_reference"),
        (
            TakeTrace(channels=("torque_reference", "speed_feedback", "position_deviation")),
            ValueOutOfRange,
            "the drive traces 2",
        ),
        (TakeTrace(channels=("run",), samples=501), ValueOutOfRange, "has room for 500"),
        (TakeTrace(channels=("run",), interval_s=1e-7), ValueOutOfRange, "no drive samples every"),
        (TakeTrace(channels=("run",), interval_s=5000.0), ValueOutOfRange, "no drive samples every"),
        (trace_request(pre_trigger=500), ValueOutOfRange, "are not 0 to 499"),
        (
            trace_request(trigger=TraceTrigger(channel="inp", kind=TriggerKind.ABOVE)),
            NotSupported,
            "triggers on edges only",
        ),
        (trace_request(channels=("run",)), ValueOutOfRange, "which is not recorded"),
    ],
)
@pytest.mark.sweep(2)
async def test_impossible_trace_is_refused_with_the_reason_before_anything_is_sent(request_, error, reason):
    async with trace_rig() as under_test:
        words = under_test.rig.daemon.rig.axes["feed"].driver.words
        asked = []
        words.ask = asked.append

        with pytest.raises(error, match=reason):
            await arm_trace(under_test.rig.client, "feed", request_)

    assert asked == []


@pytest.mark.parametrize("interval_s", [0.0001, 20.0])
async def test_interval_that_this_drive_has_not_is_refused_before_anything_is_set(interval_s):
    async with trace_rig() as under_test:
        with pytest.raises(ValueOutOfRange, match="a sampling period of") as refused:
            await arm_trace(under_test.rig.client, "feed", trace_request(interval_s=interval_s))

        assert refused.value.nearest == pytest.approx({0.0001: 0.0005, 20.0: 16.38375}[interval_s])
        assert settings_sent(under_test) == []


async def test_samples_before_a_trigger_without_a_map_are_refused_before_anything_is_sent():
    async with trace_rig(assumed={"trigger_map": None}) as under_test:
        with pytest.raises(ValueOutOfRange, match="trigger bits of the drive are not known"):
            await arm_trace(under_test.rig.client, "feed", trace_request())

        assert settings_sent(under_test) == []


async def test_trigger_that_does_not_come_leaves_the_drive_in_its_normal_mode():
    async with trace_rig() as under_test:
        with pytest.raises(DriveFault, match="the trigger did not come"):
            await take_trace(under_test.rig.client, "feed", trace_request(timeout_s=1.0), within_s=60)
        mode = under_test.units[0].drive.mode

    assert mode == 0


async def test_drive_that_was_switched_off_meanwhile_gives_no_trace():
    async with trace_rig() as under_test:
        loop, feed, client = asyncio.get_running_loop(), under_test.units[0], under_test.rig.client
        reply = await arm_trace(client, "feed", trace_request())
        feed.power_off(loop.time())
        await asyncio.sleep(0.2)
        feed.power_on(loop.time())
        header = await wait_for_trace(client, "feed", reply.trace_id, 60)

    assert header.phase is TracePhase.FAILED
    assert "was switched off" in header.problem


async def test_trace_that_was_left_armed_in_the_drive_is_ended_on_request_only():
    async with trace_rig() as under_test:
        drive, client = under_test.units[0].drive, under_test.rig.client
        drive.write(0x2000, 0x2000)

        with pytest.raises(BusyTracing, match="busy tracing"):
            await arm_trace(client, "feed", trace_request())
        left = drive.mode
        reply = await client.command("feed", AbortTrace())
        ended = drive.mode
        with pytest.raises(WrongState, match="no trace is under way"):
            await client.command("feed", AbortTrace())

    assert (left, ended, reply.trace_id) == (0x2000, 0, None)
