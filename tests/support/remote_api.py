"""What zenoh-ts needs of a router's zenoh-plugin-remote-api, which no package registry has: queries and subscriptions.

The messages are those of zenoh-ts 1.10, `dist/message.js`; numbers are little-endian, and what has a length has it
before it, in base 128 (LEB128).
"""

import asyncio
import json
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from enum import IntEnum

import zenoh
from websockets.asyncio.server import ServerConnection, serve

PONG, OK, SAMPLE, REPLY, LAST_REPLY = 0, 1, 5, 7, 8


class Asked(IntEnum):
    """What a program wants; there is more."""

    DECLARE_SUBSCRIBER = 2
    UNDECLARE_SUBSCRIBER = 3
    GET = 18
    PING = 25


WITH_NUMBER = 0x80
"""In the first byte of a message that has a number: a request, or the response to it."""
MORE = 0x80
"""In a byte of a length: another one follows."""
ENCODINGS = (
    "zenoh/bytes",
    "zenoh/string",
    "zenoh/serialized",
    "application/octet-stream",
    "text/plain",
    "application/json",
)
"""By number; there are more."""
NOTHING_OF_A_SAMPLE = b"\x00\x00\x05"
"""No attachment, no time, quality of service 5: data."""


class Message:
    """A message, read from its beginning."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def take(self, count: int) -> bytes:
        """Return the next bytes."""
        self._at += count
        return self._data[self._at - count : self._at]

    def number(self, size: int) -> int:
        """Return a number of so many bytes."""
        return int.from_bytes(self.take(size), "little")

    def block(self) -> bytes:
        """Return bytes that have their length before them."""
        length, shift = 0, 0
        while True:
            byte = self.number(1)
            length |= (byte & 0x7F) << shift
            shift += 7
            if byte < MORE:
                return self.take(length)


def block(data: bytes) -> bytes:
    """Return bytes with their length before them."""
    length, said = len(data), b""
    while length >= MORE:
        said += bytes((length & 0x7F | MORE,))
        length >>= 7
    return said + bytes((length,)) + data


def encoded(encoding: zenoh.Encoding) -> bytes:
    """Return an encoding: the number of `zenoh/bytes`, and what it is called."""
    return struct.pack("<H", 0) + block(str(encoding).encode())


class Visitor:
    """One program that speaks through the bridge."""

    def __init__(self, session: zenoh.Session, socket: ServerConnection) -> None:
        self._session = session
        self._socket = socket
        self._loop = asyncio.get_running_loop()
        self._waiting = asyncio.Queue[bytes]()
        self._subscribers: dict[int, object] = {}

    def send(self, kind: int, content: bytes, number: int | None = None) -> None:
        """Send a message; may be called by a thread of Zenoh."""
        head = bytes((kind,)) if number is None else bytes((kind | WITH_NUMBER,)) + struct.pack("<I", number)
        self._loop.call_soon_threadsafe(self._waiting.put_nowait, head + content)

    async def deliver(self) -> None:
        """Send what waits, in its order, until cancelled."""
        while True:
            await self._socket.send(await self._waiting.get())

    def heed(self, data: bytes) -> None:
        """Do what a message wants."""
        message = Message(data)
        kind = message.number(1)
        number = message.number(4) if kind & WITH_NUMBER else None
        match Asked(kind & ~WITH_NUMBER):
            case Asked.PING:
                self.send(PONG, block(b"session"), number)
            case Asked.DECLARE_SUBSCRIBER:
                self._subscribe(message)
                self.send(OK, b"\x00", number)
            case Asked.UNDECLARE_SUBSCRIBER:
                del self._subscribers[message.number(4)]
                self.send(OK, b"\x00", number)
            case Asked.GET:
                self._get(message)

    def _subscribe(self, message: Message) -> None:
        name, key = message.number(4), message.block().decode()

        def deliver(sample: zenoh.Sample) -> None:
            self.send(SAMPLE, struct.pack("<I", name) + said(sample))

        self._subscribers[name] = self._session.declare_subscriber(key, deliver)

    def _get(self, message: Message) -> None:
        name, key, _ = message.number(4), message.block().decode(), message.block()
        payload = message.block() if message.number(1) else None
        encoding = (message.number(2), message.block().decode()) if message.number(1) else (0, "")
        head = struct.pack("<I", name)

        def deliver(reply: zenoh.Reply) -> None:
            if reply.ok:
                self.send(REPLY, head + b"\x01" + said(reply.ok))
            elif reply.err:
                error = block(reply.err.payload.to_bytes()) + encoded(reply.err.encoding)
                self.send(REPLY, head + b"\x00" + error)

        handler = zenoh.handlers.Callback(deliver, drop=lambda: self.send(LAST_REPLY, head))
        self._session.get(key, handler, payload=payload, encoding=zenoh.Encoding(ENCODINGS[encoding[0]]))


def said(sample: zenoh.Sample) -> bytes:
    """Return a sample as zenoh-ts reads it."""
    said = block(str(sample.key_expr).encode()) + block(sample.payload.to_bytes()) + b"\x00"
    return said + encoded(sample.encoding) + NOTHING_OF_A_SAMPLE


@asynccontextmanager
async def remote_api(endpoint: str) -> AsyncIterator[str]:
    """Let programs speak through a WebSocket with what is behind an endpoint; yields its locator for zenoh-ts."""
    config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}}))
    session = await asyncio.to_thread(zenoh.open, config)

    async def visit(socket: ServerConnection) -> None:
        visitor = Visitor(session, socket)
        delivery = asyncio.create_task(visitor.deliver())
        try:
            async for message in socket:
                visitor.heed(message if isinstance(message, bytes) else message.encode())
        finally:
            delivery.cancel()

    try:
        async with serve(visit, "127.0.0.1", 0) as server:
            yield f"ws/127.0.0.1:{next(iter(server.sockets)).getsockname()[1]}"
    finally:
        await asyncio.to_thread(session.close)
