"""A TCP serial server (`socket://host:port`) as a byte pipe.

The far end owns the serial port, so its rate cannot be changed from here. A server that collects bytes before it sends
them costs that time at every exchange: switch it off there (ser2net: `chardelay: false`).
"""

import asyncio
import contextlib
import os
import socket
from typing import TypeVar

from typing_extensions import override

from ldcnd.contract.errors import NotSupported, TransportLost
from ldcnd.line.transport import Incoming, Receiver, Transport

CONNECT_TIME_S = 5.0
CLOSE_TIME_S = 1.0
UNACKNOWLEDGED_MS = 5000
"""Time without acknowledgement after which the far end is gone; without it the kernel tries for some 15 minutes."""
KEEPALIVE_S = 1
"""Time without traffic after which the kernel asks whether the far end is there, and again, seconds."""
BACKLOG_BYTES = 4096
"""More than this unsent means that the far end takes nothing; some dozens of exchanges have timed out by then."""
READ_BYTES = 4096
LONGEST_DISCARD = 64
"""Reads after which a flood is left to the receiver."""


def watch_far_end(end: socket.socket) -> None:
    """Have the kernel find within seconds that the host at the far end is gone, and did not say so."""
    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNACKNOWLEDGED_MS)
    end.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, KEEPALIVE_S)
    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, KEEPALIVE_S)


IncomingT = TypeVar("IncomingT", bound=Incoming)


async def open_tcp_port(host: str, port: int, connect_timeout_s: float = CONNECT_TIME_S) -> Transport:
    """Connect to a serial server.

    Raises:
        TransportLost: the name is unknown, or there is no answer in time.
    """
    return TcpPort(*await connected(Incoming(address("socket", host, port)), host, port, connect_timeout_s))


def address(scheme: str, host: str, port: int) -> str:
    """Return the name of a port at a serial server."""
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"


async def connected(
    incoming: IncomingT, host: str, port: int, connect_timeout_s: float
) -> tuple[asyncio.Transport, IncomingT]:
    """Connect; return the stream, and what it delivers to.

    Raises:
        TransportLost: the name is unknown, or there is no answer in time.
    """
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(connect_timeout_s):
            return await loop.create_connection(lambda: incoming, host, port)
    except TimeoutError as error:
        raise unreachable(incoming.name, f"no answer within {connect_timeout_s:g} s") from error
    except (OSError, OverflowError) as error:
        raise unreachable(incoming.name, str(error)) from error


class TcpPort(Transport):
    """An open connection to a serial server."""

    fixed_baud = True

    def __init__(self, stream: asyncio.Transport, incoming: Incoming) -> None:
        self._stream = stream
        self._incoming = incoming
        end = stream.get_extra_info("socket")
        # otherwise a request waits for the acknowledgement of the bytes before it
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        watch_far_end(end)
        self._descriptor: int = end.fileno()

    @override
    def attach(self, receiver: Receiver) -> None:
        self.discard_input()
        self._incoming.attach(receiver)

    @override
    def write(self, data: bytes) -> None:
        # asyncio drops what is written to a stream that is closing, without an error
        if self._incoming.reason or self._stream.is_closing():
            raise self._incoming.lost("the far end closed it")
        self._stream.write(data)
        backlog = self._stream.get_write_buffer_size()
        if backlog > BACKLOG_BYTES:
            error = self._incoming.lost(f"{backlog} bytes wait to be taken")
            self._stream.abort()
            raise error

    def expect(self, reply_bytes: int) -> None:
        """Ignore the hint: a stream has no such threshold worth a system call."""

    @override
    def discard_input(self) -> None:
        if self._incoming.reason:
            return
        # nothing more to read ends it; the end of the stream stays readable, so the loop still reports it
        with contextlib.suppress(OSError):
            for _ in range(LONGEST_DISCARD):
                if not (dropped := os.read(self._descriptor, READ_BYTES)):
                    return
                self._incoming.drop(dropped)

    def set_baud(self, baud: int) -> None:
        """Refuse: only the far end can.

        Raises:
            NotSupported: always.
        """
        raise NotSupported(f"a serial server keeps its own rate, {baud} baud cannot be set from here", value=baud)

    async def close(self) -> None:
        """See `Transport`; what was written still leaves, for at most `CLOSE_TIME_S`."""
        self._incoming.detach()
        self._stream.close()
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_TIME_S):
                    await self._incoming.ended.wait()
        finally:
            self._stream.abort()
        await self._incoming.ended.wait()


def unreachable(
    name: str, why: str, remedy: str = "check the serial server's address, its power and the network"
) -> TransportLost:
    """Return why a serial server cannot be used, as an error."""
    return TransportLost(f"{name} cannot be opened: {why}; {remedy}", value=name, remedy=remedy)
