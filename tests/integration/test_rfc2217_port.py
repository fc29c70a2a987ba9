"""A serial server whose port is set over the connection: the server is pyserial's, or one that misbehaves."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from ldcnd.bench.begun import scan_port
from ldcnd.bench.known import BENCHES
from ldcnd.contract.errors import TransportLost
from ldcnd.drives.ldcn.registers import RESET_BAUD
from ldcnd.line.port_url import port_opener
from ldcnd.line.transport import Transport
from ldcnd.listen_address import ListenAddress
from ldcnd.ports.tcp import GuestSocket
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.line import open_simulated_line
from tests.support.process import free_port
from tests.support.recording_receiver import RecordingReceiver

pytestmark = pytest.mark.real_time

IAC, SB, SE, COM_PORT, RATE = 255, 250, 240, 44, 1
AGREES = bytes((IAC, 253, COM_PORT))
EVERY_BYTE = bytes(range(256))


@asynccontextmanager
async def server(take: Callable[[bytes, int | None], int]) -> AsyncIterator[tuple[GuestSocket, str]]:
    """Serve one port by pyserial's half of RFC 2217; yields it and its URL."""
    door, number = GuestSocket(rfc2217=True), free_port()
    door.take = take
    listening = await door.listen(ListenAddress("127.0.0.1", number))
    try:
        yield door, f"rfc2217://127.0.0.1:{number}"
    finally:
        listening.close()
        door.leave()


@asynccontextmanager
async def scripted(answer: Callable[[int, int], bytes], greeting: bytes = AGREES) -> AsyncIterator[str]:
    """Serve a port that answers each setting with what `answer` returns for it and its value; yields its URL."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(greeting)
        while received := await reader.read(1000):
            for part in received.split(bytes((IAC, SB, COM_PORT)))[1:]:
                said = answer(part[0], int.from_bytes(part[1 : part.rindex(bytes((IAC, SE)))], "big"))
                for byte in said:  # the network cuts where it likes
                    writer.write(bytes((byte,)))
                    await writer.drain()
        writer.close()

    listening = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with listening:
        yield f"rfc2217://127.0.0.1:{listening.sockets[0].getsockname()[1]}"


def answered(setting: int, value: int) -> bytes:
    width = 4 if setting == RATE else 1
    said = value.to_bytes(width, "big").replace(b"\xff", b"\xff\xff")
    return bytes((IAC, SB, COM_PORT, setting + 100)) + said + bytes((IAC, SE))


def up_to_115200(setting: int, value: int) -> bytes:
    return answered(setting, min(value, 115_200) if setting == RATE else value)


async def opened(url: str, baud: int = 19_200, working_baud: int | None = None) -> Transport:
    return await port_opener(url, baud, working_baud=working_baud)()


async def taken(heard: list[tuple[bytes, int | None]], count: int) -> None:
    async with asyncio.timeout(5):
        while sum(len(data) for data, _ in heard) < count:
            await asyncio.sleep(0.01)


async def test_every_byte_goes_both_ways_at_the_rate_that_is_set():
    heard: list[tuple[bytes, int | None]] = []

    def take(data: bytes, baud: int | None) -> int:
        heard.append((data, baud))
        return len(data)

    async with server(take) as (door, url):
        port, receiver = await opened(url), RecordingReceiver()
        port.attach(receiver)
        assert not port.fixed_baud
        port.write(EVERY_BYTE)
        await taken(heard, 256)
        port.set_baud(115_200)
        port.write(b"\xaa\x00\xff\xff\xf0")
        door.write(EVERY_BYTE)
        await receiver.wait_for(256)
        await taken(heard, 261)
        await port.close()

    assert receiver.data == EVERY_BYTE
    assert b"".join(data for data, _ in heard) == EVERY_BYTE + b"\xaa\x00\xff\xff\xf0"
    assert (heard[0][1], heard[-1][1]) == (19_200, 115_200)


async def test_a_server_whose_port_does_not_make_the_rate_is_refused_with_its_rates():
    async with scripted(up_to_115200) as url:
        with pytest.raises(TransportLost, match="at 115200 instead of 230400 baud, the nearest that it makes: 115200"):
            await opened(url, working_baud=230_400)
        port = await opened(url, working_baud=115_200)
        assert port.offers(115_200)
        assert not port.offers(230_400)
        await port.close()


async def test_a_rate_that_comes_out_otherwise_later_ends_the_port():
    async with scripted(up_to_115200) as url:
        port, receiver = await opened(url), RecordingReceiver()
        port.attach(receiver)
        port.set_baud(250_000)
        await receiver.wait_lost()
        await port.close()

    assert "at 115200 instead of 250000 baud" in receiver.losses[0]


@pytest.mark.parametrize(
    ("greeting", "said"),
    [(bytes((IAC, 254, COM_PORT)), "refuses RFC 2217"), (bytes((IAC, 252, 0)), "refuses binary transmission")],
)
async def test_a_server_that_refuses_is_told_from_one_that_is_not_there(greeting: bytes, said: str):
    async with scripted(answered, greeting) as url:
        with pytest.raises(TransportLost, match=said) as refused:
            await opened(url)

    assert refused.value.remedy
    assert "socket://" in refused.value.remedy


async def test_a_server_that_has_another_framing_is_refused():
    async with scripted(lambda setting, value: answered(setting, 8 if setting == 2 else value)) as url:
        with pytest.raises(TransportLost, match="it has 8 instead of 7 for data bits"):
            await port_opener(url, 9600, "7e1")()


async def test_a_server_that_says_nothing_of_rfc_2217_is_given_up(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("ldcnd.line.rfc2217_port.NEGOTIATION_TIME_S", 0.2)
    async with scripted(answered, b"login: ") as url:
        with pytest.raises(TransportLost, match=r"it answers no setting within 0\.2 s"):
            await opened(url)


async def test_a_server_that_closes_is_quoted():
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1000)
        writer.write(b"Port already in use\r\n")
        await writer.drain()
        writer.close()

    listening = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with listening:
        with pytest.raises(TransportLost, match="saying 'Port already in use'"):
            await opened(f"rfc2217://127.0.0.1:{listening.sockets[0].getsockname()[1]}")


async def test_what_a_server_says_of_its_port_is_no_data():
    async with scripted(lambda setting, value: b"\x11" + answered(setting, value) + answered(7, 255) + b"\x22") as url:
        port, receiver = await opened(url), RecordingReceiver()
        port.attach(receiver)
        port.discard_input()
        port.set_baud(57_600)
        await receiver.wait_for(2)
        await port.close()

    assert receiver.data.endswith(b"\x11\x22")


@pytest.mark.system
async def test_a_scan_finds_drives_behind_a_serial_server():
    chain = build_chain(ChainSpec((ModuleSpec("ls-182ap"), ModuleSpec("pic-servo-v4"))))
    line = await open_simulated_line(chain, RESET_BAUD)
    rate = RESET_BAUD

    def take(data: bytes, baud: int | None) -> int:
        nonlocal rate
        if baud and baud != rate:
            rate = baud
            line.set_baud(baud)
        line.write(data)
        return len(data)

    async with server(take) as (door, url):

        class Back:
            """Sends the drives' bytes to the host."""

            def data_received(self, data: bytes) -> None:
                door.write(data)

            def transport_lost(self, reason: str) -> None:
                raise AssertionError(reason)

        line.attach(Back())
        findings = []
        drives = await scan_port(BENCHES["ldcn"], url, findings.append, give_addresses=True)
    await line.close()

    assert [drive.model for drive in drives] == ["ls-182ap", "pic-servo-v4"], findings
