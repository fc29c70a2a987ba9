"""What a poll costs the processor with more drives on a line, and with more lines in a process."""

import random
import statistics
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from tests.bench.processes import (
    Subject,
    config_text,
    daemon,
    free_endpoint,
    paced_lines,
    settle,
    subscriber,
)
from tests.bench.report import Row

AXES = (1, 4, 16, 31)
LINES = (1, 2, 4, 8)
AXES_OF_A_LINE = 8
BAUD = 115_200
ITEMS = ("position", "velocity", "adc")
SETTLE_S = 0.5
LEAST_EXCHANGES = 10
"""A line that is polled has more in half a second, however busy the machine is."""
ROUND_S = 1.0


@dataclass(frozen=True, slots=True)
class Load:
    """One daemon in one round: the mean efficiency of its lines, and what a poll cost."""

    efficiency: float
    cpu_us: float
    core: float
    late_us: float


def rows(line_program: Path, folder: Path, rounds: int) -> list[Row]:
    """Measure one line with more and more drives, then more and more lines of 8 drives."""
    shapes = [(1, axes) for axes in AXES]
    loads = _measure(line_program, folder, shapes, rounds, in_one_piece=True)
    found = [
        Row(f"1 line, {axes} drive(s): processor time of a poll", _median(load.cpu_us for load in loads[1, axes]), "us")
        for _, axes in shapes
    ]
    for in_one_piece in (False, True):
        found += _line_rows(line_program, folder, rounds, in_one_piece=in_one_piece)
    return found


def _line_rows(line_program: Path, folder: Path, rounds: int, *, in_one_piece: bool) -> list[Row]:
    shapes = [(lines, AXES_OF_A_LINE) for lines in LINES]
    loads = _measure(line_program, folder, shapes, rounds, in_one_piece=in_one_piece)
    found, one = [], loads[shapes[0]]
    for lines, axes in shapes:
        own = loads[lines, axes]
        targets = (0.97, 0.75) if lines == LINES[-1] else (None, None)
        what = f"{lines} line(s) of {axes} drives, replies {'in one piece' if in_one_piece else 'byte by byte'}"
        efficiency = _median(load.efficiency / base.efficiency for load, base in zip(own, one, strict=True))
        cost = _median(load.cpu_us / base.cpu_us for load, base in zip(own, one, strict=True))
        found += [
            Row(f"{what}: processor time of a poll", _median(load.cpu_us for load in own), "us"),
            Row(f"{what}: share of one processor", _median(load.core for load in own)),
            Row(f"{what}: efficiency / that of 1 line", efficiency, "", targets[0]),
            Row(f"{what}: processor time of a poll / that of 1 line", cost, "", targets[1], at_most=True),
            Row(f"{what}: the lines' own lateness, 99 %", _median(load.late_us for load in own), "us"),
        ]
    return found


def _measure(
    line_program: Path, folder: Path, shapes: list[tuple[int, int]], rounds: int, *, in_one_piece: bool
) -> dict[tuple[int, int], list[Load]]:
    """Run one daemon for each shape (lines, drives on each) in turn."""
    dice = random.Random(1)
    loads: dict[tuple[int, int], list[Load]] = {shape: [] for shape in shapes}
    with ExitStack() as stack:
        subjects = {}
        for shape in shapes:
            lines, axes = shape
            paced = stack.enter_context(
                paced_lines(line_program, lines=lines, modules=axes, ready_baud=0, burst=in_one_piece)
            )
            config, endpoint = folder / f"scaling-{lines}-{axes}.toml", free_endpoint()
            settings = {"modules": axes, "baud": BAUD, "hz": 2000.0, "items": ITEMS}
            config.write_text(config_text(*paced.terminals, uvloop=True, **settings))
            running = stack.enter_context(daemon(config, endpoint))
            stack.enter_context(subscriber(endpoint))
            subjects[shape] = Subject(f"{lines} x {axes}", running, paced)
            _until_polled(subjects[shape])
            subjects[shape].stop()
        for _ in range(rounds):
            for shape in dice.sample(shapes, len(shapes)):
                loads[shape].append(_round(subjects[shape]))
    return loads


def _until_polled(subject: Subject) -> None:
    """Wait until every line is up, 31 drives take a while; bounded."""
    for _ in range(60):
        subject.lines.figures()
        settle(0.5)
        if all(line.exchanges > LEAST_EXCHANGES for line in subject.lines.figures()):
            return
    raise RuntimeError(f"{subject.name}: not every line came up")


def _round(subject: Subject) -> Load:
    subject.resume()
    settle(SETTLE_S)
    cpu_s = subject.cpu_s()
    subject.lines.figures()
    settle(ROUND_S)
    figures = subject.lines.figures()
    cpu_s = subject.cpu_s() - cpu_s
    subject.stop()
    if not all(each.exchanges for each in figures):
        raise RuntimeError(f"{subject.name}: a line was silent for {ROUND_S} s")
    return Load(
        efficiency=statistics.fmean(each.efficiency for each in figures),
        cpu_us=cpu_s / sum(each.exchanges for each in figures) * 1e6,
        core=cpu_s / max(each.elapsed_s for each in figures),
        late_us=max(each.late_p99_us for each in figures),
    )


def _median(values) -> float:
    return statistics.median(values)
