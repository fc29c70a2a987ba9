"""How long a command takes on a line that is polled all the time, beyond a bare query and what the line costs."""

import json
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.profiles import PROFILES
from tests.bench.processes import SUBJECT_CPU, TooBusy, config_text, daemon, free_endpoint, heard, paced_lines, process
from tests.bench.report import Row

BAUD, DRIVE_BAUD = 115_200, 113_636
CYCLE_S = 0.000_512
POLL_BYTES = 5, 13
"""Out and in, of a poll for position, velocity and A/D converter."""
COUNT = 300
REPEATS = 5
PATIENCE_S = 120.0


def rows(line_program: Path, folder: Path) -> list[Row]:
    """Compare with what the line itself costs: the rest of the exchange under way, then the command's own.

    Both loops in turn, several times; each figure is the median of its repeats.
    """
    runs = [
        [row for uvloop in (False, True) for row in _rows(line_program, folder, uvloop=uvloop)] for _ in range(REPEATS)
    ]
    repeated = zip(*runs, strict=True)
    return [replace(row[0], value=statistics.median(each.value for each in row)) for row in repeated]


def _rows(line_program: Path, folder: Path, *, uvloop: bool) -> list[Row]:
    took_s, bare_s = _asked(line_program, folder, uvloop=uvloop)
    what = f"saturated line, {'uvloop' if uvloop else 'asyncio'}"
    beyond_s = _at(took_s, 0.5) - _at(bare_s, 0.5)
    late_s = _at(took_s, 0.99) - _at(bare_s, 0.5)
    out, back = POLL_BYTES
    mean_s, longest_s = _exchange_s(out, back, CYCLE_S / 2), _exchange_s(out, back, CYCLE_S)
    # what is left of an interval that is met at any instant: half of its mean square over its mean
    left_s = (mean_s**2 + CYCLE_S**2 / 12) / (2 * mean_s)
    return [
        Row(f"{what}: round trip of a command, median", _at(took_s, 0.5) * 1e6, "us"),
        Row(f"{what}: round trip of a bare query, median", _at(bare_s, 0.5) * 1e6, "us"),
        Row(f"{what}: round trip of a bare query, 99 %", _at(bare_s, 0.99) * 1e6, "us"),
        Row(
            f"{what}: command beyond bare query / (rest of a poll + own exchange), median",
            beyond_s / (left_s + _own_s(CYCLE_S / 2)),
            "",
            1.15,
            at_most=True,
        ),
        Row(
            f"{what}: the same, 99 %, / (longest poll + own exchange)",
            late_s / (longest_s + _own_s(CYCLE_S)),
            "",
            1.5,
            at_most=True,
        ),
    ]


def _asked(line_program: Path, folder: Path, *, uvloop: bool) -> tuple[list[float], list[float]]:
    """Return the round trips to the daemon and to a bare queryable, in seconds, each sorted."""
    endpoint, bare_endpoint = free_endpoint(), free_endpoint()
    config = folder / f"saturated-{uvloop}.toml"
    bare = (sys.executable, "-m", "tests.bench.bare_queryable", bare_endpoint)
    ask = (sys.executable, "-m", "tests.bench.asker", endpoint, bare_endpoint, str(COUNT))
    with (
        paced_lines(line_program, modules=8, ready_baud=0) as line,
        process(bare, cpu=SUBJECT_CPU, nice=-10, pipe=True) as answering,
    ):
        items = ("position", "velocity", "adc")
        config.write_text(config_text(*line.terminals, modules=8, baud=BAUD, uvloop=uvloop, hz=2000.0, items=items))
        assert heard(answering).strip() == "serving"
        with daemon(config, endpoint), process(ask, cpu=SUBJECT_CPU, nice=-10, pipe=True) as asking:
            try:
                took = json.loads(asking.communicate(timeout=PATIENCE_S)[0])
            except subprocess.TimeoutExpired:
                raise TooBusy(f"{COUNT} commands are not answered within {PATIENCE_S:g} s") from None
    return sorted(took["daemon_s"]), sorted(took["bare_s"])


def _own_s(wait_s: float) -> float:
    """Return how long the command's exchange takes."""
    exchange = commands.stop_motor(Node(1, PROFILES["ls-182ap"]), StopControl.MOTOR_OFF)
    return _exchange_s(len(exchange.request), exchange.reply_bytes, wait_s)


def _exchange_s(out: int, back: int, wait_s: float) -> float:
    return out * 10 / BAUD + wait_s + back * 10 / DRIVE_BAUD


def _at(ascending: Sequence[float], share: float) -> float:
    if share == 0.5:
        return statistics.median(ascending)
    return ascending[int((len(ascending) - 1) * share)]
