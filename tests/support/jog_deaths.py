"""How soon an axis ends that a hand jogs, after each kind of death: `python -m tests.support.jog_deaths [RUNS [SEED]]`.

Real processes, real signals, a pseudo-terminal whose drives live in this process and are looked at each few
milliseconds. Each run kills at a random instant of a jog. The daemon stays up while its clients die, and is begun anew,
adopting the line, after its own death.
"""

import argparse
import asyncio
import contextlib
import json
import random
import signal
import statistics
import sys
import tempfile
import threading
import time
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections import deque
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from pathlib import Path
from urllib.parse import urlsplit

from typing_extensions import override
from websockets.asyncio.client import connect

import ldcnd
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import Power
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.pty import PtyLine
from tests.support.browser import Browser, ask_over_tcp
from tests.support.process import LDCND, ROOT, answering, client, free_port

HOLD_S = 0.4
REACH_S = 1.0
"""`jog_reach_s` of the rig: short, so that many runs take little time."""
VELOCITY, ACCELERATION = 4.0, 100.0
RAMP_S = VELOCITY / ACCELERATION
SETTLE_S = 0.15
"""From the end of the profile until the shaft is within `STILL_COUNTS` of where it stays."""
STILL_COUNTS = 10
LOOK_S = 0.004
SEEN_S = 0.3
"""A shaft that stays where it is for so long stands."""
DRIVES = {"s": "picservo-sc", "l": "ls182ap"}
MODELS = {"s": "pic-servo-sc", "l": "ls-182ap"}
TITLES = {"s": "PIC-SERVO SC", "l": "LS-182AP"}
AXIS = """
[[bus.axis]]
name = "{name}"
address = {address}
model = "{model}"
unit = "mm"
counts_per_unit = 1000
velocity = 10
acceleration = {acceleration}
jog_reach_s = {reach}
gains = {{kp = 350, kd = 3000, ki = 400, il = 400, ol = 250, el = 4000}}
rates = {{position = 20, velocity = 5, adc = 0, state = 10}}
"""
KINDS = {
    "program, SIGKILL": HOLD_S,
    "program, SIGSTOP": HOLD_S,
    "network": HOLD_S,
    "page, SIGKILL": HOLD_S,
    "page, SIGSTOP": HOLD_S,
    "console, SIGKILL": HOLD_S,
    "console, SIGSTOP": HOLD_S,
    "daemon, SIGKILL": 0.0,
    "daemon, SIGSTOP": 0.0,
}
"""What dies, and how long after it the jog is ended at the latest; by the drive when the daemon dies."""
HELD_EACH_S = 0.1
"""Period in which a page says that its button is held, seconds, as the console's own script does."""


def bound_s(kind: str, axis: str) -> float:
    """Return how long after a death the axis stands at the latest, on a host that has nothing else to do."""
    in_drive = {"s": 2 * HOLD_S, "l": REACH_S}[axis]
    return (KINDS[kind] or in_drive) + RAMP_S + SETTLE_S


class WatchedLine(PtyLine):
    """A simulated line that notes where its shafts are."""

    def __init__(self, link: Path) -> None:
        chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in DRIVES.values()), baud_check=True))
        super().__init__(chain, link, baud_check=True)
        self._drives = [module for module in chain.modules if isinstance(module, SimulatedDrive)]
        self.seen: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=4000)

    @override
    def _wait(self) -> None:
        due_s = self._chain.next_event_s()
        if due_s is None or due_s - self._now_s() > LOOK_S:
            time.sleep(LOOK_S / 4)
        super()._wait() if due_s is not None else None

    @override
    def _catch_up(self) -> None:
        now_s = self._now_s()
        if not self.seen or time.monotonic() - self.seen[-1][0] >= LOOK_S:
            for drive in self._drives:
                drive.catch_up(now_s)
            self.seen.append((time.monotonic(), tuple(drive.shaft.position_counts for drive in self._drives)))

    def position_counts(self, axis: str) -> float:
        """Return where a shaft was seen last."""
        return self.seen[-1][1][list(DRIVES).index(axis)]

    def stood_at_s(self, axis: str) -> float:
        """Return since when a shaft is where it is now, by the monotonic clock."""
        index = list(DRIVES).index(axis)
        seen = list(self.seen)
        last = seen[-1][1][index]
        since_s = seen[-1][0]
        for at_s, positions in reversed(seen):
            if abs(positions[index] - last) > STILL_COUNTS:
                return since_s
            since_s = at_s
        return since_s


@contextlib.contextmanager
def watched_line(link: Path) -> Iterator[WatchedLine]:
    """Serve the drives from a thread until the context ends."""
    over = threading.Event()
    with WatchedLine(link) as line:
        serving = threading.Thread(target=line.run, args=(over.is_set,), name="line")
        serving.start()
        try:
            yield line
        finally:
            over.set()
            serving.join()


class Network:
    """Carries TCP between a program and the daemon until it is cut; then it swallows everything and closes nothing."""

    def __init__(self, port: int) -> None:
        self.cut = False
        self._port = port
        self._writers: list[asyncio.StreamWriter] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Carry one connection."""
        there, onward = await asyncio.open_connection("127.0.0.1", self._port)
        self._writers += [writer, onward]
        async with asyncio.TaskGroup() as group:
            group.create_task(self._carry(reader, onward), name="out")
            group.create_task(self._carry(there, writer), name="back")

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(4096):
                if not self.cut:
                    writer.write(data)

    def close(self) -> None:
        """End all connections."""
        for writer in self._writers:
            writer.close()


@dataclass(slots=True)
class Deaths:
    """The rig, its daemon and what was measured.

    Attributes:
        host_s: what a busy host may take from a signal to its effect, and before a packet.
        late_s: how long after each death the axis stood, by kind and axis.
    """

    line: WatchedLine
    config: Path
    dice: random.Random
    host_s: float
    late_s: dict[tuple[str, str], list[float]] = field(default_factory=dict)
    port: int = 0
    daemon: Process | None = None

    async def run(self, kind: str, axis: str) -> float:
        """Kill at a random instant of a jog, and return how long after it the axis stood."""
        await self._ready(axis)
        network = Network(self.port)
        async with await asyncio.start_server(network.serve, "127.0.0.1", 0) as server:
            through = server.sockets[0].getsockname()[1] if kind == "network" else self.port
            async with self._started(kind, f"tcp/127.0.0.1:{through}", axis) as processes:
                await asyncio.sleep(self.dice.uniform(0.2, 1.6))
                at_s = time.monotonic()
                self._kill(kind, processes, network)
                await asyncio.sleep(bound_s(kind, axis) + self.host_s + SEEN_S)
                late_s = self.line.stood_at_s(axis) - at_s
            network.close()
        if kind.startswith("daemon"):
            self.daemon = None
        self.late_s.setdefault((kind, axis), []).append(late_s)
        return late_s

    @asynccontextmanager
    async def _started(self, kind: str, endpoint: str, axis: str) -> AsyncIterator[dict[str, Process]]:
        """Have a program, or a page of a console, that jogs the axis; yields what can be killed."""
        processes = {"daemon": self.daemon} if self.daemon else {}
        try:
            what: tuple[str, ...] = ("--jog", endpoint, axis)
            if kind.startswith(("page", "console")):
                command = (*LDCND, "console", "--json", "-e", endpoint, "--listen", "127.0.0.1:0")
                console = await asyncio.create_subprocess_exec(*command, cwd=ROOT, stdout=PIPE, stderr=DEVNULL)
                processes["console"] = console
                velocity = VELOCITY if self.line.position_counts(axis) < 0 else -VELOCITY
                what = ("--page", json.loads(await _line_of(console))["link"], axis, f"{velocity}")
            program = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "tests.support.jog_deaths", *what, cwd=ROOT, stdout=PIPE, stderr=PIPE
            )
            processes |= {"program": program, "page": program}
            if await _line_of(program) != b"jogs\n":
                raise AssertionError((kind, axis, (await program.communicate())[1].decode()))
            yield processes
        finally:
            for name, process in processes.items():
                if process.returncode is None and (name != "daemon" or kind.startswith("daemon")):
                    process.kill()
                    await process.wait()

    def _kill(self, kind: str, processes: Mapping[str, Process], network: Network) -> None:
        if kind == "network":
            network.cut = True
            return
        processes[kind.partition(",")[0]].send_signal(signal.SIGKILL if kind.endswith("SIGKILL") else signal.SIGSTOP)

    async def _ready(self, axis: str) -> None:
        """Have a daemon that serves the axis, and the loop of that closed."""
        if self.daemon is None:
            self.port = free_port()
            endpoint = f"tcp/127.0.0.1:{self.port}"
            self.daemon = await asyncio.create_subprocess_exec(
                *LDCND, "run", "--config", str(self.config), "--listen", endpoint,
                cwd=ROOT, stdout=DEVNULL, stderr=DEVNULL,
            )  # fmt: skip
            await answering(self.daemon, endpoint)
        async with client(f"tcp/127.0.0.1:{self.port}") as rig:
            await _powered(rig, axis)


async def _line_of(process: Process) -> bytes:
    assert process.stdout
    async with asyncio.timeout(60):
        return await process.stdout.readline()


async def _powered(rig: RigClient, axis: str) -> None:
    async with asyncio.timeout(30):
        while (state := await rig.state(axis)) is None or state.command or state.moving != "no":
            await asyncio.sleep(0.05)  # of a jog before
        if not state.enabled:
            await rig.command(axis, Power(on=True))


@asynccontextmanager
async def deaths(folder: Path, seed: int, host_s: float = 0.5) -> AsyncIterator[Deaths]:
    """Run the line until the context ends."""
    link, config = folder / "line", folder / "rig.toml"
    axes = "".join(
        AXIS.format(name=name, address=at, model=MODELS[name], acceleration=ACCELERATION, reach=REACH_S)
        for at, name in enumerate(DRIVES, 1)
    )
    config.write_text(
        f'rig = "deaths"\n\n[[bus]]\nname = "line"\nport = "{link}"\nbaud = 115200\nmargin_ms = 200\nstart = "adopt"\n'
        f'adopt_fallback = "reset"\n{axes}'
    )
    with watched_line(link) as line:
        measured = Deaths(line, config, random.Random(seed), host_s)
        try:
            yield measured
        finally:
            if measured.daemon and measured.daemon.returncode is None:
                measured.daemon.kill()
                await measured.daemon.wait()


async def jog(endpoint: str, axis: str) -> None:
    """Jog until killed: the program that dies; to and fro, so that it stays where it is in the long run."""
    async with ldcnd.connect(endpoint) as rig, rig.control(axis, client="hand", lease_s=60, force=True) as held:
        velocity = VELOCITY if float(held.position) < 0 else -VELOCITY
        async with held.jogging(velocity, hold_s=HOLD_S) as jogging:
            print("jogs", flush=True)
            while True:
                await jogging.held()


async def jog_by_a_page(link: str, axis: str, velocity: float) -> None:
    """Hold a page's button until killed: what the console's script says on its web socket."""
    at = urlsplit(link)
    assert at.hostname
    assert at.port
    browser = await Browser(partial(ask_over_tcp, at.hostname, at.port), f"http://{at.netloc}").enter(link)
    headers = browser.headers({"origin": browser.origin})
    del headers["host"]
    async with connect(f"ws://{at.netloc}/api/page", additional_headers=headers, compression=None) as socket:
        page = browser.forging(x_ldcnd_page=json.loads(await socket.recv())["page"])
        async with asyncio.timeout(30):
            while (
                await page.post("/api/rigs/deaths/control", {"axes": [axis], "force": True})
            ).status != HTTPStatus.OK:
                await asyncio.sleep(0.1)  # the rig is not connected yet; what the program before held is taken
        await socket.send(json.dumps({"jog": {"rig": "deaths", "axis": axis, "velocity": velocity}}))
        print("jogs", flush=True)
        while True:
            await socket.send(json.dumps({"held": True}))
            await asyncio.sleep(HELD_EACH_S)


def table(late_s: dict[tuple[str, str], list[float]]) -> str:
    """Return what was measured."""
    lines = ["| what dies | drive | runs | median | maximum | bound |", "|---|---|---|---|---|---|"]
    for (kind, axis), measured in sorted(late_s.items(), key=lambda each: (list(KINDS).index(each[0][0]), each[0][1])):
        lines.append(
            f"| {kind} | {TITLES[axis]} | {len(measured)} | {statistics.median(measured):.2f} s | {max(measured):.2f} s"
            f" | {bound_s(kind, axis):.2f} s |"
        )
    return "\n".join(lines)


async def measure(runs: int, seed: int) -> None:
    """Print the table of so many runs, and those that were too late."""
    with tempfile.TemporaryDirectory() as folder:
        async with deaths(Path(folder), seed) as rig:
            for at in range(runs):
                kind, axis = list(KINDS)[at % len(KINDS)], list(DRIVES)[at // len(KINDS) % len(DRIVES)]
                late_s = await rig.run(kind, axis)
                late = "  TOO LATE" if late_s > bound_s(kind, axis) + rig.host_s else ""
                print(f"{at + 1}: {kind}, {axis}: {late_s:.3f} s{late}", file=sys.stderr, flush=True)
            print(f"seed {seed}\n{table(rig.late_s)}")


def main() -> None:
    """Measure, or be the program that dies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=int, nargs="?", default=20)
    parser.add_argument("seed", type=int, nargs="?", default=22)
    parser.add_argument("--jog", nargs=2, metavar=("ENDPOINT", "AXIS"), help="jog until killed")
    parser.add_argument("--page", nargs=3, metavar=("LINK", "AXIS", "VELOCITY"), help="the same by a console's page")
    asked = parser.parse_args()
    if asked.page:
        link, axis, velocity = asked.page
        asyncio.run(jog_by_a_page(link, axis, float(velocity)))
    else:
        asyncio.run(jog(*asked.jog) if asked.jog else measure(asked.runs, asked.seed))


if __name__ == "__main__":
    main()
