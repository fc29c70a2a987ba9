"""System calls of the main thread for each poll, counted by strace; what timers wake it for is told apart."""

import shutil
import statistics
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.bench.processes import (
    SUBJECT_CPU,
    PacedLines,
    config_text,
    daemon,
    free_endpoint,
    heard,
    paced_lines,
    process,
    settle,
)
from tests.bench.report import Row

MODULES = 8
BAUD = 115_200
COUNT_S = 2
TRIES = 3
"""Being traced holds a program up, and one that is held up does more calls: the least of a few counts is its own."""
START_S = 6.0
REQUEST = '"\\252"'
"""How strace shows the header of a packet."""
OF_THE_LINE = ("read(", "ioctl(", "sched_yield(")
"""What is called for a line besides writing and waiting."""


def rows(line_program: Path, folder: Path) -> list[Row]:
    """Count the calls that belong to a line that is polled all the time: of a bus alone, and of the whole daemon."""
    strace = shutil.which("strace")
    if strace is None:
        print("no strace: system calls are not counted")
        return []
    found = []
    for burst in (True, False):
        how = "in one piece" if burst else "byte by byte"
        with paced_lines(line_program, modules=MODULES, ready_baud=BAUD, burst=burst) as line, _bare_bus(line) as it:
            found.append(_row(f"system calls of a poll, nothing published, replies {how}", strace, it, folder, 3))
        with (
            paced_lines(line_program, modules=MODULES, ready_baud=0, burst=burst) as line,
            _daemon(line, folder) as it,
        ):
            found.append(_row(f"system calls of a poll, whole daemon, replies {how}", strace, it, folder, 4))
    return found


@contextmanager
def _bare_bus(line: PacedLines) -> Iterator[subprocess.Popen]:
    command = (sys.executable, "-m", "tests.bench.bare_bus", *line.terminals, str(MODULES))
    with process(command, cpu=SUBJECT_CPU, nice=-10, pipe=True) as running:
        assert heard(running).strip() == "polling"
        settle(1.0)
        yield running


@contextmanager
def _daemon(line: PacedLines, folder: Path) -> Iterator[subprocess.Popen]:
    config = folder / "calls.toml"
    config.write_text(
        config_text(*line.terminals, modules=MODULES, baud=BAUD, uvloop=False, hz=2000.0, items=("velocity",))
    )
    with daemon(config, free_endpoint()) as running:
        settle(START_S)
        yield running


def _row(name: str, strace: str, running: subprocess.Popen, folder: Path, target: float | None = None) -> Row:
    calls = min(_calls_of_a_poll(strace, running, folder / "calls.txt") for _ in range(TRIES))
    return Row(name, calls, "", target, at_most=True, exact=True)


def _calls_of_a_poll(strace: str, running: subprocess.Popen, trace: Path) -> int:
    """Return how many calls lie from one request to the next, in the median: a poll that is held up has more."""
    tracing = subprocess.Popen(  # noqa: S603
        (strace, "-s", "1", "-o", trace, "-p", str(running.pid)), stderr=subprocess.DEVNULL
    )
    settle(COUNT_S)
    tracing.terminate()
    tracing.wait()
    polls, count = [], 0
    for call in trace.read_text().splitlines():
        if call.startswith("write(") and REQUEST in call:
            polls.append(count + 1)
            count = 0
        elif call.startswith("epoll_wait("):
            count += not call.rstrip().endswith("= 0")  # a timer's
        else:
            count += call.startswith(OF_THE_LINE)
    return statistics.median_low(polls)
