import asyncio
import select
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from ldcnd.contract.errors import ConfigError, NotSupported, TransportLost
from ldcnd.line.port_url import port_opener
from ldcnd.line.tcp_port import BACKLOG_BYTES, TcpPort, open_tcp_port
from ldcnd.line.transport import Transport
from tests.support.recording_receiver import RecordingReceiver

pytestmark = pytest.mark.real_time

WAIT_S = 5.0


class FarEnd:
    """A serial server with one client."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self.number: int = listener.getsockname()[1]
        self.client: socket.socket | None = None

    async def accept(self) -> socket.socket:
        async with asyncio.timeout(WAIT_S):
            self.client, _ = await asyncio.get_running_loop().sock_accept(self._listener)
        self.client.settimeout(0)
        return self.client

    async def read(self) -> bytes:
        async with asyncio.timeout(WAIT_S):
            return await asyncio.get_running_loop().sock_recv(self.client, 4096)

    def close(self) -> None:
        self._listener.close()
        if self.client:
            self.client.close()


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.fixture
async def far() -> AsyncIterator[FarEnd]:
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(0)
    end = FarEnd(listener)
    yield end
    end.close()


@pytest.fixture
async def port(far: FarEnd) -> AsyncIterator[Transport]:
    opened = await open_tcp_port("127.0.0.1", far.number, 5.0)
    await far.accept()
    yield opened
    await opened.close()


async def test_bytes_go_both_ways(far: FarEnd, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)

    port.write(b"\xaa\x00\x0d")
    sent = await far.read()
    far.client.send(b"\x01\x0a")
    await receiver.wait_for(2)

    assert sent == b"\xaa\x00\x0d"
    assert receiver.data == b"\x01\x0a"


async def test_small_packets_are_not_held_back(port: Transport):
    assert isinstance(port, TcpPort)
    end = port._stream.get_extra_info("socket")

    assert end.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    assert end.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 5000


async def test_the_rate_is_the_far_ends_own(port: Transport):
    assert port.fixed_baud
    with pytest.raises(NotSupported, match="9600"):
        port.set_baud(9600)


async def test_a_far_end_that_hangs_up_is_reported_once(far: FarEnd, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)

    far.client.close()
    await receiver.wait_lost()
    with pytest.raises(TransportLost, match=str(far.number)):
        port.write(b"\xaa")
    await port.close()

    assert len(receiver.losses) == 1
    assert str(far.number) in receiver.losses[0]


async def test_why_a_server_hangs_up_is_said_in_its_words(far: FarEnd):
    opened = await open_tcp_port("127.0.0.1", far.number, 5.0)
    client, receiver = await far.accept(), RecordingReceiver()
    client.send(b"Port already in use\r\n")
    await asyncio.sleep(0.05)
    opened.attach(receiver)  # drops what has come
    client.close()
    await receiver.wait_lost()

    assert "saying 'Port already in use'" in receiver.losses[0]
    await opened.close()


async def test_replies_of_drives_are_not_taken_for_words(far: FarEnd, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)
    far.client.send(b"\x79\x79\x01")
    await receiver.wait_for(3)
    far.client.close()
    await receiver.wait_lost()

    assert "saying" not in receiver.losses[0]


async def test_a_reset_connection_is_reported_once(far: FarEnd, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)
    far.client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")

    far.client.close()
    await receiver.wait_lost()

    assert len(receiver.losses) == 1


async def test_a_far_end_that_takes_nothing_is_lost(far: FarEnd, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)

    with pytest.raises(TransportLost, match="wait to be taken"):
        _flood(port)
    await receiver.wait_lost()

    assert len(receiver.losses) == 1


async def test_discarding_drops_what_waits(far: FarEnd, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)
    far.client.send(b"late")
    _wait_readable(port)

    port.discard_input()
    far.client.send(b"next")
    await receiver.wait_for(4)

    assert receiver.data == b"next"


async def test_discarding_at_the_end_of_the_stream_hides_no_loss(far: FarEnd, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)
    far.client.send(b"late")
    far.client.close()
    _wait_readable(port)

    port.discard_input()
    await receiver.wait_lost()

    assert len(receiver.losses) == 1


async def test_closing_is_not_a_loss_and_keeps_no_descriptor(far: FarEnd):
    before = descriptors()
    port = await open_tcp_port("127.0.0.1", far.number, 5.0)
    receiver = RecordingReceiver()
    port.attach(receiver)

    await port.close()
    await port.close()

    assert receiver.losses == []
    assert descriptors() == before


async def test_closing_does_not_wait_for_a_far_end_that_takes_nothing(far: FarEnd, port: Transport):
    port.attach(RecordingReceiver())
    while not port._stream.get_write_buffer_size():
        port.write(bytes(1024))

    async with asyncio.timeout(2.0):
        await port.close()

    with pytest.raises(TransportLost, match="closed"):
        port.write(b"\xaa")


async def test_nobody_there_is_explained(far: FarEnd):
    far.close()

    with pytest.raises(TransportLost, match=f"{far.number} cannot be opened") as refused:
        await open_tcp_port("127.0.0.1", far.number, 5.0)

    assert refused.value.remedy


async def test_a_port_is_a_path_or_a_socket(far: FarEnd):
    opened = await port_opener(f"socket://127.0.0.1:{far.number}", 115_200)()
    await opened.close()

    with pytest.raises(TransportLost, match="no such device"):
        await port_opener("/dev/does-not-exist", 115_200)()
    servers = (
        "socket://",
        "socket://host",
        "socket://host:x",
        "socket://host:70000",
        "rfc2217://host",
        "socket://h:1/x",
    )
    for wrong in ("ttyS0", *servers, "hwgrep://*", "sim:one"):
        with pytest.raises(ConfigError, match="is not a device path"):
            port_opener(wrong, 115_200)


def _flood(port: Transport) -> None:
    for _ in range(100_000):
        port.write(bytes(BACKLOG_BYTES))


def _wait_readable(port: Transport) -> None:
    """Wait until bytes lie in the socket, without a turn of the loop that would deliver them."""
    assert select.select([port._stream.get_extra_info("socket").fileno()], [], [], WAIT_S)[0]
