"""`ldcnd sim` as a program: another program's host drives it, and its files do what they say.

The host here knows the protocol from the manual only; it uses nothing of ldcnd but what reads its wire log.
"""

import json
import os
import select
import signal
import subprocess
import sys
import termios
import time
from contextlib import contextmanager

import pytest

from ldcnd.line.capture import parse_capture
from ldcnd.line.flight_recorder import WireEvent

pytestmark = pytest.mark.real_time

SPEEDS = {9600: termios.B9600, 19_200: termios.B19200, 57_600: termios.B57600, 115_200: termios.B115200}
START_S = 20.0
REPLY_S = 1.0
SILENCE_S = 0.15
MOVE_S = 8.0


class Port:
    """A raw terminal, as any program opens one."""

    def __init__(self, path):
        self.descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.set_speed(19_200)

    def close(self):
        os.close(self.descriptor)

    def set_speed(self, baud):
        control = termios.CS8 | termios.CREAD | termios.CLOCAL
        characters = termios.tcgetattr(self.descriptor)[6]
        raw = [0, 0, control, 0, SPEEDS[baud], SPEEDS[baud], characters]
        termios.tcsetattr(self.descriptor, termios.TCSANOW, raw)

    def read(self, length, within_s):
        received = b""
        ends_s = time.monotonic() + within_s
        while len(received) < length and (left_s := ends_s - time.monotonic()) > 0:
            if select.select([self.descriptor], [], [], left_s)[0]:
                received += os.read(self.descriptor, length - len(received))
        return received

    def flush(self):
        while self.read(64, 0.02):
            pass


class Host:
    """Sends packets, checks what comes back."""

    def __init__(self, port):
        self.port = port

    def send(self, address, command, data=b""):
        body = bytes([address, len(data) << 4 | command]) + data
        os.write(self.port.descriptor, b"\xaa" + body + bytes([sum(body) & 0xFF]))

    def ask(self, address, command, data=b"", reply=2):
        self.send(address, command, data)
        received = self.port.read(reply, REPLY_S)
        assert len(received) == reply, f"address {address}, command {command:X}: {received.hex() or 'nothing'}"
        assert sum(received[:-1]) & 0xFF == received[-1]
        assert not received[0] & 0x02, "checksum error"
        return received[:-1]

    def hears_nobody(self, address):
        self.send(address, 0xE)
        return self.port.read(2, SILENCE_S) == b""

    def enumerate(self):
        """Reset everybody, then give out addresses until nobody is left; return who is where."""
        os.write(self.port.descriptor, bytes(16))
        self.send(0xFF, 0xF)
        self.port.read(64, SILENCE_S)
        identities = []
        while True:
            address = len(identities) + 1
            self.send(0, 0x1, bytes([address, 0xFF]))
            if len(self.port.read(2, SILENCE_S)) < 2:
                return identities
            identities.append(tuple(self.ask(address, 0x3, b"\x20", reply=4)[1:]))

    def everybody_to(self, baud, code):
        self.send(0xFF, 0xA, bytes([code]))
        self.port.read(2, SILENCE_S)
        self.port.set_speed(baud)

    def close_loop(self, address):
        gains = b"".join(value.to_bytes(2, "little") for value in (350, 3000, 400, 400))
        self.ask(address, 0x6, gains + bytes([250, 0]) + (4000).to_bytes(2, "little") + bytes([1, 0]))
        self.ask(address, 0x7, b"\x05")
        self.ask(address, 0xB)

    def start_move(self, address, position, velocity=10 << 16, acceleration=1000):
        numbers = (position, velocity, acceleration)
        self.ask(address, 0x4, b"\x97" + b"".join(value.to_bytes(4, "little", signed=True) for value in numbers))

    def state(self, address):
        answer = self.ask(address, 0x3, b"\x01", reply=6)
        return answer[0], int.from_bytes(answer[1:5], "little", signed=True)

    def arrives(self, address, target):
        ends_s = time.monotonic() + MOVE_S
        while time.monotonic() < ends_s:
            status, position = self.state(address)
            if status & 0x01 and abs(position - target) <= 2:
                return True
        return False


@contextmanager
def simulated(link, *arguments):
    """Run `ldcnd sim`; yields what it says once it can be opened."""
    command = [sys.executable, "-m", "ldcnd", "sim", "--json", "--pty", str(link), *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - our own program
        try:
            assert select.select([process.stdout], [], [], START_S)[0]
            yield json.loads(process.stdout.readline())
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(10) == 0


@contextmanager
def host_at(link):
    port = Port(link)
    try:
        yield Host(port)
    finally:
        port.close()


def refusal(*arguments):
    command = [sys.executable, "-m", "ldcnd", "sim", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=START_S, check=False)  # noqa: S603
    return ended.returncode, ended.stderr


@pytest.mark.long
def test_an_independent_host_enumerates_speeds_up_and_moves(tmp_path):
    link = tmp_path / "line"

    log = tmp_path / "host.capture"

    with simulated(
        link, "--baud-check", "--wire-log", str(log), "--chain", "ls182ap pic-io picservo-v4 pic-servo-sc"
    ) as told:
        assert told["modules"] == ["ls-182ap", "pic-io", "pic-servo-v4", "pic-servo-sc"]
        assert told["terminal"] == str(link.resolve())
        with host_at(link) as host:
            assert host.enumerate() == [(90, 20), (2, 1), (0, 4), (0, 10)]

            host.port.set_speed(115_200)
            assert host.hears_nobody(1)
            host.port.set_speed(19_200)
            os.write(host.port.descriptor, bytes(16))
            host.everybody_to(115_200, 0x0A)
            for address in (1, 2, 3, 4):
                host.ask(address, 0xE)

            for address, target in ((1, 7000), (3, -4000)):
                host.close_loop(address)
                host.start_move(address, target)
                assert host.state(address)[1] != target
                assert host.arrives(address, target)
    assert not link.is_symlink()
    records = parse_capture(log.read_text()).records
    assert [record.note for record in records if record.event is WireEvent.BAUD][:2] == ["19200", "115200"]
    sent = [record.data for record in records if record.event is WireEvent.SENT]
    assert bytes.fromhex("aa ff 0f 0e") in sent
    assert "node 1: LoadTrajectory(" in log.read_text()


FILE = """
seed = 7
baud_check = true

[[module]]
model = "ls182ap"
travel_counts = [-3000, 3000]
plant = { index_spacing_counts = 500, pot_noise = 0.001 }
behaviour = { version = 21, reply_latency_s = 0.02 }

[[module]]
model = "picservo-v4"
conditions = ["encoder_stuck"]

[[module]]
model = "picio"

[[event]]
at_s = 3.0
module = 1
begins = "overvoltage"

[[event]]
at_s = 3.0
module = 2
power = "off"
"""


@pytest.mark.long
def test_a_file_says_what_the_modules_are_and_what_happens_when(tmp_path):
    link, file = tmp_path / "line", tmp_path / "line.toml"
    file.write_text(FILE)

    with simulated(link, "--file", str(file), "--seed", "3") as told:
        started_s = time.monotonic()
        assert (told["baud_check"], told["seed"]) == (True, 3)
        with host_at(link) as host:
            assert host.enumerate() == [(90, 21), (0, 4), (2, 1)]
            asked_s = time.monotonic()
            host.ask(1, 0xE)
            assert time.monotonic() - asked_s > 0.02
            before = host.ask(1, 0xE)[0]
            assert before & 0x08

            host.port.read(1, started_s + 3.3 - time.monotonic())

            assert not host.ask(1, 0xE)[0] & 0x08
            assert host.hears_nobody(2)
            # the one behind it has lost its address input
            assert host.hears_nobody(3)


@pytest.mark.long
def test_a_fault_plan_spoils_the_line(tmp_path):
    link, plan = tmp_path / "line", tmp_path / "faults.toml"
    plan.write_text('[[fault]]\nkind = "reply_lost"\n')

    with simulated(link, "--chain", "ls182ap", "--fault-plan", str(plan)):
        with host_at(link) as host:
            host.send(0, 0x1, b"\x01\xff")
            assert host.port.read(2, SILENCE_S) == b""


@pytest.mark.parametrize(
    ("arguments", "code", "complaint"),
    [
        (["--chain", "ls182ap nonsense"], 78, "no such module: nonsense; known are ls-182ap"),
        ([], 2, "either by --chain or by --file"),
        (["--chain", "ls182ap", "--pty", "/nowhere/at.all"], 1, "no terminal"),
    ],
)
@pytest.mark.sweep(3)
def test_wrong_arguments_are_refused(arguments, code, complaint):
    ended, told = refusal(*arguments)

    assert ended == code
    assert complaint in told
