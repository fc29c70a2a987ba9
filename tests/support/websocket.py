"""A client of the Foxglove WebSocket protocol, as small as a test needs it.

Source: RFC 6455; only frames that are whole, and of less than 64 kB when sent.
"""

import asyncio
import json
import os
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

TEXT, BINARY = 1, 2
SHORT, LONG = 126, 127
MESSAGE_DATA = 1


class FoxgloveClient:
    """One connection; JSON both ways, and messages in binary."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    def send(self, operation: dict[str, Any]) -> None:
        """Send one operation."""
        data = json.dumps(operation).encode()
        mask = os.urandom(4)
        size = len(data)
        length = bytes([0x80 | size]) if size < SHORT else struct.pack(">BH", 0x80 | SHORT, size)
        masked = bytes(byte ^ mask[index % 4] for index, byte in enumerate(data))
        self._writer.write(bytes([0x80 | TEXT]) + length + mask + masked)

    async def operation(self, name: str) -> dict[str, Any]:
        """Return the next operation of that name; what comes before is passed over."""
        while True:
            kind, data = await self._frame()
            if kind == TEXT:
                operation: dict[str, Any] = json.loads(data)
                if operation["op"] == name:
                    return operation

    async def message(self) -> tuple[int, int, dict[str, Any]]:
        """Return channel, time in ns and content of the next message."""
        while True:
            kind, data = await self._frame()
            if kind == BINARY and data[0] == MESSAGE_DATA:
                channel, at_ns = struct.unpack_from("<IQ", data, 1)
                return channel, at_ns, json.loads(data[13:])

    async def _frame(self) -> tuple[int, bytes]:
        first, second = await self._reader.readexactly(2)
        length = second & 0x7F
        if length == SHORT:
            (length,) = struct.unpack(">H", await self._reader.readexactly(2))
        elif length == LONG:
            (length,) = struct.unpack(">Q", await self._reader.readexactly(8))
        return first & 0x0F, await self._reader.readexactly(length)


@asynccontextmanager
async def foxglove_client(port: int) -> AsyncIterator[FoxgloveClient]:
    """Connect to a server on the loopback interface."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        answer = await reader.readuntil(b"\r\n\r\n")
        assert answer.startswith(b"HTTP/1.1 101"), answer
        yield FoxgloveClient(reader, writer)
    finally:
        writer.close()
        await writer.wait_closed()
