"""Two sessions that meet, and how a test waits for them."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from ldcnd.contract.codec import Encoding, decode
from ldcnd.contract.commands import ErrorReply
from ldcnd.contract.keys import Keys
from ldcnd.net.hand_over import Answer, Query
from ldcnd.net.session import Publication, Qos, Session
from tests.support.process import free_port

KEYS = Keys("bench1")
JSON = Encoding.JSON.value
HALT = KEYS.command("x", "halt")
POSITION = KEYS.telemetry("x", "position")


@dataclass(frozen=True, slots=True)
class Pair:
    """A daemon's session and a client's."""

    server: Session
    client: Session


def free_endpoint() -> str:
    """Return a Zenoh endpoint on a TCP port that nobody else gets."""
    return f"tcp/127.0.0.1:{free_port()}"


async def until(ready: Callable[[], Awaitable[bool]]) -> None:
    """Try again until it is so: what is declared takes a moment to be known on the other side."""
    async with asyncio.timeout(5):
        while not await ready():
            await asyncio.sleep(0.01)


async def served(client: Session, key: str) -> None:
    """Wait until the key has somebody who answers."""

    async def ready() -> bool:
        return bool(await client.query(key))

    await until(ready)


async def subscribed(publisher: Session, subscriber: Session) -> "asyncio.Queue[Publication]":
    """Subscribe to everything, and return when what is published arrives; the first samples are not kept."""
    samples: asyncio.Queue[Publication] = asyncio.Queue()
    probe = KEYS.telemetry("probe", "state")
    await subscriber.subscribe("ldcn/**", samples.put_nowait)

    async def ready() -> bool:
        publisher.publish(probe, b"probe", encoding=JSON, qos=Qos.EVENT)
        await asyncio.sleep(0.01)
        return not samples.empty()

    await until(ready)
    publisher.publish(probe, b"last", encoding=JSON, qos=Qos.EVENT)
    while (await samples.get()).payload != b"last":
        pass
    return samples


def echo(query: Query) -> None:
    """Answer with what was sent."""
    query.reply(query.payload or b"none", query.encoding or JSON)


def error_of(answers: list[Answer]) -> ErrorReply:
    """Return what the one answer, an error, says."""
    (answer,) = answers
    assert answer.is_error
    return decode(ErrorReply, answer.payload, answer.encoding)
