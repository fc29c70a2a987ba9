"""What pages are told of values: everything at first, then what changes, and nothing is waited for."""

import asyncio
import json
from contextlib import asynccontextmanager
from itertools import pairwise

import msgpack
import pytest

from ldcnd.console.feed import MOST_PAGES, Feed, parse_subscription
from ldcnd.console.latest_values import LatestValues
from ldcnd.contract.errors import MalformedRequest, TooManyRequests, ValueOutOfRange
from ldcnd.net.session import Publication, SampleKind

MSGPACK, JSON = "application/msgpack;position_sample", "application/json"


def published(key, encoding=MSGPACK, **sample):
    payload = msgpack.packb(sample) if encoding == MSGPACK else json.dumps(sample).encode()
    return Publication(f"ldcn/{key}", payload, encoding, SampleKind.PUT, None)


def deleted(key):
    return Publication(f"ldcn/{key}", b"", "", SampleKind.DELETE, None)


class Rig:
    """Values, and pages that look at them."""

    def __init__(self, values, feed):
        self.values = values
        self.feed = feed

    def publish(self, key, **sample):
        self.values.take(published(key, **sample))

    @asynccontextmanager
    async def page(self, rigs="", rate="", stream=""):
        with self.feed.open_page(parse_subscription(rigs, rate, stream)) as page:
            frames = page.frames()
            try:
                yield page, frames
            finally:
                await frames.aclose()


@pytest.fixture
async def rig():
    values = LatestValues()
    loop = asyncio.get_running_loop()
    async with Feed(values, lambda: round(loop.time() * 1e9)) as feed:
        yield Rig(values, feed)


async def told(frames):
    """Return what the next frame tells: path and sample."""
    async with asyncio.timeout(30):
        _sent_ns, _dropped, entries = msgpack.unpackb(await anext(frames))
    return [(f"{rig}/{topic}", sample) for rig, topic, sample in entries]


async def test_a_page_is_told_every_value_at_first_and_then_what_has_changed(rig):
    rig.publish("sim/tele/x/position", value=1)
    rig.publish("sim/meta/health/line0", up=True)

    async with rig.page() as (_, frames):
        first = await told(frames)
        rig.publish("sim/tele/x/position", value=2)
        rig.publish("sim/tele/x/position", value=3)
        second = await told(frames)

    assert sorted(first) == [("sim/meta/health/line0", {"up": True}), ("sim/tele/x/position", {"value": 1})]
    assert second == [("sim/tele/x/position", {"value": 3})]


async def test_frames_come_at_the_rate_that_was_asked_for(rig):
    loop = asyncio.get_running_loop()
    async with rig.page(rate="5") as (_, frames):
        await told(frames)
        at_s = []
        for number in range(10):
            rig.publish("sim/tele/x/position", value=number)
            await told(frames)
            at_s.append(loop.time())

    assert [round(later - sooner, 6) for sooner, later in pairwise(at_s)] == [0.2] * 9


async def test_an_empty_frame_twice_a_second_shows_that_the_console_lives(rig):
    loop = asyncio.get_running_loop()
    async with rig.page() as (_, frames):
        await told(frames)
        nothing = [await told(frames) for _ in range(3)]

    assert nothing == [[], [], []]
    assert loop.time() == pytest.approx(1.5, abs=0.3)


async def test_a_stream_tells_every_sample_in_order_and_once(rig):
    async with rig.page(stream="sim/x/position") as (_, frames):
        await told(frames)
        for number in range(5):
            rig.publish("sim/tele/x/position", value=number)
            rig.publish("sim/tele/y/position", value=number)
        stream = await told(frames)
        await asyncio.sleep(0.2)
        latest = await told(frames)

    assert [sample["value"] for path, sample in stream if path == "sim/tele/x/position"] == [0, 1, 2, 3, 4]
    assert [entry for entry in stream + latest if entry[0] == "sim/tele/y/position"] == [
        ("sim/tele/y/position", {"value": 4})
    ]


async def test_every_event_is_told_but_none_of_before(rig):
    rig.publish("sim/tele/x/event", seq=0)
    async with rig.page() as (_, frames):
        first = await told(frames)
        for seq in range(1, 4):
            rig.publish("sim/tele/x/event", seq=seq)
        news = await told(frames)

    assert first == []
    assert [sample["seq"] for _, sample in news] == [1, 2, 3]


async def test_a_page_sees_the_rigs_that_it_asked_for(rig):
    async with rig.page(rigs="one,two") as (_, frames):
        await told(frames)
        for name in ("one", "two", "three"):
            rig.publish(f"{name}/tele/x/position", value=0)
            rig.publish(f"{name}/tele/x/event", seq=0)
        entries = await told(frames)

    assert {path.partition("/")[0] for path, _ in entries} == {"one", "two"}


async def test_a_key_that_is_gone_is_told_as_nothing_and_forgotten(rig):
    rig.publish("sim/tele/x/position", value=1)
    async with rig.page() as (_, frames):
        await told(frames)
        rig.values.take(deleted("sim/tele/x/position"))
        gone = await told(frames)
    async with rig.page() as (_, frames):
        afterwards = await told(frames)

    assert gone == [("sim/tele/x/position", None)]
    assert afterwards == []


async def test_samples_of_traces_are_not_told_but_how_far_a_trace_is(rig):
    rig.publish("sim/tele/x/trace", phase="complete")
    rig.publish("sim/tele/x/trace/0", values=[1, 2, 3])
    rig.publish("sim/tele/x/monitor/torque", value=5)

    async with rig.page() as (_, frames):
        entries = await told(frames)

    assert {path for path, _ in entries} == {"sim/tele/x/trace", "sim/tele/x/monitor/torque"}


async def test_a_rig_that_publishes_json_looks_alike(rig):
    rig.publish("sim/tele/x/position", encoding=JSON, value=1.5, unit="mm")

    async with rig.page() as (_, frames):
        assert await told(frames) == [("sim/tele/x/position", {"value": 1.5, "unit": "mm"})]


@pytest.mark.parametrize(
    ("payload", "encoding"), [(b"", MSGPACK), (b"\xc1", MSGPACK), (b"\x01", MSGPACK), (b"{", JSON), (b"[1]", JSON)]
)
async def test_what_is_no_model_is_left_out(rig, payload, encoding):
    rig.values.take(Publication("ldcn/sim/tele/x/position", payload, encoding, SampleKind.PUT, None))
    rig.values.take(Publication("ldcn/sim/tele/x/event", payload, encoding, SampleKind.PUT, None))

    async with rig.page() as (_, frames):
        assert await told(frames) == []


async def test_a_page_that_does_not_read_loses_no_latest_value_and_no_event_but_streams(rig):
    async with rig.page(stream="sim/x/position") as (page, frames), rig.page() as (other, other_frames):
        await told(frames)
        seen = []
        for number in range(100):
            rig.publish("sim/tele/x/position", value=number)
            rig.publish(f"sim/tele/y{number % 10}/position", value=number)
            if number % 10 == 0:
                rig.publish("sim/tele/x/event", seq=number)
            await asyncio.sleep(0.05)
            if number % 5 == 4:
                seen += await told(other_frames)
        late = await told(frames)

    assert dict(late) | {"sim/tele/x/event": None} == {
        f"sim/tele/y{number % 10}/position": {"value": number} for number in range(90, 100)
    } | {"sim/tele/x/position": {"value": 99}, "sim/tele/x/event": None}
    assert [sample["seq"] for path, sample in late if path.endswith("event")] == list(range(0, 100, 10))
    streamed = [sample["value"] for path, sample in late if path == "sim/tele/x/position"]
    assert streamed == list(range(100))[-len(streamed) :]
    assert len(streamed) < 50
    assert page.dropped > 50
    assert other.dropped == 0
    assert seen


async def test_values_never_go_back_on_a_page_that_reads_now_and_then(rig):
    loop = asyncio.get_running_loop()
    async with rig.page(rate="60") as (_, quick), rig.page(rate="60") as (_, slow):
        values = []
        for number in range(300):
            rig.publish("sim/tele/x/position", value=number)
            await asyncio.sleep(0.01)
            if number % 2:
                await told(quick)
            if number % 37 == 0:
                values += [sample["value"] for _, sample in await told(slow)]

    assert values == sorted(values)
    assert len(values) >= 8
    assert loop.time() < 60


async def test_pages_with_the_same_subscription_share_the_work(rig):
    encoded = []
    entry = rig.values.entry
    rig.values.entry = lambda name: encoded.append(name) or entry(name)
    async with rig.page() as (_, one), rig.page() as (_, other):
        await told(one)
        await told(other)
        rig.publish("sim/tele/x/position", value=1)
        seen = (await told(one), await told(other))

    assert seen[0] == seen[1] == [("sim/tele/x/position", {"value": 1})]
    assert encoded == ["sim/tele/x/position"]
    assert rig.values.watchers == []


async def test_values_of_a_rig_that_comes_back_are_put_in_order(rig):
    for axis in "xyz":
        rig.publish(f"sim/tele/{axis}/position", value=1)
    rig.publish("other/tele/x/position", value=1)
    rig.values.tell_of_rig("sim", {"connected": False, "problem": "away"})
    async with rig.page() as (_, frames):
        await told(frames)
        rig.values.begin_again("sim")
        rig.publish("sim/tele/x/position", value=3)
        rig.values.settle("sim", [published(f"sim/tele/{axis}/position", value=2) for axis in "xy"])
        news = dict(await told(frames))

    assert news == {
        "sim/tele/x/position": {"value": 3},  # newer than the answer
        "sim/tele/y/position": {"value": 2},
        "sim/tele/z/position": None,
    }


async def test_there_is_a_limit_to_pages_and_it_is_told(rig):
    subscription = parse_subscription("", "", "")
    opened = [rig.feed.open_page(subscription) for _ in range(MOST_PAGES)]
    for one in opened:
        one.__enter__()

    with pytest.raises(TooManyRequests, match="pages are open"):
        rig.feed.open_page(subscription).__enter__()

    opened.pop().__exit__(None, None, None)
    with rig.feed.open_page(subscription):
        pass
    for one in opened:
        one.__exit__(None, None, None)


@pytest.mark.parametrize("rate", ["0", "0.5", "61", "inf", "nan", "-1"])
def test_a_rate_that_is_not_served_is_refused(rate):
    with pytest.raises(ValueOutOfRange, match="1 to 60"):
        parse_subscription("", rate, "")


@pytest.mark.parametrize(("rate", "stream"), [("fast", ""), ("", "sim/x"), ("", "position")])
def test_a_subscription_that_cannot_be_read_is_refused(rate, stream):
    with pytest.raises(MalformedRequest):
        parse_subscription("", rate, stream)


def test_too_many_streams_are_refused():
    with pytest.raises(ValueOutOfRange, match="streams"):
        parse_subscription("", "", ",".join(f"sim/a{number}/position" for number in range(65)))
