"""The TCP address of a port: one program at a time, raw bytes or RFC 2217, as serial device servers have them."""

import asyncio
import select
from collections.abc import Callable, Iterable
from typing import cast

import serial
from serial.rfc2217 import PortManager, Serial
from typing_extensions import override

from ldcnd.line.tcp_port import watch_far_end
from ldcnd.listen_address import ListenAddress
from ldcnd.log import get_logger
from ldcnd.ports.door import FLOOD_PAUSE_S

log = get_logger("ports")

MOST_UNREAD_BYTES = 65_536
"""Replies that a program does not read are lost beyond this, as on a line."""


class GuestSocket:
    """A `Door` at an address; a second program is refused while one is connected."""

    def __init__(self, *, rfc2217: bool) -> None:
        self.take: Callable[[bytes, int | None], int] = lambda data, _baud: len(data)
        self.closed: Callable[[bytes, int | None], None] = lambda _data, _baud: None
        self._rfc2217 = rfc2217
        self._inside: _Connection | None = None
        self._left = b""

    async def listen(self, address: ListenAddress) -> asyncio.Server:
        """Listen there, and return the server; closing it does not disconnect the program."""
        make = _Rfc2217Connection if self._rfc2217 else _Connection
        return await asyncio.get_running_loop().create_server(lambda: make(self), address.host, address.port, backlog=1)

    def write(self, data: bytes) -> None:
        """Send to the program."""
        if self._inside:
            self._inside.write(self._inside.as_sent(data))

    def leave(self) -> None:
        """Disconnect the program."""
        if self._inside:
            self._inside.transport.abort()

    def enter(self, connection: "_Connection") -> None:
        """Let a program in, unless there is one."""
        if self._inside:
            peer = str(connection.transport.get_extra_info("peername"))
            log.warning("a second program was refused: one is connected already", peer=peer)
            connection.transport.abort()
        else:
            self._inside = connection
            connection.begin()

    def received(self, connection: "_Connection", data: bytes) -> None:
        """Take what a program has sent."""
        if connection is not self._inside:
            return
        data, self._left = self._left + data, b""
        if connection.hung_up():  # what it has sent last begins nothing
            self._left = data[-MOST_UNREAD_BYTES:]
            connection.transport.resume_reading()  # up to its end
        elif data:
            self._left = data[self.take(data, connection.baud) :]
            if self._left:
                connection.transport.pause_reading()
                asyncio.get_running_loop().call_later(FLOOD_PAUSE_S, self.received, connection, b"")
            else:
                connection.transport.resume_reading()

    def left(self, connection: "_Connection") -> None:
        """A connection has ended."""
        if connection is self._inside:
            self._inside, left, self._left = None, self._left, b""
            self.closed(left, connection.baud)


class _Connection(asyncio.Protocol):
    """A program that sends raw bytes: it has no rate of its own, a server beside the drives has that of the drives."""

    transport: asyncio.Transport
    baud: int | None = None

    def __init__(self, door: GuestSocket) -> None:
        self._door = door

    def begin(self) -> None:
        """The program is let in."""

    def hung_up(self) -> bool:
        """Tell whether the program has closed its side, or has ended."""
        poll = select.poll()
        poll.register(self.transport.get_extra_info("socket"), select.POLLRDHUP)
        return bool(poll.poll(0))

    def write(self, data: bytes) -> None:
        """Send to the program."""
        if self.transport.get_write_buffer_size() < MOST_UNREAD_BYTES:
            self.transport.write(data)

    def as_sent(self, data: bytes) -> bytes:
        """Return replies as they go over the connection."""
        return data

    def received(self, data: bytes) -> bytes:
        """Return what is for the modules of what came over the connection."""
        return data

    @override
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if not isinstance(transport, asyncio.Transport):
            raise TypeError("a TCP connection can be written to")
        self.transport = transport
        watch_far_end(transport.get_extra_info("socket"))  # or its place stays taken
        self._door.enter(self)

    @override
    def data_received(self, data: bytes) -> None:
        self._door.received(self, self.received(data))

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        self._door.left(self)


class _Settings:
    """The serial settings of a program, as `PortManager` reads and writes them: kept, and the rate is heeded."""

    bytesize, parity, stopbits = serial.EIGHTBITS, serial.PARITY_NONE, serial.STOPBITS_ONE
    xonxoff = rtscts = break_condition = ri = False
    dtr = rts = cts = dsr = cd = True

    def __init__(self) -> None:
        self.baudrate = 19_200

    def reset_input_buffer(self) -> None:
        """Replies are sent at once: none waits here."""

    def reset_output_buffer(self) -> None:
        """What is written is taken at once: none waits here."""


class _Rfc2217Connection(_Connection):
    """A program that sets its rate over the connection, too."""

    @override
    def begin(self) -> None:
        self._settings = _Settings()
        self._manager = PortManager(cast("Serial", self._settings), cast("Serial", self))

    @override
    def as_sent(self, data: bytes) -> bytes:
        return _joined(self._manager.escape(data))

    @override
    def received(self, data: bytes) -> bytes:
        found = _joined(self._manager.filter(data))
        self.baud = self._settings.baudrate
        return found


def _joined(pieces: Iterable[bytes]) -> bytes:
    return b"".join(pieces)
