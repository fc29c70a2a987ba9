"""The processes of the bench: paced lines, the floor, daemons and a subscriber, each on its processor."""

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.bench.sources import build

ROOT = Path(__file__).parents[2]
LINE_CPU, SUBJECT_CPU = 0, -1
"""The line spins on one processor, everything that is measured shares another one."""
PATIENCE_S = 60.0
SETTLE_S = 0.15
"""What a daemon needs that was stopped in the middle of an exchange."""
TURN_BITS = 24_000
"""Length of a turn in bits on the line: some hundred exchanges, 0.2 s at 115200 baud."""
TRIES = 10


class TooBusy(RuntimeError):
    """This machine is so busy that what is to be measured does not get to run."""


@dataclass(frozen=True, slots=True)
class LineFigures:
    """What a paced line saw of its host since it was asked before."""

    exchanges: int
    elapsed_s: float
    ideal_s: float
    turnaround_p50_us: float
    turnaround_p99_us: float
    late_p99_us: float

    @property
    def efficiency(self) -> float:
        """Share of the ideal rate, from the median turn-around: robust against pre-emption by others."""
        ideal_us = self.ideal_s / self.exchanges * 1e6
        return ideal_us / (ideal_us + self.turnaround_p50_us)

    @property
    def wall_efficiency(self) -> float:
        """Share of the ideal rate in the elapsed time."""
        return self.ideal_s / self.elapsed_s


@contextmanager
def process(
    command: Sequence[str | Path], *, cpu: int, nice: int, pipe: bool = False, root: Path = ROOT
) -> Iterator[subprocess.Popen]:
    """Run a program on one processor until the context ends; modules are found in `root` first."""
    cpus = sorted(os.sched_getaffinity(0))

    def place() -> None:
        os.sched_setaffinity(0, {cpus[cpu]})
        with contextlib.suppress(OSError):
            os.nice(nice)
            # where sessions share the processor evenly, nice only counts within one
            Path("/proc/self/autogroup").write_text(str(nice))

    running = subprocess.Popen(  # noqa: S603
        command,
        stdout=subprocess.PIPE if pipe else None,
        text=True,
        cwd=root,
        start_new_session=True,
        preexec_fn=place,  # noqa: PLW1509 - one thread
    )
    try:
        yield running
    finally:
        running.send_signal(signal.SIGCONT)
        running.terminate()
        try:
            running.wait(10)
        except subprocess.TimeoutExpired:
            running.kill()
            running.wait()
        if running.stdout:
            running.stdout.close()


def told(running: subprocess.Popen) -> str:
    """Ask a program for its figures and return its line of them; see `heard`."""
    running.send_signal(signal.SIGUSR1)
    return heard(running)


def heard(running: subprocess.Popen) -> str:
    """Return the next line that a program prints.

    Raises:
        TooBusy: none comes.
    """
    assert running.stdout
    if not select.select([running.stdout], [], [], PATIENCE_S)[0]:
        raise TooBusy(f"{running.args!r}: not a word within {PATIENCE_S:g} s")
    return running.stdout.readline()


class PacedLines:
    """Lines that one running program paces.

    Attributes:
        terminals: where their hosts find them.
    """

    def __init__(self, running: subprocess.Popen) -> None:
        self._running = running
        self.terminals = tuple(json.loads(heard(running)))

    def figures(self) -> tuple[LineFigures, ...]:
        """Return what was counted since the call before, line by line."""
        return tuple(LineFigures(**line) for line in json.loads(told(self._running)))


@dataclass(frozen=True, slots=True)
class Drive:
    """What is on a paced line: a model of the configuration and what it says it is."""

    model: str
    device: int
    version: int


LS_182AP = Drive("ls-182ap", 90, 20)
PIC_SERVO = Drive("pic-servo-v4", 0, 4)


@contextmanager
def paced_lines(
    program: Path, *, modules: int, ready_baud: int, lines: int = 1, burst: bool = False, drive: Drive = LS_182AP
) -> Iterator[PacedLines]:
    """Run paced lines; their modules have addresses and a rate already, or are as after power-up (rate 0)."""
    settings = (lines, modules, 1, ready_baud, int(burst), drive.device, drive.version)
    with process((program, *map(str, settings)), cpu=LINE_CPU, nice=-20, pipe=True) as running:
        yield PacedLines(running)


@dataclass(frozen=True, slots=True)
class Turn:
    """What a subject did while it ran: figures of each line, none of them silent, processor time, samples received."""

    lines: tuple[LineFigures, ...]
    cpu_s: float
    samples: int

    @property
    def cpu_us(self) -> float:
        """Return the processor time of an exchange."""
        return self.cpu_s / sum(line.exchanges for line in self.lines) * 1e6


class Subject:
    """A host under measurement, with its lines and whoever hears it; stopped between its turns.

    Turns are short, so that there are many: what others do to the machine, and whether the processor slept, changes
    from second to second, and acts alike only on those whose turns are close together.
    """

    def __init__(
        self, name: str, running: subprocess.Popen, lines: PacedLines, listener: subprocess.Popen | None = None
    ) -> None:
        self.name = name
        self.pid = running.pid
        self.lines = lines
        self._running = running
        self._listener = listener

    def turn(self, baud: int) -> Turn:
        """Let it run and measure it, with as many exchanges at any rate; again if a line was silent meanwhile."""
        round_s = TURN_BITS / baud
        self.resume()
        for _ in range(TRIES):
            settle(SETTLE_S)
            received = self._received()
            cpu_s = self.cpu_s()
            self.lines.figures()
            settle(round_s)
            figures = self.lines.figures()
            cpu_s = self.cpu_s() - cpu_s
            if all(line.exchanges for line in figures):
                received = self._received() - received
                self.stop()
                return Turn(figures, cpu_s, received)
        raise TooBusy(f"{self.name}: a line was silent for {TRIES} times {round_s:.2g} s")

    def _received(self) -> int:
        return int(told(self._listener)) if self._listener else 0

    def stop(self) -> None:
        """Freeze it."""
        self._running.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let it run."""
        self._running.send_signal(signal.SIGCONT)

    def cpu_s(self) -> float:
        """Return the processor time of all its threads."""
        tasks = Path(f"/proc/{self.pid}/task")
        return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks.iterdir()) / 1e9


def config_text(
    *terminals: str,
    modules: int,
    baud: int,
    uvloop: bool,
    hz: float,
    items: Sequence[str],
    drive: Drive = LS_182AP,
    line_keys: str = "margin_ms = 20",
) -> str:
    """Return the configuration of a daemon that polls its lines at a rate, or as often as they allow."""
    rates = ", ".join(f"{item} = {hz if item in items else 0}" for item in ("position", "velocity", "adc"))
    rates += f", state = {hz if 'state' in items else 1}"
    text = f'rig = "bench"\n[daemon]\nuvloop = {str(uvloop).lower()}\n'
    for line, terminal in enumerate(terminals):
        text += f'[[bus]]\nname = "line{line}"\nport = "{terminal}"\nbaud = {baud}\n{line_keys}\noverload = "skip"\n'
        for number in range(1, modules + 1):
            text += (
                f'[[bus.axis]]\nname = "a{number + line * modules}"\naddress = {number}\nmodel = "{drive.model}"\n'
                f"velocity = 1\nacceleration = 1\nrates = {{ {rates} }}\n"
            )
    return text


@contextmanager
def daemon(config: Path, endpoint: str, root: Path = ROOT) -> Iterator[subprocess.Popen]:
    """Run a daemon of this checkout, or of another one."""
    command = (sys.executable, "-m", "ldcnd", "run", "--log-level", "error", "--config", config, "--listen", endpoint)
    with process(command, cpu=SUBJECT_CPU, nice=-10, root=root) as running:
        yield running


@contextmanager
def subscriber(endpoint: str) -> Iterator[subprocess.Popen]:
    """Run a remote subscriber of everything; returns once it receives."""
    command = (sys.executable, "-m", "tests.bench.subscriber", endpoint)
    with process(command, cpu=SUBJECT_CPU, nice=19, pipe=True) as running:
        assert heard(running).strip() == "receiving"
        # it stands for another machine: what it does must not hold up the daemon
        os.sched_setscheduler(running.pid, os.SCHED_IDLE, os.sched_param(0))
        yield running


def free_endpoint() -> str:
    """Return a loopback endpoint that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def settle(seconds: float) -> None:
    """Let time pass on the wall clock."""
    time.sleep(seconds)


def build_programs(folder: Path) -> tuple[Path, Path]:
    """Build the paced lines and the floor."""
    return build("paced_lines", folder), build("reference_master", folder)
