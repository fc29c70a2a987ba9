"""What the recorder of an axis publishes, whoever takes the samples."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from ldcnd.axis.clock import Clock
from ldcnd.axis.recorder import TraceRecorder
from ldcnd.contract.codec import MAX_PAYLOAD_BYTES, Encoding, encode
from ldcnd.contract.errors import OutcomeUnknown
from ldcnd.contract.keys import Keys
from ldcnd.contract.traces import (
    MOST_CHANNELS,
    MOST_SAMPLES,
    AbortTrace,
    TakeTrace,
    TraceChannel,
    TracePhase,
    TraceShape,
    TraceSource,
)
from ldcnd.drives.tracer import ArmedTrace, Granted, Recorded, Tracer
from ldcnd.net.publisher import Publisher
from ldcnd.testing.memory_session import MemoryBroker

LONG = -1.2345678901234567e-300
REQUEST = TakeTrace(channels=("c0",))


class FakeTrace(ArmedTrace):
    """Waits to be told its outcome."""

    def __init__(self, columns):
        names = [f"c{number}" for number in range(columns)]
        channels = tuple(TraceChannel(name=name, unit="u") for name in names)
        self.granted = Granted(
            TraceShape(channels=channels, interval_s=0.0, samples=MOST_SAMPLES, pre_trigger=0),
            tuple(names),
            TracePhase.RECORDING,
        )
        self.outcome = asyncio.get_running_loop().create_future()
        self.stubborn = False

    async def record(self, progress):
        if self.stubborn:
            await _heedless(self.outcome)
        progress(TracePhase.UPLOADING, 0.25)
        return await self.outcome


async def _heedless(future):
    """Wait for a future whatever happens, as a drive on a bad line makes one wait; then give way."""
    try:
        await asyncio.shield(future)
    except asyncio.CancelledError:
        await asyncio.sleep(100)
        raise


class FakeTracer(Tracer):
    source = TraceSource.HOST
    channels = ("c0",)

    def __init__(self, columns=1):
        self.columns = columns
        self.traces = []

    async def arm(self, request):
        self.traces.append(FakeTrace(self.columns))
        return self.traces[-1]

    async def disarm(self):
        return False


def recorded(samples, columns, value=1.0):
    column = (value,) * samples
    return Recorded(tuple(range(samples)), 0.0, 0.0, (column,) * columns, (column,) * columns)


@asynccontextmanager
async def recording(tracer) -> AsyncIterator[tuple[TraceRecorder, Publisher]]:
    broker = MemoryBroker()
    async with broker.session() as session:
        publisher = Publisher(session, Keys("rig"), Encoding.JSON)
        recorder = TraceRecorder("x", tracer, publisher, Clock(lambda: 10**18))
        async with asyncio.TaskGroup() as group:
            task = group.create_task(recorder.run(), name="traces")
            try:
                yield recorder, publisher
            finally:
                task.cancel()


def header(publisher):
    return publisher.last["ldcn/rig/tele/x/trace"]


async def until(publisher, phase):
    async with asyncio.timeout(10):
        while header(publisher).phase is not phase:
            await asyncio.sleep(0.01)


@pytest.mark.long
async def test_the_longest_trace_of_the_longest_numbers_fits_into_payloads():
    tracer = FakeTracer(MOST_CHANNELS)
    async with recording(tracer) as (recorder, publisher):
        await recorder.carry_out("t-1", REQUEST)
        tracer.traces[0].outcome.set_result(recorded(MOST_SAMPLES, MOST_CHANNELS, LONG))
        await until(publisher, TracePhase.COMPLETE)
        last = dict(publisher.last)

    chunks = [last[f"ldcn/rig/tele/x/trace/{index}"] for index in range(header(publisher).chunks)]
    assert sum(len(chunk.offsets_ns) for chunk in chunks) == MOST_SAMPLES
    assert [chunk.first for chunk in chunks] == [index * len(chunks[0].offsets_ns) for index in range(len(chunks))]
    for encoding in Encoding:
        assert max(len(encode(each, encoding)[0]) for each in last.values()) <= MAX_PAYLOAD_BYTES


async def test_a_shorter_trace_leaves_no_chunk_of_the_longer_one_before():
    tracer = FakeTracer()
    async with recording(tracer) as (recorder, publisher):
        for number, samples in enumerate((2000, 10)):
            await recorder.carry_out(f"t-{number}", REQUEST)
            tracer.traces[number].outcome.set_result(recorded(samples, 1))
            await until(publisher, TracePhase.COMPLETE)
        keys = list(publisher.last)

    assert keys == ["ldcn/rig/tele/x/trace", "ldcn/rig/tele/x/trace/0"]
    assert (header(publisher).trace_id, header(publisher).samples) == ("t-1", 10)


async def test_a_bug_in_a_tracer_ends_its_trace_only():
    tracer = FakeTracer()
    async with recording(tracer) as (recorder, publisher):
        await recorder.carry_out("t-1", REQUEST)
        tracer.traces[0].outcome.set_exception(ZeroDivisionError())
        await until(publisher, TracePhase.FAILED)
        reply = await recorder.carry_out("t-2", REQUEST)

    assert reply.trace_id == "t-2"


async def test_an_abort_in_the_same_moment_as_the_arming_still_ends_the_trace():
    tracer = FakeTracer()
    async with recording(tracer) as (recorder, publisher):
        await recorder.carry_out("t-1", REQUEST)
        reply = await recorder.carry_out("t-2", AbortTrace())

        assert (reply.trace_id, header(publisher).phase) == ("t-1", TracePhase.ABORTED)


async def test_an_abort_that_takes_too_long_says_that_nobody_knows():
    tracer = FakeTracer()
    async with recording(tracer) as (recorder, publisher):
        await recorder.carry_out("t-1", REQUEST)
        tracer.traces[0].stubborn = True

        with pytest.raises(OutcomeUnknown, match="did not leave its trace"):
            await recorder.carry_out("t-2", AbortTrace())

        assert header(publisher).phase is TracePhase.RECORDING
