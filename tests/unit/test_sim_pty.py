"""The chain behind a pseudo-terminal, on the wall clock."""

import asyncio
import os
import select
import signal
import subprocess
import sys
import termios
import threading
import time
import tty
from contextlib import contextmanager

import pytest

from ldcnd.contract.errors import TransportLost
from ldcnd.line.serial_port import SerialSettings, open_serial_port
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.pty import PtyLine

pytestmark = pytest.mark.real_time

SET_ADDRESS_1 = bytes.fromhex("aa 00 21 01 ff 21")
NO_OPERATION_1 = bytes.fromhex("aa 01 0e 0f")
TO_115200 = bytes.fromhex("aa ff 1a 0a 23")


@contextmanager
def served(link=None, *, baud_check=False):
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"),), baud_check=baud_check))
    stopped = threading.Event()
    with PtyLine(chain, link, baud_check=baud_check) as line:
        thread = threading.Thread(target=line.run, args=(stopped.is_set,), name="pty")
        thread.start()
        try:
            yield line
        finally:
            stopped.set()
            thread.join(5)
            assert not thread.is_alive()


@contextmanager
def opened(path):
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        tty.setraw(port)
        yield port
    finally:
        os.close(port)


def exchange(port, request, reply_bytes=2, wait_s=1.0):
    os.write(port, request)
    received = b""
    ends_s = time.monotonic() + wait_s
    while len(received) < reply_bytes and (left_s := ends_s - time.monotonic()) > 0:
        if select.select([port], [], [], left_s)[0]:
            received += os.read(port, 100)
    return received


def set_baud(port, speed):
    attributes = termios.tcgetattr(port)
    attributes[4] = attributes[5] = speed
    termios.tcsetattr(port, termios.TCSANOW, attributes)


def test_module_answers_through_the_terminal(tmp_path):
    link = tmp_path / "line"

    with served(link) as line, opened(link) as port:
        sent_s = time.monotonic()
        reply = exchange(port, SET_ADDRESS_1)
        took_s = time.monotonic() - sent_s

        assert reply == b"\x79\x79"
        assert took_s > 8 * 10 / 20_000  # six bytes out, two back, at the line's pace
        assert link.readlink() == line.path
    assert not link.is_symlink()


def test_host_may_go_and_another_come():
    with served() as line:
        with opened(line.path) as port:
            exchange(port, SET_ADDRESS_1)
        with opened(line.path) as port:
            assert exchange(port, NO_OPERATION_1) == b"\x79\x79"


def test_rate_of_the_host_counts_when_it_is_checked():
    with served(baud_check=True) as line, opened(line.path) as port:
        set_baud(port, termios.B115200)
        at_wrong_rate = exchange(port, SET_ADDRESS_1, wait_s=0.2)
        set_baud(port, termios.B19200)
        exchange(port, bytes(16), wait_s=0.05)
        at_right_rate = exchange(port, SET_ADDRESS_1)
        exchange(port, TO_115200, wait_s=0.05)
        set_baud(port, termios.B115200)

        assert at_wrong_rate == b""
        assert at_right_rate == b"\x79\x79"
        assert exchange(port, NO_OPERATION_1) == b"\x79\x79"


def test_rate_of_the_host_does_not_matter_otherwise():
    with served() as line, opened(line.path) as port:
        set_baud(port, termios.B115200)

        assert exchange(port, SET_ADDRESS_1) == b"\x79\x79"


def test_a_module_that_nobody_asks_does_not_fall_behind():
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"), ModuleSpec("picservo-v4")), baud_check=False))
    gives_up_s = time.monotonic() + 5.0

    def caught_up():
        return all(module._cycles_done > 200 for module in chain.modules)

    with PtyLine(chain) as line:
        line.run(lambda: caught_up() or time.monotonic() > gives_up_s)

    assert caught_up()


PROGRAM = """
import sys
from pathlib import Path
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.pty import serve_pty
chain = build_chain(ChainSpec((ModuleSpec("ls182ap"),), baud_check=False))
serve_pty(chain, Path(sys.argv[1]), opened=lambda path: print(path, flush=True))
print("closed", flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.sweep(2)
def test_process_serves_until_it_is_told_to_stop(tmp_path, number):
    link = tmp_path / "line"
    command = [sys.executable, "-c", PROGRAM, str(link)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - our own program
        path = process.stdout.readline().strip()
        with opened(path) as port:
            reply = exchange(port, SET_ADDRESS_1, wait_s=5.0)

        process.send_signal(number)
        rest, _ = process.communicate(timeout=5)

    assert reply == b"\x79\x79"
    assert (process.returncode, rest) == (0, "closed\n")
    assert not link.is_symlink()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("reused", [True, False])
@pytest.mark.sweep(2)
def test_the_terminal_of_a_killed_simulator_is_not_opened_even_when_it_is_anothers_by_now(tmp_path, reused):
    link = tmp_path / "line"
    settings = SerialSettings(str(link), 19_200)
    command = [sys.executable, "-c", PROGRAM, str(link)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - our own program
        path = process.stdout.readline().strip()
        asyncio.run(open_and_close(settings))
        process.kill()
        process.communicate(timeout=5)
    strangers = []
    while reused and not any(os.ttyname(near) == path for _, near in strangers):
        strangers.append(os.openpty())
        assert len(strangers) < 100
    before = [termios.tcgetattr(near) for _, near in strangers]

    with pytest.raises(TransportLost, match=r"cannot be opened: .*ldcnd sim --pty"):
        asyncio.run(open_and_close(settings))

    assert before == [termios.tcgetattr(near) for _, near in strangers]
    for descriptor in (each for pair in strangers for each in pair):
        os.close(descriptor)
    with served(link) as line:  # what is left is replaced
        assert link.readlink() == line.path
        asyncio.run(open_and_close(settings))
        with pytest.raises(OSError, match="serves"), served(link):
            pass


async def open_and_close(settings):
    port = await open_serial_port(settings)
    await port.close()
