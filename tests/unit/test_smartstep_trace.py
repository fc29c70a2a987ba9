"""Tests of the recorder of a SmartStep: what the tracer does on a line that fails, and the upload of its memories."""

import asyncio

import pytest

from ldcnd.contract.errors import (
    BadReply,
    BusError,
    ByteCountRefused,
    DriveFault,
    NotSupported,
    OutcomeUnknown,
    TraceTimedOut,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.traces import TakeTrace, TraceTrigger, TriggerKind
from ldcnd.drives.smartstep.addresses import TraceRegister
from ldcnd.drives.smartstep.commands import reference
from ldcnd.drives.smartstep.modes import EXECUTE_ATTEMPTS
from ldcnd.drives.smartstep.parameters import PN202, PN203
from ldcnd.drives.smartstep.profiles import (
    SMARTSTEP,
    CountUnit,
    SmartStepProfile,
    StringChecksum,
)
from ldcnd.drives.smartstep.trace import put_back
from ldcnd.drives.smartstep.trace_upload import TraceUpload
from ldcnd.line.exchange import Lane
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.smartstep.unit import SimulatedUnit
from ldcnd.sim.smartstep.variant import BENCH_TRIGGER_MAP, SimulatedVariant
from tests.support.smartstep_line import (
    LosingUnit,
    executes_in_a_fresh_mode_only,
    losing_once,
    simulated,
    smartstep_line,
)

RAMP = [(7 * point) & 0xFFFF for point in range(500)]


def filled(variant=None):
    drive = simulated(1, variant)
    for ring in drive.drive.recorder.rings:
        ring[:] = RAMP
    return drive


async def fetched(drive, profile):
    async with smartstep_line([drive], profile=profile) as line:
        upload = TraceUpload(line.bus, line.axis("u1").words, profile)
        words = await upload.fetch(2)
        return list(words), upload.string_checksum, line.bus.statistics.exchanges


async def test_everything_is_read_twice_unless_told_otherwise():
    words, _, twice = await fetched(filled(), SmartStepProfile())
    _, _, once = await fetched(filled(), SMARTSTEP.with_trace(verify=False))

    assert words == RAMP
    assert (once, twice) == (5, 10)


async def test_pieces_that_are_too_long_for_a_drive_are_halved():
    words, _, exchanges = await fetched(
        filled(SimulatedVariant(longest_string_bytes=50)), SMARTSTEP.with_trace(verify=False)
    )

    assert words == RAMP
    assert exchanges == 5 * (1 + 2 + 4)


async def test_a_drive_that_refuses_a_single_word_is_believed():
    with pytest.raises(ExceptionGroup) as refused:
        await fetched(filled(SimulatedVariant(longest_string_bytes=1)), SmartStepProfile())

    assert refused.group_contains(ByteCountRefused)


async def test_the_checksum_of_the_drive_is_learnt_on_the_way():
    _, found, _ = await fetched(filled(SimulatedVariant(string_checksum=StringChecksum.ALL)), SmartStepProfile())

    assert found is StringChecksum.ALL


async def test_another_count_unit_is_recognised_and_named():
    with pytest.raises(ExceptionGroup) as refused:
        await fetched(filled(SimulatedVariant(string_count_unit=CountUnit.CHARS)), SmartStepProfile())

    assert refused.group_contains(BadReply, match="count unit seems to be chars")


async def test_memory_that_changes_while_it_is_read_is_read_until_it_rests():
    drive, profile = filled(), SmartStepProfile()
    ring = drive.drive.recorder.rings[1]
    async with smartstep_line([drive], profile=profile) as line:
        upload = TraceUpload(line.bus, line.axis("u1").words, profile)
        async with asyncio.TaskGroup() as group:
            fetching = group.create_task(upload.fetch(2), name="fetch")
            await asyncio.sleep(0.3)  # the reply of the first reading is on its way
            ring[0] = 0x1234

    assert fetching.result()[0] == 0x1234


async def test_memory_that_never_rests_is_no_trace():
    drive, profile = filled(), SmartStepProfile()
    ring = drive.drive.recorder.rings[1]

    async def disturb():
        while True:
            ring[0] = (ring[0] + 1) & 0xFFFF
            await asyncio.sleep(0.05)

    async with smartstep_line([drive], profile=profile) as line:
        upload = TraceUpload(line.bus, line.axis("u1").words, profile)
        async with asyncio.TaskGroup() as group:
            disturbing = group.create_task(disturb(), name="disturb")
            with pytest.raises(BadReply, match="read differently each time"):
                await upload.fetch(2)
            disturbing.cancel()


TRIGGERED = SMARTSTEP.with_trace(trigger_map=BENCH_TRIGGER_MAP)
NEVER = TraceTrigger(channel="speed_feedback", kind=TriggerKind.RISING, level=4000.0)


def ignore(_phase, _uploaded):
    pass


def frames(line):
    return [record.data for record in line.bus.wire_log.records() if record.event is WireEvent.SENT]


async def test_arming_sends_the_frames_of_the_manual_in_its_order():
    async with smartstep_line([simulated(1)]) as line:
        request = TakeTrace(channels=("speed_feedback", "position_deviation", "inp", "alm"), interval_s=0.002)
        await line.axis("u1").tracer.arm(request)
        settings = [frame for frame in frames(line) if frame[2:3] == b"1"]

    assert settings == [
        b"W11500081011D\r",
        b"W11500180041A\r",
        b"W115002000895\r",
        b"W1150030000" + settings[3][-3:],
        b"W11500400009B\r",
        b"W1150050000" + settings[5][-3:],
        b"W1120002000AF\r",
        b"W1120010001CD\r",
    ]


async def test_readings_while_armed_need_no_setting_and_the_trigger_level_is_scaled():
    drive = simulated(1)
    async with smartstep_line([drive], profile=TRIGGERED) as line:
        request = TakeTrace(channels=("torque_reference", "speed_feedback"), trigger=NEVER)
        armed = await line.axis("u1").tracer.arm(request)
        read = drive.drive.recorder.read

        assert (read(0x5004), read(0x5005)) == (BENCH_TRIGGER_MAP.trace2 | BENCH_TRIGGER_MAP.rising, 13_333)
        assert armed.granted.shape.interval_s == pytest.approx(0.0005)


async def test_cancelled_recording_leaves_the_drive_in_its_normal_mode():
    drive = simulated(1)
    async with smartstep_line([drive], profile=TRIGGERED) as line:
        armed = await line.axis("u1").tracer.arm(TakeTrace(channels=("speed_feedback",), trigger=NEVER))
        before = drive.drive.mode

        async with asyncio.TaskGroup() as group:
            recording = group.create_task(armed.record(ignore), name="record")
            await asyncio.sleep(0.5)
            recording.cancel()

        assert (before, drive.drive.mode) == (0x2000, 0)


async def test_nothing_is_set_on_wires_where_the_drive_hears_itself():
    async with smartstep_line([simulated(1)]) as line:
        axis = line.axis("u1")
        axis.words.self_hearing = True

        with pytest.raises(WrongState, match="its own replies"):
            await axis.tracer.arm(TakeTrace(channels=("run",)))

        assert frames(line) == []


async def test_interval_is_judged_by_the_unit_of_this_drive():
    async with smartstep_line([simulated(1)]) as line:
        with pytest.raises(ValueOutOfRange, match=r"is not 0\.0005 to 16\.38375 s"):
            await line.axis("u1").tracer.arm(TakeTrace(channels=("run",), interval_s=17.0))

        assert not [frame for frame in frames(line) if frame[2:3] == b"1"]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.sweep(2)
async def test_a_bad_line_gives_the_true_trace_or_an_error_and_executes_in_a_fresh_mode_only(seed):
    drive = simulated(1)
    drive.drive.set_run(0.0, on=True)
    drive.drive.set_pulse_rate(3000.0, 0.0)
    kinds = (FaultKind.REQUEST_LOST, FaultKind.REPLY_LOST, FaultKind.REPLY_BIT_FLIPPED)
    faults = FaultPlan(tuple(LineFault(kind, 0.08) for kind in kinds), seed=seed)
    recorded = None
    async with smartstep_line([drive], faults=faults) as line:
        try:
            armed = await line.axis("u1").tracer.arm(TakeTrace(channels=("speed_feedback",)))
            recorded = await armed.record(ignore)
        except (BusError, DriveFault):
            pass
        sent = frames(line)

    assert executes_in_a_fresh_mode_only(sent)
    assert drive.drive.mode == 0
    if recorded:
        assert list(recorded.raw[0]) == drive.drive.recorder.rings[0]


def running(variant: SimulatedVariant | None = None, pulses: float = 3000.0, **stored) -> SimulatedUnit:
    """A drive whose motor turns with its pulses since long before the line opened."""
    unit = simulated(1, variant, **stored)
    unit.drive.set_run(0.0, on=True)
    unit.drive.set_pulse_rate(pulses, 0.0)
    unit.drive.motor.deviation = pulses * unit.drive.motor.gear / unit.drive.motor.gain
    unit.drive.motor.speed = pulses * unit.drive.motor.gear
    return unit


async def taken(line, **request):
    """Take a trace on an open line."""
    armed = await line.axis("u1").tracer.arm(TakeTrace(**request))
    return await armed.record(ignore)


@pytest.mark.parametrize("lost", [("request",), ("reply",), ("request", "reply", "request")])
@pytest.mark.sweep(2)
async def test_a_lost_execute_starts_the_trace_within_seconds(lost):
    unit = losing_once(1, b"W112001", *lost)
    async with smartstep_line([unit]) as line:
        async with asyncio.timeout(20.0):
            recorded = await taken(line, channels=("run",))

        assert executes_in_a_fresh_mode_only(frames(line))
        assert list(recorded.raw[0]) == unit.drive.recorder.rings[0]


@pytest.mark.parametrize("lost", ["request", "reply"])
async def test_a_trace_that_cannot_be_started_leaves_nothing_armed(lost):
    unit = losing_once(1, b"W112001", *[lost] * EXECUTE_ATTEMPTS)
    async with smartstep_line([unit]) as line:
        with pytest.raises(OutcomeUnknown, match="5 attempts"):
            await line.axis("u1").tracer.arm(TakeTrace(channels=("run",)))

        assert unit.drive.mode == 0
        assert executes_in_a_fresh_mode_only(frames(line))


async def test_a_triggered_trace_whose_execute_got_lost_waits_in_a_drive_that_has_started():
    unit = losing_once(1, b"W112001", "request")
    unit.drive.set_run(0.0, on=True)
    async with smartstep_line([unit], profile=TRIGGERED) as line:
        trigger = TraceTrigger(channel="speed_feedback", kind=TriggerKind.RISING, level=100.0)
        armed = await line.axis("u1").tracer.arm(
            TakeTrace(channels=("speed_feedback",), trigger=trigger, timeout_s=600)
        )
        unit.drive.set_pulse_rate(8000.0, asyncio.get_running_loop().time())
        async with asyncio.timeout(20.0):
            recorded = await armed.record(ignore)

        assert recorded.trigger_index == 0


async def test_values_are_uncertain_until_the_layout_was_verified_on_the_drive():
    async with smartstep_line([running()]) as line:
        assumed = await taken(line, channels=("speed_feedback",))
    async with smartstep_line([running()], profile=SMARTSTEP.with_trace(verified=True)) as line:
        verified = await taken(line, channels=("speed_feedback",))

    assert "ldcnd doctor verify" in assumed.problems[0]
    assert verified.problems == ()
    assert verified.values[0][250] == pytest.approx(90.0, abs=0.4)


async def test_a_trace_that_was_ended_from_elsewhere_is_no_trace():
    unit = running()
    async with smartstep_line([unit]) as line:
        armed = await line.axis("u1").tracer.arm(TakeTrace(channels=("speed_feedback",), interval_s=0.01))
        await asyncio.sleep(0.6)
        unit.drive.advance(asyncio.get_running_loop().time())
        unit.drive.write(0x2000, 0)

        with pytest.raises(DriveFault, match="ended early"):
            await armed.record(ignore)


@pytest.mark.long
async def test_a_triggered_trace_that_was_ended_from_elsewhere_shows_no_trigger():
    unit = running(pulses=0.0)
    async with smartstep_line([unit], profile=TRIGGERED) as line:
        armed = await line.axis("u1").tracer.arm(TakeTrace(channels=("speed_feedback",), trigger=NEVER))
        await asyncio.sleep(2.0)
        unit.drive.advance(asyncio.get_running_loop().time())
        unit.drive.write(0x2000, 0)
        recorded = await armed.record(ignore)

    assert any("trigger" in problem for problem in recorded.problems)


async def test_the_gear_of_a_pulse_trace_is_that_of_the_eeprom():
    unit = running(pulses=4000.0, stored={PN202: 4, PN203: 1})
    async with smartstep_line([unit], profile=SMARTSTEP) as line:
        unit.drive.memory.write(0x1202, 40)
        recorded = await taken(line, channels=("command_pulse_speed",))

    assert recorded.drive.gear_numerator == 4
    assert recorded.values[0][0] == pytest.approx(120.0)
    assert any("Pn202" in problem for problem in recorded.problems)


async def test_the_trigger_may_have_come_two_milliseconds_before_it_was_seen():
    unit = running(pulses=0.0)
    async with smartstep_line([unit], profile=TRIGGERED) as line:
        trigger = TraceTrigger(channel="speed_feedback", kind=TriggerKind.RISING, level=100.0)
        armed = await line.axis("u1").tracer.arm(TakeTrace(channels=("speed_feedback",), trigger=trigger))
        unit.drive.set_pulse_rate(8000.0, asyncio.get_running_loop().time())
        running_at_s = armed._running_at_s
        recorded = await armed.record(ignore)
        after_s = 499 * armed.granted.shape.interval_s

    assert recorded.zero_from_s <= armed._running_at_s - after_s - 0.002 + 1e-9
    assert recorded.trigger_late_s == pytest.approx(0.002)
    assert running_at_s > 0


async def test_a_smaller_full_scale_resolves_finer_and_is_put_back():
    unit = running()
    async with smartstep_line([unit]) as line:
        recorded = await taken(line, channels=("speed_feedback",), full_scale={"speed_feedback": 450.0})

        assert recorded.drive.osvelcc == 450
        assert recorded.values[0][250] == pytest.approx(90.0, abs=0.04)
        assert (await line.axis("u1").words.read(0x8702)) == 4500


async def test_a_full_scale_is_put_back_also_behind_one_that_the_line_loses():
    unit = LosingUnit(1, lambda _, packet: "request" if packet.startswith(b"W118701") else None)
    async with smartstep_line([unit]) as line:
        words = line.axis("u1").words

        restored = await put_back(words, {TraceRegister.MAXTRQC: 123, TraceRegister.OSVELCC: 456})

        assert not restored
        assert await words.read(TraceRegister.OSVELCC) == 456


async def test_a_full_scale_that_the_drive_does_not_take_is_said():
    unit = running(SimulatedVariant(full_scale_settable=False))
    async with smartstep_line([unit]) as line:
        with pytest.raises(NotSupported, match="8702H"):
            await line.axis("u1").tracer.arm(
                TakeTrace(channels=("speed_feedback",), full_scale={"speed_feedback": 450})
            )

        assert unit.drive.mode == 0


async def test_either_edge_of_a_value_is_refused_because_the_drive_would_take_any_change():
    async with smartstep_line([simulated(1)], profile=TRIGGERED) as line:
        trigger = TraceTrigger(channel="speed_feedback", kind=TriggerKind.EITHER, level=100.0)

        with pytest.raises(NotSupported, match="any change"):
            await line.axis("u1").tracer.arm(TakeTrace(channels=("speed_feedback",), trigger=trigger))


async def test_a_change_of_a_value_triggers_by_both_edges():
    unit = running(pulses=0.0)
    async with smartstep_line([unit], profile=TRIGGERED) as line:
        trigger = TraceTrigger(channel="speed_feedback", kind=TriggerKind.CHANGE, level=0.0)
        armed = await line.axis("u1").tracer.arm(TakeTrace(channels=("speed_feedback",), trigger=trigger))
        await asyncio.sleep(1.0)
        unit.drive.set_pulse_rate(100.0, asyncio.get_running_loop().time())
        recorded = await armed.record(ignore)

    assert recorded.values[0][0] != 0.0
    assert max(recorded.values[0]) < 4.0


async def test_without_known_trigger_bits_the_host_starts_the_trace_and_says_how_late():
    unit = running(pulses=0.0)
    async with smartstep_line([unit]) as line:
        trigger = TraceTrigger(channel="speed_feedback", kind=TriggerKind.RISING, level=100.0)
        request = TakeTrace(channels=("speed_feedback",), trigger=trigger, interval_s=0.004)
        armed = await line.axis("u1").tracer.arm(request)
        loop = asyncio.get_running_loop()
        met_s = loop.time() + 2.0
        loop.call_at(met_s, lambda: unit.drive.set_pulse_rate(8000.0, loop.time()))
        recorded = await armed.record(ignore)

    assert armed.granted.phase == "waiting"
    assert (recorded.trigger_index, recorded.drive.trigger_word_source) == (None, "host")
    assert recorded.values[0][0] > 100.0
    assert recorded.zero_from_s - recorded.trigger_late_s - 0.05 <= met_s <= recorded.zero_until_s


async def test_a_host_trigger_that_does_not_come_leaves_nothing_armed():
    unit = running(pulses=0.0)
    async with smartstep_line([unit]) as line:
        request = TakeTrace(channels=("speed_feedback",), trigger=NEVER, timeout_s=2.0)
        armed = await line.axis("u1").tracer.arm(request)

        with pytest.raises(TraceTimedOut, match="within 2 s"):
            await armed.record(ignore)

    assert unit.drive.mode == 0


@pytest.mark.parametrize("cyclec_us", [62, 125, 400])
async def test_the_fastest_interval_is_two_time_units_of_the_drive(cyclec_us):
    async with smartstep_line([simulated(1, SimulatedVariant(cyclec_us=cyclec_us))]) as line:
        armed = await line.axis("u1").tracer.arm(TakeTrace(channels=("speed_feedback",), interval_s="fastest"))

    assert armed.granted.shape.interval_s == pytest.approx(2 * cyclec_us * 1e-6)


async def test_a_trace_is_not_given_up_because_a_busy_line_answers_late():
    async with smartstep_line([running()]) as line:
        armed = await line.axis("u1").tracer.arm(TakeTrace(channels=("speed_feedback",), interval_s=0.002))
        busy_until_s = asyncio.get_running_loop().time() + 5.0

        async def others() -> None:
            while asyncio.get_running_loop().time() < busy_until_s:
                await line.bus.execute(reference(1, PN202.ram_address), Lane.COMMAND)

        async with asyncio.TaskGroup() as group:
            for _ in range(3):
                group.create_task(others())
            recorded = await armed.record(ignore)

    assert recorded.values[0][250] == pytest.approx(90.0, abs=0.4)


async def test_a_drive_that_still_traces_after_its_time_is_given_up_and_put_back():
    unit = running()
    async with smartstep_line([unit]) as line:
        armed = await line.axis("u1").tracer.arm(TakeTrace(channels=("speed_feedback",), interval_s=0.002))
        unit.drive.recorder.stop()  # it never finishes

        with pytest.raises(TraceTimedOut, match="did not finish"):
            await armed.record(ignore)

    assert unit.drive.mode == 0
