import asyncio
import os
import pty
import select
import sys
import termios
import tty
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from ldcnd.contract.errors import TransportLost
from ldcnd.line.serial_port import SerialSettings, open_serial_port
from ldcnd.line.transport import Transport
from tests.support.process import piped
from tests.support.recording_receiver import RecordingReceiver

pytestmark = pytest.mark.real_time

WAIT_S = 5.0
HOLDS = """
import sys
with open(sys.argv[1], "rb", buffering=0):
    print("open", flush=True)
    sys.stdin.read()
"""


class FarSide:
    """The master of a pseudo-terminal: what a line would see."""

    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        os.close(slave)
        self.open = True

    def close(self) -> None:
        if self.open:
            self.open = False
            os.close(self.master)

    async def read(self, length: int) -> bytes:
        loop = asyncio.get_running_loop()
        async with asyncio.timeout(WAIT_S):
            return await loop.run_in_executor(None, os.read, self.master, length)


@pytest.fixture
def far() -> Iterator[FarSide]:
    side = FarSide()
    yield side
    side.close()


@pytest.fixture
async def port(far: FarSide) -> AsyncIterator[Transport]:
    opened = await open_serial_port(SerialSettings(far.path, 115_200))
    yield opened
    await opened.close()


async def opened_at_last(settings: SerialSettings) -> Transport:
    """Open a port as soon as an attempt of before has returned."""
    while True:
        try:
            return await open_serial_port(settings)
        except TransportLost:
            await asyncio.sleep(0.01)


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


async def test_bytes_go_both_ways(far: FarSide, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)

    port.write(b"\xaa\x00\x0d\x0a\x11\x13")
    sent = await far.read(100)
    os.write(far.master, b"\x00\x0d\x0a\x11\x13\xff")
    await receiver.wait_for(6)

    assert sent == b"\xaa\x00\x0d\x0a\x11\x13"
    assert receiver.data == b"\x00\x0d\x0a\x11\x13\xff"


async def test_a_write_is_out_before_the_loop_turns(far: FarSide, port: Transport):
    port.attach(RecordingReceiver())
    os.set_blocking(far.master, False)

    port.write(b"\xaa\x01")

    # the kernel hands bytes over in a worker of its own: poll it, without giving the loop a turn
    deadline = asyncio.get_running_loop().time() + WAIT_S
    got = b""
    while not got and asyncio.get_running_loop().time() < deadline:
        try:
            got = os.read(far.master, 10)
        except BlockingIOError:
            continue
    assert got == b"\xaa\x01"


async def test_what_arrived_before_attaching_is_dropped(far: FarSide, port: Transport):
    receiver = RecordingReceiver()
    os.write(far.master, b"old")
    await asyncio.get_running_loop().run_in_executor(None, termios.tcdrain, far.master)

    port.attach(receiver)
    os.write(far.master, b"new")
    await receiver.wait_for(3)

    assert receiver.data == b"new"


async def test_a_vanished_far_side_is_reported_once(far: FarSide, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)

    far.close()
    await receiver.wait_lost()
    with pytest.raises(TransportLost, match=far.path):
        port.write(b"\xaa")
    with pytest.raises(TransportLost, match=far.path):
        port.set_baud(9600)
    port.discard_input()
    await port.close()

    assert len(receiver.losses) == 1
    assert far.path in receiver.losses[0]


async def test_a_write_that_fails_is_a_loss(far: FarSide, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)

    far.close()
    with pytest.raises(TransportLost, match=far.path):
        port.write(b"\xaa")
    await receiver.wait_lost()
    await port.close()

    assert len(receiver.losses) == 1


async def test_a_port_that_takes_no_more_bytes_is_lost(far: FarSide, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)

    with pytest.raises(TransportLost, match=far.path):
        _fill(port)
    await receiver.wait_lost()

    assert len(receiver.losses) == 1


async def test_closing_is_not_a_loss_and_may_be_repeated(far: FarSide):
    port = await open_serial_port(SerialSettings(far.path, 115_200))
    receiver = RecordingReceiver()
    port.attach(receiver)

    await port.close()
    await port.close()

    assert receiver.losses == []
    with pytest.raises(TransportLost, match="closed"):
        port.write(b"\xaa")


async def test_closing_keeps_no_descriptor(far: FarSide):
    await (await open_serial_port(SerialSettings(far.path, 115_200))).close()
    before = descriptors()

    for _ in range(5):
        port = await open_serial_port(SerialSettings(far.path, 115_200))
        port.attach(RecordingReceiver())
        port.write(b"\xaa")
        await port.close()

    assert descriptors() == before


async def test_a_lost_port_keeps_no_descriptor():
    await asyncio.get_running_loop().run_in_executor(None, int)
    before = descriptors()

    for _ in range(5):
        far = FarSide()
        port = await open_serial_port(SerialSettings(far.path, 115_200))
        receiver = RecordingReceiver()
        port.attach(receiver)
        far.close()
        await receiver.wait_lost()
        await port.close()

    assert descriptors() == before


async def test_an_opening_that_is_cancelled_keeps_no_descriptor(far: FarSide):
    settings = SerialSettings(far.path, 115_200, exclusive=False)
    await (await open_serial_port(settings)).close()  # what the loop keeps of its own is there now
    before = descriptors()

    async with asyncio.TaskGroup() as group:
        opening = group.create_task(open_serial_port(settings), name="opening")
        await asyncio.sleep(0)
        opening.cancel()
    async with asyncio.timeout(10):
        port = await opened_at_last(settings)
    await port.close()

    assert descriptors() == before


async def test_a_port_in_use_is_refused(far: FarSide, port: Transport):
    with pytest.raises(TransportLost, match="another program has it") as refused:
        await open_serial_port(SerialSettings(far.path, 115_200))

    assert refused.value.value == far.path
    assert refused.value.remedy


async def test_a_port_that_another_program_has_had_before_is_refused_by_that_name(far: FarSide, monkeypatch):
    monkeypatch.setattr("ldcnd.line.serial_port.PSEUDO_TERMINALS", ())  # a port of its own: nobody serves it
    settings = SerialSettings(far.path, 115_200)
    with piped(sys.executable, "-c", HOLDS, far.path) as holder:
        assert holder.stdout
        assert holder.stdout.readline() == "open\n"
        for _ in range(2):  # the attempt before keeps nobody out
            with pytest.raises(TransportLost, match=rf"cannot be opened: .*\({holder.pid}\) has it; end that program"):
                await open_serial_port(settings)

    await (await open_serial_port(settings)).close()


async def test_a_missing_device_is_named(tmp_path: Path):
    missing = str(tmp_path / "ttyUSB7")

    with pytest.raises(TransportLost, match=r"ttyUSB7.*no such device"):
        await open_serial_port(SerialSettings(missing, 115_200))


async def test_a_terminal_that_another_program_was_given_since_its_link_was_made_is_not_opened(tmp_path: Path):
    stranger, link = FarSide(), tmp_path / "line"
    link.symlink_to(stranger.path)
    await (await open_serial_port(SerialSettings(str(link), 115_200))).close()
    long_ago_s = Path(stranger.path).stat().st_ctime - 3600  # the kernel gives the number of a closed one away
    os.utime(link, (long_ago_s, long_ago_s), follow_symlinks=False)

    with pytest.raises(TransportLost, match="may be another program's") as refused:
        await open_serial_port(SerialSettings(str(link), 115_200))
    stranger.close()

    assert "make the link anew" in str(refused.value.remedy)


async def test_what_is_no_serial_port_is_refused(tmp_path: Path):
    plain = tmp_path / "plain"
    plain.write_bytes(b"")
    before = descriptors()

    with pytest.raises(TransportLost, match="check that it is a serial port"):
        await open_serial_port(SerialSettings(str(plain), 115_200))

    assert descriptors() == before


@pytest.mark.parametrize("baud", [9600, 19_200, 57_600, 115_200, 230_400, 125_000])
async def test_the_rate_changes_both_directions_at_once(far: FarSide, port: Transport, baud: int):
    port.set_baud(baud)

    if baud == 125_000:
        return  # a rate without a code of its own: accepted, not readable through termios
    _, _, _, _, speed_in, speed_out, _ = termios.tcgetattr(far.master)
    assert speed_in == speed_out == getattr(termios, f"B{baud}")


async def test_a_pseudo_terminal_has_no_frame_to_set(far: FarSide):
    port = await open_serial_port(SerialSettings(far.path, 9600, framing="7e1"))
    receiver = RecordingReceiver()
    port.attach(receiver)

    port.set_baud(19_200)
    os.write(far.master, b"\xff")
    await receiver.wait_for(1)
    await port.close()

    assert receiver.data == b"\xff"


async def test_discarding_drops_what_waits(far: FarSide, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)
    os.write(far.master, b"late")
    assert select.select([port._port.fileno()], [], [], WAIT_S)[0]

    port.discard_input()
    os.write(far.master, b"next")
    await receiver.wait_for(4)

    assert receiver.data == b"next"


async def test_no_byte_is_delivered_before_all_that_are_expected_are_there(far: FarSide, port: Transport):
    receiver = RecordingReceiver()
    pieces: list[bytes] = []
    receiver.data_received = pieces.append  # type: ignore[method-assign]
    port.attach(receiver)
    port.expect(9)

    os.write(far.master, b"12345")
    assert not select.select([port._port.fileno()], [], [], 0.05)[0]  # nothing to wake up for
    os.write(far.master, b"6789")
    assert select.select([port._port.fileno()], [], [], WAIT_S)[0]
    await asyncio.sleep(0)
    await asyncio.sleep(0)

    assert pieces == [b"123456789"]


async def test_what_was_held_back_can_be_collected(far: FarSide, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)
    port.expect(9)
    os.write(far.master, b"12345")
    deadline = asyncio.get_running_loop().time() + WAIT_S
    while len(receiver.data) < 5 and asyncio.get_running_loop().time() < deadline:
        port.collect()

    assert receiver.data == b"12345"


async def test_a_port_that_expects_more_than_comes_still_reports_its_end(far: FarSide, port: Transport):
    receiver = RecordingReceiver()
    port.attach(receiver)
    port.expect(9)

    os.write(far.master, b"12345")
    far.close()
    await receiver.wait_lost()

    assert len(receiver.losses) == 1


async def test_a_push_yields_the_processor_once_on_a_pseudo_terminal(port: Transport, monkeypatch):
    yielded: list[bool] = []
    monkeypatch.setattr(os, "sched_yield", lambda: yielded.append(True))

    port.push()

    assert yielded == [True]


async def test_a_port_that_is_no_pseudo_terminal_needs_no_push(port: Transport, monkeypatch):
    yielded: list[bool] = []
    monkeypatch.setattr(os, "sched_yield", lambda: yielded.append(True))
    port.pushes = False

    port.push()

    assert yielded == []


async def test_an_adapter_on_usb_is_not_told_what_to_expect(far: FarSide, port: Transport):
    port._is_usb = True
    port.expect(9)

    assert termios.tcgetattr(port._descriptor)[6][termios.VMIN] == 1


async def test_a_number_of_bytes_that_was_expected_before_is_told_again_at_the_rate_of_now(port: Transport):
    told = []
    for expected in (9, 1, 9):
        port.expect(expected)
        told.append(termios.tcgetattr(port._descriptor)[6][termios.VMIN])
    port.set_baud(19_200)
    for expected in (1, 9):
        port.expect(expected)
        attributes = termios.tcgetattr(port._descriptor)
        told.append(attributes[6][termios.VMIN])
        assert attributes[4:6] == [termios.B19200] * 2

    assert [number if isinstance(number, int) else number[0] for number in told] == [9, 1, 9, 1, 9]


def _fill(port: Transport) -> None:
    for _ in range(1000):
        port.write(bytes(1024))
