"""PyLabRobot's VSpin backend, unchanged but for its port class, runs a centrifuge through a port of ldcnd.

The same program runs on the bare simulated line beside it; the simulated rotor decides what moved.
"""

import asyncio
import json
import os
import termios
from contextlib import contextmanager
from http.cookiejar import CookieJar
from itertools import groupby
from pathlib import Path
from unittest.mock import patch
from urllib.request import HTTPCookieProcessor, build_opener

import pytest
import websockets
from pylabrobot.centrifuge import vspin_backend

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import Power, Reset, Stop
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.leases import Acquire, Release
from ldcnd.drives.ldcn.packet import StatusFlag
from ldcnd.testing.blocking import RigClock, on_clock
from ldcnd.testing.rig import lines_of
from tests.support.process import ROOT, client, daemon, process
from tests.support.recordings import checked_topics, recorded_rig
from tests.support.rig import EPOCH_NS, running_rig

pytestmark = pytest.mark.edges

LATENCY_S = 0.002
"""How long the adapter's driver holds a read that finds nothing."""
DEPENDS = StatusFlag.POSITION_ERROR | StatusFlag.MOVE_DONE | StatusFlag.HOME_IN_PROGRESS
"""Bits of a drive that depend on the instant at which a program looks."""


class Port:
    """What the backend asks of its adapter."""

    def __init__(self):
        self.dialogue = []

    async def setup(self):
        """Open it."""

    async def stop(self):
        """Close it."""

    async def set_baudrate(self, baud):
        """Change the rate."""

    async def write(self, data):
        self.dialogue.append((bytes(data), bytearray()))
        self.put(bytes(data))
        return len(data)

    async def read(self, most):
        data = self.get(most)
        if not data:
            await asyncio.sleep(LATENCY_S)
        elif self.dialogue:
            self.dialogue[-1][1].extend(data)
        return data

    async def get_serial(self):
        return "simulated"

    async def set_rts(self, level):
        """These drives have no such line."""

    set_dtr = set_latency_timer = set_flowctrl = set_rts

    async def set_line_property(self, bits, stopbits, parity):
        assert (bits, stopbits, parity) == (8, 1, 0)


class BareLine(Port):
    """The adapter on the bare simulated line."""

    def __init__(self, chain):
        super().__init__()
        self.chain, self.rest = chain, b""

    async def set_baudrate(self, baud):
        self.chain.baud = baud

    def put(self, data):
        self.chain.write(asyncio.get_running_loop().time(), data)

    def get(self, most):
        self.rest += b"".join(piece for _, piece in self.chain.advance(asyncio.get_running_loop().time()))
        data, self.rest = self.rest[:most], self.rest[most:]
        return data


class Terminal(Port):
    """The adapter on a port of ldcnd."""

    def __init__(self, link):
        super().__init__()
        self.link, self.descriptor = link, None

    async def setup(self):
        self.descriptor = os.open(self.link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    async def stop(self):
        os.close(self.descriptor)

    async def set_baudrate(self, baud):
        settings = termios.tcgetattr(self.descriptor)
        settings[4] = settings[5] = {19_200: termios.B19200, 57_600: termios.B57600}[baud]
        termios.tcsetattr(self.descriptor, termios.TCSANOW, settings)

    def put(self, data):
        os.write(self.descriptor, data)

    def get(self, most):
        try:
            return os.read(self.descriptor, most)
        except BlockingIOError:
            return b""


def write_cabinet(folder: Path) -> Path:
    """Write the configuration of the centrifuge with a port for its old program; return its file."""
    text = (ROOT / "config" / "centrifuge.toml").read_text()
    text = text[: text.index("[[position]]")] + text[text.index("\n[[sim]]") :]  # of ldcnd's own programs
    for there, instead in (
        ("baud = 115200", "baud = 57600"),
        ("acceleration = 10 }", "acceleration = 60 }"),  # the program goes to its buckets at 50 rev/s²
        ("unbalanced = { line = 6, inverted = true }\n", ""),  # its lamp is there
        (', { input = "unbalanced", value = false }', ""),
        ("[bus.module.outputs]", '[bus.module.outputs]\nlamp = { line = 6, start = "low", reset = "low" }'),
        (
            """    { input = "locked", value = false },
    { input = "unlocked" },
    { output = "unlock" }, # a bolt that is about to fall in
""",
            "",
        ),  # the program unlocks and opens with one packet
    ):
        assert there in text
        text = text.replace(there, instead)
    port = {"name": "old", "bus": "line0", "link": str(folder / "vspin"), "access": "control"}
    text += "\n[[port]]\n" + "".join(f"{name} = {json.dumps(value)}\n" for name, value in port.items())
    file = folder / "cabinet.toml"
    file.write_text(text + "idle_s = 20\n")
    return file


def backend(port):
    """Return the backend of the package with this port class."""
    with patch.object(vspin_backend, "FTDI", lambda **_: port):
        made = vspin_backend.VSpinBackend()
    made._bucket_1_remainder = 0
    return made


@contextmanager
def simulated_clock():
    """Let the backend wait on the clock of the rig."""
    loop = asyncio.get_running_loop()
    with on_clock(RigClock(loop.time, lambda: EPOCH_NS / 1e9 + loop.time(), loop.hold_up)):
        yield


def shaft(chain):
    """Return where the simulated rotor is and how fast it turns: turns, turns a second."""
    drive = chain.modules[0]
    drive.catch_up(asyncio.get_running_loop().time())
    return (
        drive.shaft.position_counts / 8000,
        drive.shaft.velocity_counts / drive.profile.servo_cycle_s / 8000,
    )


async def cycle(program, chain):
    """Run one whole cycle; return what the machine did, as its shaft and its door say."""
    did = {}
    await program.setup()
    spinning = asyncio.create_task(program.spin(g=100, duration=10, acceleration=1.0, deceleration=1.0))
    fastest = 0.0
    while not spinning.done():
        fastest = max(fastest, abs(shaft(chain)[1]))
        await asyncio.sleep(0.05)
    await spinning
    did["fastest"] = fastest
    await program.go_to_bucket1()
    did["bucket"] = shaft(chain)[0] * 8000 % 8000  # the program's own counter begins where its spin has ended
    did["door open"] = await program.get_door_open()
    await program.close_door()
    did["door shut"] = not await program.get_door_open()
    await program.stop()
    return did


def told(dialogue):
    """Return what a program was told, polls of one kind as one: command, lengths of its replies, its last flags."""
    packets = [
        (data[:3] + (b"" if data[1] == 1 else data[3:]), bytes(reply))
        for data, reply in dialogue
        if data[0] == 0xAA and data[1] != 0  # Set Address: a port hears it at once after a reset, a module does not
    ]
    answered = []
    for command, replies in groupby(packets, key=lambda each: each[0]):
        each = [reply for _, reply in replies]
        flags = each[-1][0] if each[-1] else None
        if flags is not None and command[1] == 1:
            flags = int(StatusFlag(flags) & ~DEPENDS)
        answered.append((command.hex(" "), sorted({len(reply) for reply in each}), flags))
    return answered


async def on_bare_line(config):
    (chain,) = lines_of(config).values()
    port = BareLine(chain)
    with simulated_clock():
        did = await cycle(backend(port), chain)
    return did, told(port.dialogue)


async def test_the_program_spins_a_whole_cycle_as_on_the_bare_line_while_it_is_recorded(tmp_path):
    config, recording = load_config(write_cabinet(tmp_path)), tmp_path / "cycle.mcap"
    bare, expected = await on_bare_line(config)
    (chain,) = lines_of(config).values()
    async with recorded_rig(recording, config, chains={"line0": chain}) as recorded:
        port = Terminal(tmp_path / "vspin")
        with simulated_clock():
            did = await cycle(backend(port), chain)
        async with asyncio.timeout(10):
            while abs(shaft(chain)[1]) > 0.01:
                await asyncio.sleep(0.05)
        assert recorded.published["ldcn/centrifuge/tele/rotor/velocity"] > 100

    assert bare["fastest"] == pytest.approx(945 / 60, rel=0.02)
    assert did["fastest"] == pytest.approx(bare["fastest"], rel=0.02)
    assert did["bucket"] == pytest.approx(bare["bucket"], abs=20)
    assert did["door open"] is bare["door open"] is True
    assert did["door shut"] is bare["door shut"] is True
    assert checked_topics(recording)["ldcn/centrifuge/tele/rotor/velocity"] > 100
    assert told(port.dialogue) == expected
    given = [reply for data, reply in port.dialogue if data[:3] == b"\xaa\x00\x21"]
    assert all(given[:-1])  # the last one is for a third module, and there is none


async def spin_until_fast(program, chain):
    """Begin a spin, and return once the rotor is fast."""
    spinning = asyncio.create_task(program.spin(g=100, duration=60, acceleration=1.0))
    async with asyncio.timeout(60):
        while shaft(chain)[1] < 15:
            await asyncio.sleep(0.02)
    return spinning


async def until_rest(chain, within_s):
    """Return how long it takes until the rotor stands, in seconds."""
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    async with asyncio.timeout(within_s):
        while abs(shaft(chain)[1]) > 0.01:
            await asyncio.sleep(0.01)
    return loop.time() - began_s


async def given_up(task):
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_a_stop_in_mid_spin_holds_against_the_program_until_a_person_resets(tmp_path):
    link, config = tmp_path / "vspin", load_config(write_cabinet(tmp_path))
    (chain,) = lines_of(config).values()
    async with running_rig(config, {"line0": chain}) as rig:
        with simulated_clock():
            program = backend(Terminal(link))
            await program.setup()
            spinning = await spin_until_fast(program, chain)
            await rig.client.ask(Stop(), "rotor")
            await until_rest(chain, 3.0)

            stood = shaft(chain)[0]
            await asyncio.sleep(10)  # the program goes on with what it is about
            await given_up(spinning)
            await program.io.stop()
            again = backend(Terminal(link))
            setting_up = asyncio.create_task(again.setup())
            await asyncio.sleep(30)
            assert shaft(chain)[0] == pytest.approx(stood, abs=0.01)
            await given_up(setting_up)
            await again.io.stop()

            person = (await rig.client.ask(Acquire(client="ada", axes=("rotor",), force=True))).lease
            with pytest.raises(LdcndError, match="latched"):
                await rig.client.ask(Power(on=True, lease=person), "rotor")
            await rig.client.ask(Reset(lease=person), "rotor")
            await rig.client.ask(Release(lease=person))
            third = backend(Terminal(link))
            await third.setup()
            await given_up(await spin_until_fast(third, chain))
            await third.io.stop()
            await until_rest(chain, 10.0)


async def watched(url: str, seen: list[bytes | str]) -> None:
    """Let a browser in by its link, and read what the console feeds its page."""
    jar = CookieJar()
    await asyncio.to_thread(build_opener(HTTPCookieProcessor(jar)).open, url)
    cookie = "; ".join(f"{each.name}={each.value}" for each in jar)
    origin = url[: url.index("/", len("http://"))]
    feed = f"{origin.replace('http', 'ws', 1)}/api/feed"
    async with websockets.connect(feed, origin=origin, additional_headers={"Cookie": cookie}) as socket:
        async for frame in socket:
            seen.append(frame)  # noqa: PERF401 - until it is cancelled


@pytest.mark.real_time
@pytest.mark.timeout(300)
async def test_real_processes_record_watch_and_stop_the_program_in_mid_spin(tmp_path):
    recording, seen = tmp_path / "spin.mcap", []
    async with daemon(write_cabinet(tmp_path)) as endpoint, client(endpoint) as rig:
        to = ("--connect", endpoint)
        async with process("record", *to, "--out", str(recording), "--json"):
            async with process("console", *to, "--listen", "127.0.0.1:0", "--json") as console:
                async with asyncio.timeout(30):
                    told_link = json.loads(await console.stdout.readline())
                watching = asyncio.create_task(watched(told_link["link"], seen))
                program = backend(Terminal(tmp_path / "vspin"))
                await program.setup()
                spinning = asyncio.create_task(program.spin(g=100, duration=60, acceleration=1.0))
                async with rig.samples("rotor", "velocity") as samples, asyncio.timeout(60):
                    while (await anext(samples))[1].value < 15:
                        pass
                    async with process("stop", *to, "--json") as stop:
                        answer = json.loads((await stop.communicate())[0])
                    while abs((await anext(samples))[1].value) > 0.05:
                        pass
                await given_up(spinning)
                await program.io.stop()
                await given_up(watching)
        assert "rotor" in json.dumps(answer)
        state = await rig.state("rotor")
        assert state is not None
        assert state.stop_latched
    assert len(seen) > 50
    topics = checked_topics(recording)
    assert topics["ldcn/centrifuge/tele/rotor/velocity"] > 100
