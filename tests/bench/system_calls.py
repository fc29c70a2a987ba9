"""System calls of the daemon's main thread for each poll, counted by strace; what timers wake it for is told apart."""

import shutil
import subprocess
from pathlib import Path

from tests.bench.processes import config_text, daemon, free_endpoint, paced_line, settle
from tests.bench.report import Row

COUNT_S = 2
START_S = 6.0
REQUEST = '"\\252"'
"""How strace shows the header of a packet."""


def rows(line_program: Path, folder: Path) -> list[Row]:
    """Count the calls that belong to a line that is polled all the time."""
    strace = shutil.which("strace")
    if strace is None:
        print("no strace: system calls are not counted")
        return []
    return [*_counted(strace, line_program, folder, burst=True), *_counted(strace, line_program, folder, burst=False)]


def _counted(strace: str, line_program: Path, folder: Path, *, burst: bool) -> list[Row]:
    with paced_line(line_program, modules=1, ready_baud=0, burst=burst) as line:
        config = folder / "calls.toml"
        config.write_text(
            config_text(line.terminal, modules=1, baud=115_200, uvloop=False, hz=2000.0, items=("velocity",))
        )
        trace = folder / "calls.txt"
        with daemon(config, free_endpoint()) as running:
            settle(START_S)
            tracing = subprocess.Popen(  # noqa: S603
                (strace, "-s", "1", "-o", trace, "-p", str(running.pid)), stderr=subprocess.DEVNULL
            )
            settle(COUNT_S)
            tracing.terminate()
            tracing.wait()
    calls = trace.read_text().splitlines()
    polls = sum(1 for call in calls if call.startswith("write(") and REQUEST in call)
    waits = [call for call in calls if call.startswith("epoll_wait(")]
    timers = sum(1 for call in waits if call.rstrip().endswith("= 0"))
    line_calls = polls + sum(1 for call in calls if call.startswith("read(")) + len(waits) - timers
    how = "in one piece" if burst else "byte by byte"
    target = 3.1 if burst else None
    return [
        Row(f"system calls for each poll, replies {how}", line_calls / polls, "", target, at_most=True),
        Row(f"wake-ups by timers, replies {how}", timers / COUNT_S, "/s"),
    ]
