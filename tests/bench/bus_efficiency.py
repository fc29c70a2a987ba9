"""How much of the line the whole daemon uses, and what it costs, against two floors in interleaved rounds.

How well the line is used is compared with a program in C. What that costs the processor is compared with the least that
a Python program does (`tests.bench.minimal_master`): the same interpreter, the same sort of system calls, so that the
ratio says what our code adds, on any machine and at any hour.
"""

import random
import statistics
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

from ldcnd.daemon.service import held_awake
from tests.bench.processes import (
    PIC_SERVO,
    ROOT,
    SUBJECT_CPU,
    Subject,
    Turn,
    config_text,
    daemon,
    free_endpoint,
    paced_lines,
    process,
    subscriber,
)

MODULES = 8
ITEMS = ("position", "velocity", "adc", "state")
"""What is published of each poll: with the faults, which come with the state, five topics."""
STATUS_ITEMS, REPLY_BYTES = 0x0F, 10
"""What a poll for these items asks a PIC-SERVO for, and what comes back."""
FLOOR = "C floor"
MINIMAL = "minimal Python master"
FLOORS = (FLOOR, MINIMAL)


@dataclass(frozen=True, slots=True)
class Conditions:
    """Under which all subjects are measured.

    Attributes:
        baud: of the lines.
        in_one_piece: a reply arrives at its end, as from an adapter on USB, and not byte by byte.
        awake: the processor is kept out of idle states that take long to leave.
    """

    baud: int
    in_one_piece: bool = False
    awake: bool = False

    def __str__(self) -> str:
        in_one_piece = ", replies in one piece" if self.in_one_piece else ""
        return f"{self.baud} baud{in_one_piece}{', processor held awake' if self.awake else ''}"


@dataclass(frozen=True, slots=True)
class Round:
    """One subject in one round."""

    exchanges_per_s: float
    efficiency: float
    wall_efficiency: float
    turnaround_p50_us: float
    turnaround_p99_us: float
    cpu_us: float
    line_late_p99_us: float
    samples: float = 0.0

    @property
    def core(self) -> float:
        """Share of a processor at the rate that the median turn-around allows, however often others came between."""
        return self.cpu_us / 1e6 * self.exchanges_per_s * self.efficiency / self.wall_efficiency


@dataclass(frozen=True, slots=True)
class Result:
    """Medians over all rounds, and the ratios within each round.

    Attributes:
        efficiency_ratios: to the floor in C.
        cpu_ratios: to the minimal master in Python.
    """

    conditions: Conditions
    subject: str
    exchanges_per_s: float
    efficiency: float
    efficiency_ratios: list[float]
    wall_ratio: float
    turnaround_p50_us: float
    turnaround_p99_us: float
    cpu_us: float
    cpu_ratios: list[float]
    cpu_us_per_sample: float
    core: float
    line_late_p99_us: float


def measure(
    programs: tuple[Path, Path], folder: Path, conditions: Conditions, rounds: int, before: Path | None
) -> list[Result]:
    """Run both floors, daemon on asyncio and daemon on uvloop side by side; and the daemon of another checkout."""
    line_program, floor_program = programs
    baud = conditions.baud
    new_line = partial(
        paced_lines, line_program, modules=MODULES, burst=conditions.in_one_piece, drive=PIC_SERVO, ready_baud=0
    )
    with ExitStack() as stack:
        stack.enter_context(held_awake(wanted=conditions.awake))
        line = stack.enter_context(new_line(ready_baud=baud))
        command = (floor_program, *line.terminals, str(baud), str(MODULES), str(STATUS_ITEMS), str(REPLY_BYTES))
        running = stack.enter_context(process(command, cpu=SUBJECT_CPU, nice=-10))
        subjects = [Subject(FLOOR, running, line)]
        line = stack.enter_context(new_line(ready_baud=baud))
        endpoint = free_endpoint()
        arguments = (*line.terminals, str(baud), str(MODULES), str(STATUS_ITEMS), endpoint)
        command = (sys.executable, "-m", "tests.bench.minimal_master", *arguments)
        running = stack.enter_context(process(command, cpu=SUBJECT_CPU, nice=-10))
        subjects.append(Subject(MINIMAL, running, line, stack.enter_context(subscriber(endpoint))))
        for subject in subjects:
            subject.stop()
        checkouts = [("ldcnd", ROOT), *([("before", before)] if before else [])]
        for number, ((code, root), loop) in enumerate(product(checkouts, ("asyncio", "uvloop"))):
            name, uvloop = f"{code}, {loop}", loop == "uvloop"
            line = stack.enter_context(new_line())
            config = folder / f"bench-{baud}-{number}.toml"
            rig = config_text(
                *line.terminals, uvloop=uvloop, modules=MODULES, baud=baud, hz=2000.0, items=ITEMS, drive=PIC_SERVO
            )
            config.write_text(rig)
            endpoint = free_endpoint()
            running = stack.enter_context(daemon(config, endpoint, root))
            subjects.append(Subject(name, running, line, stack.enter_context(subscriber(endpoint))))
            subjects[-1].stop()
        return _summary(conditions, _rounds(subjects, rounds, baud))


def _rounds(subjects, rounds, baud) -> list[dict[str, Round]]:
    dice = random.Random(1)
    done = []
    for _ in range(rounds):
        order = subjects[:]
        dice.shuffle(order)
        done.append({subject.name: _round(subject.turn(baud)) for subject in order})
    return done


def _round(turn: Turn) -> Round:
    (line,) = turn.lines
    return Round(
        exchanges_per_s=line.exchanges / line.elapsed_s,
        efficiency=line.efficiency,
        wall_efficiency=line.wall_efficiency,
        turnaround_p50_us=line.turnaround_p50_us,
        turnaround_p99_us=line.turnaround_p99_us,
        cpu_us=turn.cpu_us,
        line_late_p99_us=line.late_p99_us,
        samples=turn.samples / line.exchanges,
    )


def _summary(conditions: Conditions, rounds: list[dict[str, Round]]) -> list[Result]:
    results = []
    for name in rounds[0]:
        own = [each[name] for each in rounds]
        pairs = [(each[name], each[FLOOR]) for each in rounds]
        results.append(
            Result(
                conditions=conditions,
                subject=name,
                exchanges_per_s=_median(each.exchanges_per_s for each in own),
                efficiency=_median(each.efficiency for each in own),
                efficiency_ratios=[each.efficiency / base.efficiency for each, base in pairs],
                wall_ratio=_median(each.wall_efficiency / base.wall_efficiency for each, base in pairs),
                turnaround_p50_us=_median(each.turnaround_p50_us for each in own),
                turnaround_p99_us=_median(each.turnaround_p99_us for each in own),
                cpu_us=_median(each.cpu_us for each in own),
                cpu_ratios=[each[name].cpu_us / each[MINIMAL].cpu_us for each in rounds],
                cpu_us_per_sample=_median(each.cpu_us / (each.samples or 1) for each in own),
                core=_median(each.core for each in own),
                line_late_p99_us=_median(each.line_late_p99_us for each in own),
            )
        )
    return sorted(results, key=lambda result: (result.subject not in FLOORS, result.subject))


def _median(values) -> float:
    return statistics.median(values)
