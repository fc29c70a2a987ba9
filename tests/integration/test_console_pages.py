"""Open pages in front of a rig: what they see at once, what ends them, and that no page is another one's matter."""

import asyncio

import msgpack
import pytest

from ldcnd.console import reading
from ldcnd.console.feed import Feed
from ldcnd.contract.samples import AxisState
from tests.support.console_rig import open_page, page, running_console


@pytest.fixture
async def console():
    async with running_console() as running:
        yield running


async def told(socket):
    """Return what the next frame tells: path and sample."""
    _sent_ns, _dropped, entries = msgpack.unpackb(await socket.frame())
    return [(f"{rig}/{topic}", sample) for rig, topic, sample in entries]


async def test_a_page_sees_rig_health_and_axes_at_once(console):
    await asyncio.sleep(2)
    async with page(console.app, console.browser) as socket:
        first = dict(await told(socket))

    assert first["sim/rig"] == {"connected": True, "problem": None, "attention": "", "instance": "run1"}
    assert first["sim/meta/health/line0"]["up"] is True
    assert {f"sim/tele/{axis}/{item}" for axis in "xyzc" for item in ("position", "state", "fault")} <= first.keys()


async def test_a_page_sees_a_move_and_who_made_it(console):
    async with (
        page(console.app, console.browser, "?rate=20&stream=sim/x/position") as socket,
        open_page(console.app, console.browser) as mover,
    ):
        await mover.take("sim", "x")
        await mover.post("/api/rigs/sim/axes/x/power", {"on": True})
        await console.rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        moved = (await mover.post("/api/rigs/sim/axes/x/move_absolute", {"position": 2.0})).document
        seen = []
        async with asyncio.timeout(60):
            while not any(
                path.endswith("event") and sample["command_id"] == moved["command_id"] and sample["status"] == "done"
                for path, sample in seen
            ):
                seen += await told(socket)

    numbers = [sample["seq"] for path, sample in seen if path == "sim/tele/x/position"][1:]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert {sample["client"] for path, sample in seen if path.endswith("event")} == {mover.client}


async def test_a_page_that_says_anything_is_closed(console):
    async with page(console.app, console.browser) as socket:
        await socket.frame()
        socket.say("move")
        async with asyncio.timeout(60):
            while socket.closed is None:
                await asyncio.sleep(0.1)

    assert socket.closed == 1008


@pytest.mark.parametrize(("query", "status"), [("?rate=fast", 400), ("?rate=1000", 409), ("?stream=x", 400)])
async def test_a_subscription_that_cannot_be_met_is_refused_before_the_socket_opens(console, query, status):
    async with page(console.app, console.browser, query) as socket:
        pass

    assert (socket.status, socket.closed) == (status, None)


async def test_a_page_that_takes_nothing_for_long_is_given_up_and_leaves_nothing_behind(console, monkeypatch):
    opened = []
    open_page = Feed.open_page
    monkeypatch.setattr(reading, "SEND_TIME_S", 2.0)
    monkeypatch.setattr(
        Feed, "open_page", lambda feed, subscription: opened.append(feed) or open_page(feed, subscription)
    )
    async with page(console.app, console.browser) as socket:
        socket.stop_reading()
        await asyncio.sleep(5)
        channels = dict(opened[0]._channels)

    assert channels == {}


async def test_a_visitor_is_heard_of_as_long_as_a_page_is_open(console):
    visitor = console.visitors.find(console.browser.session)
    heard_at_s = visitor.seen_at_s
    async with page(console.app, console.browser):
        await asyncio.sleep(5)

    assert visitor.seen_at_s > heard_at_s + 3
