"""What a poll costs the processor with more items, with more drives on a line, and with more lines in a process."""

import random
import statistics
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from tests.bench.processes import (
    Subject,
    TooBusy,
    Turn,
    config_text,
    daemon,
    free_endpoint,
    paced_lines,
    settle,
    subscriber,
)
from tests.bench.report import Row, paired

AXES = (1, 4, 16, 31)
LINES = (1, 2, 4, 8)
AXES_OF_A_LINE = 8
BAUD = 115_200
ALL_ITEMS = ("position", "velocity", "adc", "state")
ITEMS = ALL_ITEMS[:3]
LEAST_EXCHANGES = 10
"""A line that is polled has more in half a second, however busy the machine is."""
LATE_US = 100.0
"""Lines that are later than this in one of a hundred bytes measure themselves."""


@dataclass(frozen=True, slots=True)
class Shape:
    """What one daemon has to do."""

    lines: int = 1
    axes: int = AXES_OF_A_LINE
    items: tuple[str, ...] = ITEMS


@dataclass(frozen=True, slots=True)
class Load:
    """One daemon in one round: the mean efficiency of its lines, and what a poll cost."""

    efficiency: float
    cpu_us: float
    core: float
    late_us: float


def rows(line_program: Path, folder: Path, rounds: int) -> list[Row]:
    """Measure one line with more and more items, then drives, then more and more lines of 8 drives."""
    found = _item_rows(line_program, folder, rounds) + _axis_rows(line_program, folder, rounds)
    for in_one_piece in (False, True):
        found += _line_rows(line_program, folder, rounds, in_one_piece=in_one_piece)
    return found


def _item_rows(line_program: Path, folder: Path, rounds: int) -> list[Row]:
    shapes = [Shape(items=ALL_ITEMS[:count]) for count in range(1, len(ALL_ITEMS) + 1)]
    loads = _measure(line_program, folder, shapes, rounds, in_one_piece=True)
    found, one = [], loads[shapes[0]]
    for shape in shapes:
        own, count = loads[shape], len(shape.items)
        what = f"1 line of 8 drives, {count} item(s) a poll"
        found.append(Row(f"{what}: processor time of a poll", _median(load.cpu_us for load in own), "us"))
        if count > 1:
            shares = [load.cpu_us / count / base.cpu_us for load, base in zip(own, one, strict=True)]
            found.append(paired(f"{what}: processor time for each item / with one", shares, 1.0, at_most=True))
    return found


def _axis_rows(line_program: Path, folder: Path, rounds: int) -> list[Row]:
    shapes = [Shape(axes=axes) for axes in AXES]
    loads = _measure(line_program, folder, shapes, rounds, in_one_piece=True)
    return [
        Row(
            f"1 line, {shape.axes} drive(s): processor time of a poll",
            _median(load.cpu_us for load in loads[shape]),
            "us",
        )
        for shape in shapes
    ]


def _line_rows(line_program: Path, folder: Path, rounds: int, *, in_one_piece: bool) -> list[Row]:
    shapes = [Shape(lines) for lines in LINES]
    loads = _measure(line_program, folder, shapes, rounds, in_one_piece=in_one_piece)
    found, one = [], loads[shapes[0]]
    for shape in shapes:
        own = loads[shape]
        efficiency, cost, core = (0.98, 0.75, 0.6) if shape is shapes[-1] else (None, None, None)
        delivery = "in one piece" if in_one_piece else "byte by byte"
        what = f"{shape.lines} line(s) of {shape.axes} drives, replies {delivery}"
        pairs = list(zip(own, one, strict=True))
        efficiencies = [load.efficiency / base.efficiency for load, base in pairs]
        costs = [load.cpu_us / base.cpu_us for load, base in pairs]
        late_us = _median(load.late_us for load in own)
        doubt = f"the lines themselves were late by {late_us:.0f} us" if late_us > LATE_US else ""
        found += [
            Row(f"{what}: processor time of a poll", _median(load.cpu_us for load in own), "us"),
            Row(
                f"{what}: share of one processor",
                _median(load.core for load in own),
                "",
                core,
                at_most=True,
                doubt=doubt,
            ),
            replace(paired(f"{what}: efficiency / that of 1 line", efficiencies, efficiency), doubt=doubt),
            paired(f"{what}: processor time of a poll / that of 1 line", costs, cost, at_most=True),
            Row(f"{what}: the lines' own lateness, 99 %", late_us, "us"),
        ]
    return found


def _measure(
    line_program: Path, folder: Path, shapes: list[Shape], rounds: int, *, in_one_piece: bool
) -> dict[Shape, list[Load]]:
    """Run one daemon for each shape in turn."""
    dice = random.Random(1)
    loads: dict[Shape, list[Load]] = {shape: [] for shape in shapes}
    with ExitStack() as stack:
        subjects: dict[Shape, Subject] = {}
        for shape in shapes:
            paced = stack.enter_context(
                paced_lines(line_program, lines=shape.lines, modules=shape.axes, ready_baud=0, burst=in_one_piece)
            )
            config, endpoint = folder / f"scaling-{len(subjects)}.toml", free_endpoint()
            rig = config_text(
                *paced.terminals, uvloop=True, modules=shape.axes, baud=BAUD, hz=2000.0, items=shape.items
            )
            config.write_text(rig)
            running = stack.enter_context(daemon(config, endpoint))
            stack.enter_context(subscriber(endpoint))
            subjects[shape] = Subject(str(shape), running, paced)
            _until_polled(subjects[shape])
            subjects[shape].stop()
        for _ in range(rounds):
            for shape in dice.sample(shapes, len(shapes)):
                loads[shape].append(_load(subjects[shape].turn(BAUD)))
    return loads


def _until_polled(subject: Subject) -> None:
    """Wait until every line is up, 31 drives take a while; bounded."""
    for _ in range(60):
        subject.lines.figures()
        settle(0.5)
        if all(line.exchanges > LEAST_EXCHANGES for line in subject.lines.figures()):
            return
    raise TooBusy(f"{subject.name}: not every line came up")


def _load(turn: Turn) -> Load:
    return Load(
        efficiency=statistics.fmean(line.efficiency for line in turn.lines),
        cpu_us=turn.cpu_us,
        core=turn.cpu_s / max(line.elapsed_s for line in turn.lines),
        late_us=max(line.late_p99_us for line in turn.lines),
    )


def _median(values) -> float:
    return statistics.median(values)
