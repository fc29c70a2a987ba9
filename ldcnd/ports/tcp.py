"""The TCP address of a port: one program at a time, raw bytes, as a serial device server has them."""

import asyncio
from collections.abc import Callable
from typing import Protocol

from typing_extensions import override

from ldcnd.listen_address import ListenAddress
from ldcnd.log import get_logger

log = get_logger("ports")

MOST_UNREAD_BYTES = 65_536
"""Replies that a program does not read are lost beyond this, as on a line."""


class Door(Protocol):
    """Where a program comes in.

    Attributes:
        take: called with what it has sent, and the rate that it has set; None where that is not known.
        closed: called when it has gone.
    """

    take: Callable[[bytes, int | None], None]
    closed: Callable[[], None]

    def write(self, data: bytes) -> None:
        """Send to the program; what it does not read is lost."""


class GuestSocket:
    """A `Door` at an address; whoever comes while a program is connected is sent away."""

    def __init__(self) -> None:
        self.take: Callable[[bytes, int | None], None] = lambda _data, _baud: None
        self.closed: Callable[[], None] = lambda: None
        self._transport: asyncio.Transport | None = None

    async def listen(self, address: ListenAddress) -> asyncio.Server:
        """Listen there, and return the server; closing it sends the program away, too."""
        return await asyncio.get_running_loop().create_server(
            lambda: _Connection(self), address.host, address.port, backlog=1
        )

    def write(self, data: bytes) -> None:
        """Send to the program."""
        if self._transport and self._transport.get_write_buffer_size() < MOST_UNREAD_BYTES:
            self._transport.write(data)

    def close(self) -> None:
        """Send the program away."""
        if self._transport:
            self._transport.abort()

    def came(self, transport: asyncio.Transport) -> bool:
        """Let a program in, unless there is one."""
        if self._transport:
            log.warning("a second program was sent away", peer=str(transport.get_extra_info("peername")))
            return False
        self._transport = transport
        return True

    def left(self, transport: asyncio.BaseTransport | None) -> None:
        """A connection has ended."""
        if transport is not None and transport is self._transport:
            self._transport = None
            self.closed()


class _Connection(asyncio.Protocol):
    def __init__(self, door: GuestSocket) -> None:
        self._door = door
        self._transport: asyncio.BaseTransport | None = None

    @override
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if isinstance(transport, asyncio.Transport) and self._door.came(transport):
            self._transport = transport
        elif isinstance(transport, asyncio.Transport):
            transport.abort()

    @override
    def data_received(self, data: bytes) -> None:
        if self._transport:
            self._door.take(data, None)

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        self._door.left(self._transport)
