"""The recorder of one simulated drive under the real bus, without a daemon."""

import asyncio

import pytest

from ldcnd.bus.wire_log import WireEvent
from ldcnd.drivers.smartstep.profiles import SmartStepProfile, TriggerWordSource
from ldcnd.drivers.smartstep.simulated_variant import BENCH_TRIGGER_MAP
from ldcnd.errors import BusError, DriveFault, ValueOutOfRange, WrongState
from ldcnd.model.requests import TraceRequest
from ldcnd.model.traces import TraceTrigger, TriggerKind
from ldcnd.sim.faults import Fault, FaultKind, FaultPlan
from tests.support.smartstep_line import simulated, smartstep_line

TRIGGERED = SmartStepProfile(trigger_word=TriggerWordSource.CONFIGURED, trigger_map=BENCH_TRIGGER_MAP)
NEVER = TraceTrigger(channel="speed_feedback", kind=TriggerKind.RISING, level=4000.0)


def ignore(_phase):
    pass


def frames(line):
    return [record.data for record in line.bus.wire_log.records() if record.event is WireEvent.SENT]


async def test_arming_sends_the_frames_of_the_manual_in_its_order():
    async with smartstep_line([simulated(1)]) as line:
        request = TraceRequest(channels=("speed_feedback", "position_deviation", "inp", "alm"), interval_s=0.002)
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
        request = TraceRequest(channels=("torque_reference", "speed_feedback"), trigger=NEVER)
        armed = await line.axis("u1").tracer.arm(request)
        read = drive.drive.recorder.read

        assert (read(0x5004), read(0x5005)) == (BENCH_TRIGGER_MAP.trace2 | BENCH_TRIGGER_MAP.rising, 13_333)
        assert armed.granted.interval_s == pytest.approx(0.0005)


async def test_cancelled_recording_leaves_the_drive_in_its_normal_mode():
    drive = simulated(1)
    async with smartstep_line([drive], profile=TRIGGERED) as line:
        armed = await line.axis("u1").tracer.arm(TraceRequest(channels=("speed_feedback",), trigger=NEVER))
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
            await axis.tracer.arm(TraceRequest(channels=("run",)))

        assert frames(line) == []


async def test_interval_is_judged_by_the_unit_of_this_drive():
    async with smartstep_line([simulated(1)]) as line:
        with pytest.raises(ValueOutOfRange, match=r"is not 0\.0005 to 16\.38375 s"):
            await line.axis("u1").tracer.arm(TraceRequest(channels=("run",), interval_s=17.0))

        assert not [frame for frame in frames(line) if frame[2:3] == b"1"]


@pytest.mark.parametrize("seed", range(8))
async def test_a_bad_line_gives_the_true_trace_or_an_error_and_executes_once_at_most(seed):
    drive = simulated(1)
    drive.drive.set_run(0.0, on=True)
    drive.drive.set_pulse_rate(3000.0, 0.0)
    kinds = (FaultKind.REQUEST_LOST, FaultKind.REPLY_LOST, FaultKind.REPLY_BIT_FLIPPED)
    faults = FaultPlan(tuple(Fault(kind, 0.08) for kind in kinds), seed=seed)
    recorded = None
    async with smartstep_line([drive], faults=faults) as line:
        try:
            armed = await line.axis("u1").tracer.arm(TraceRequest(channels=("speed_feedback",)))
            recorded = await armed.record(ignore)
        except (BusError, DriveFault):
            pass
        executed = [frame for frame in frames(line) if frame.startswith(b"W112001")]

    assert len(executed) <= 1
    assert drive.drive.mode == 0
    if recorded:
        assert list(recorded.raw[0]) == drive.drive.recorder.rings[0]
