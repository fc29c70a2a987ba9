"""Tests of the recorder of a SmartStep: what the tracer does on a line that fails, and the upload of its memories."""

import asyncio

import pytest

from ldcnd.drivers.smartstep.profiles import CountUnit, SmartStepProfile, StringChecksum, TriggerWordSource
from ldcnd.drivers.smartstep.trace import TraceUpload
from ldcnd.errors import BadReply, BusError, ByteCountRefused, DriveFault, ValueOutOfRange, WrongState
from ldcnd.model.traces import TakeTrace, TraceTrigger, TriggerKind
from ldcnd.sim.faults import Fault, FaultKind, FaultPlan
from ldcnd.sim.smartstep.variant import BENCH_TRIGGER_MAP, SimulatedVariant
from ldcnd.wirelog.recorder import WireEvent
from tests.support.smartstep_line import executes_in_a_fresh_mode_only, simulated, smartstep_line

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
    _, _, once = await fetched(filled(), SmartStepProfile(trace_verify=False))

    assert words == RAMP
    assert (once, twice) == (5, 10)


async def test_pieces_that_are_too_long_for_a_drive_are_halved():
    words, _, exchanges = await fetched(
        filled(SimulatedVariant(longest_string_bytes=50)), SmartStepProfile(trace_verify=False)
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


TRIGGERED = SmartStepProfile(trigger_word=TriggerWordSource.CONFIGURED, trigger_map=BENCH_TRIGGER_MAP)
NEVER = TraceTrigger(channel="speed_feedback", kind=TriggerKind.RISING, level=4000.0)


def ignore(_phase):
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
        assert armed.granted.interval_s == pytest.approx(0.0005)


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
async def test_a_bad_line_gives_the_true_trace_or_an_error_and_executes_in_a_fresh_mode_only(seed):
    drive = simulated(1)
    drive.drive.set_run(0.0, on=True)
    drive.drive.set_pulse_rate(3000.0, 0.0)
    kinds = (FaultKind.REQUEST_LOST, FaultKind.REPLY_LOST, FaultKind.REPLY_BIT_FLIPPED)
    faults = FaultPlan(tuple(Fault(kind, 0.08) for kind in kinds), seed=seed)
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
