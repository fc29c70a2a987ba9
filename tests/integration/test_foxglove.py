"""A running rig in the Foxglove app, seen by a client of its protocol."""

import asyncio
import re
import signal
from asyncio.subprocess import PIPE

import pytest

from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.events import CommandEvent, CommandStatus
from ldcnd.contract.samples import PositionSample
from ldcnd.lab.recording.live_view import LiveView
from ldcnd.net.session import Publication, SampleKind
from tests.support.process import LDCND, ROOT, daemon
from tests.support.websocket import foxglove_client

pytestmark = [pytest.mark.system, pytest.mark.real_time]
T_NS = 1_700_000_000_000_000_000
POSITION = PositionSample(
    t=T_NS, t_error_ns=0, seq=0, quality="good", value=1.5, unit="mm", counts=1500, following_error=None
)
EVENT = CommandEvent(
    t=T_NS,
    seq=0,
    run="r",
    number=0,
    axis="x",
    command_id="a-1",
    verb="halt",
    client="ann",
    status=CommandStatus.FAILED,
    reason="mute",
)


def published(item, model):
    return Publication(f"ldcn/sim/tele/x/{item}", *encode(model, Encoding.JSON), SampleKind.PUT, model.t)


@pytest.mark.parametrize(
    ("item", "model", "schema"),
    [("position", POSITION, "ldcnd.PositionSample"), ("event", EVENT, "foxglove.Log")],
)
async def test_a_topic_is_shown_to_those_who_subscribe_to_it(item, model, schema):
    with LiveView("rig", "127.0.0.1", 0) as view:
        view.take(published(item, model))
        async with asyncio.timeout(20), foxglove_client(view.port) as app:
            (channel,) = (await app.operation("advertise"))["channels"]
            app.send({"op": "subscribe", "subscriptions": [{"id": 5, "channelId": channel["id"]}]})
            message = await shown(view, app, published(item, model))

    assert (channel["topic"], channel["encoding"]) == (f"/ldcn/sim/tele/x/{item}", "json")
    assert (channel["schemaName"], channel["schemaEncoding"]) == (schema, "jsonschema")
    assert message[:2] == (5, T_NS)
    content = message[2]
    assert content.get("event", content) == model.model_dump(mode="json")
    assert content.get("level", 4) == 4


async def shown(view, app, sample):
    """Publish until the subscription, of which nobody tells, is in force."""
    coming = asyncio.ensure_future(app.message())
    while not coming.done():
        view.take(sample)
        await asyncio.wait([coming], timeout=0.05)
    return coming.result()


async def test_an_app_can_publish_nothing():
    with LiveView("rig", "127.0.0.1", 0) as view:
        async with asyncio.timeout(20), foxglove_client(view.port) as app:
            info = await app.operation("serverInfo")
            channel = {"id": 1, "topic": "/ldcn/sim/@cmd/x/halt", "encoding": "json", "schemaName": ""}
            app.send({"op": "advertise", "channels": [channel]})
            refused = await app.operation("status")

    assert info["capabilities"] == []
    assert "does not support clientPublish" in refused["message"]


async def test_an_address_that_is_taken_is_told():
    with LiveView("rig", "127.0.0.1", 0) as view:
        with pytest.raises(ConfigError, match=f"cannot serve on 127.0.0.1:{view.port}"):
            LiveView("rig", "127.0.0.1", view.port)


@pytest.mark.timeout(120)
async def test_a_daemon_is_shown_by_a_process_of_its_own():
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        address = ("--address", "127.0.0.1:0")
        serving = await asyncio.create_subprocess_exec(*LDCND, "foxglove", "-e", endpoint, *address, stdout=PIPE)
        assert serving.stdout
        async with asyncio.timeout(45):
            told = (await serving.stdout.readline()).decode()
            topics = set()
            async with foxglove_client(int(re.search(r":(\d+)$", told)[1])) as app:
                while not {"/ldcn/sim/tele/x/position", "/ldcn/sim/meta/health"} <= topics:
                    topics |= {channel["topic"] for channel in (await app.operation("advertise"))["channels"]}
            serving.send_signal(signal.SIGTERM)
            code = await serving.wait()

    assert code == 0
