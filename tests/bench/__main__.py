"""`python -m tests.bench`: measure, print a table, keep the figures as JSON."""

import argparse
import json
import logging
import platform
import sysconfig
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path

import structlog

from tests.bench import (
    bus_efficiency,
    client_sample,
    console,
    counts,
    interlock_cost,
    ports,
    ring_cost,
    round_trip,
    saturated_command,
    scaling,
    stops_under_load,
    system_calls,
    virtual_time,
)
from tests.bench.bus_efficiency import FLOOR, FLOORS, MINIMAL, Conditions, Result
from tests.bench.machine_speed import MachineSpeed
from tests.bench.processes import ROOT, TooBusy, build_programs
from tests.bench.report import LEAST_ROUNDS, Row, paired, table
from tests.bench.sources import NoCompiler

BUSY, BUSY_US = f"{FLOOR}: turn-around, 99 %", 1000
FAST, SLOW = Conditions(115_200), Conditions(19_200)
MORE = (
    Conditions(115_200, in_one_piece=True),
    Conditions(115_200, awake=True),
    Conditions(115_200, in_one_piece=True, awake=True),
)
EFFICIENCY = {
    (FAST, "uvloop"): 0.985,
    (FAST, "asyncio"): 0.97,
    (SLOW, "uvloop"): 0.99,
    (SLOW, "asyncio"): 0.99,
}
CPU_RATIO = dict.fromkeys((FAST, SLOW, *MORE), 1.6)
"""Processor time of an exchange, to that of the least that a Python program does."""
CONSOLE_S, CONSOLE_ROUNDS = 5.0, 3
PARTS = (
    "console",
    "115200",
    "19200",
    "one-piece",
    "awake",
    "one-piece-awake",
    "system-calls",
    "commands",
    "lines",
    "round-trip",
    "stops",
    "jumping-clock",
    "client",
    "counts",
    "interlocks",
    "ring",
    "ports",
)


def main() -> None:
    """Run the whole bench, or the parts of it that the options leave."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--rounds", type=int, default=45, help="short interleaved rounds at the full rate, fewer elsewhere"
    )
    parser.add_argument("--virtual-seconds", type=float, default=30.0, help="length of a run on the jumping clock")
    parser.add_argument("--before", type=Path, help="another checkout, whose daemon is measured in the same rounds")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=" ".join(PARTS))
    parser.add_argument("--json", type=Path, help="keep the figures here")
    options = parser.parse_args()
    if options.rounds < LEAST_ROUNDS:
        parser.error(f"--rounds {options.rounds}: {LEAST_ROUNDS} at least, fewer do not tell how well a ratio is known")
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))

    rows: list[Row] = []
    speed = MachineSpeed()
    with tempfile.TemporaryDirectory() as name:
        for part, measure in _parts(Path(name), options.rounds, options.virtual_seconds, options.before).items():
            if part in options.only:
                speed.look()
                try:
                    rows += measure()
                except (NoCompiler, TooBusy) as error:
                    print(f"{part} not measured: {error}", flush=True)
    speed.look()
    rows = speed.rows() + speed.judged(rows)
    print(table(rows))
    if any(row.name.endswith(BUSY) and row.value > BUSY_US for row in rows):
        print(f"{BUSY} is above {BUSY_US} us: others used this machine, and what depends on time says little")
    if options.json:
        optimised = "--enable-optimizations" in (sysconfig.get_config_var("CONFIG_ARGS") or "")
        machine = {
            "python": platform.python_version() + (", optimised build" if optimised else ", plain build"),
            "system": platform.platform(),
        }
        options.json.write_text(json.dumps({"machine": machine, "rows": [asdict(row) for row in rows]}, indent=2))


def _parts(folder: Path, rounds: int, virtual_s: float, before: Path | None) -> dict[str, Callable[[], list[Row]]]:
    """Return what measures each part; one that the machine is too busy for leaves the figures of the others."""
    fewer, slow = max(LEAST_ROUNDS, rounds // 2 + 1), max(LEAST_ROUNDS, rounds // 5)
    programs = cache(partial(build_programs, folder))

    def efficiency(conditions: Conditions, rounds: int) -> list[Row]:
        results = bus_efficiency.measure(programs(), folder, conditions, rounds, before)
        return [row for result in results for row in _efficiency_rows(result)]

    found: tuple[Callable[[], list[Row]], ...] = (
        partial(console.rows, folder, CONSOLE_S, CONSOLE_ROUNDS),
        partial(efficiency, FAST, rounds),
        partial(efficiency, SLOW, slow),
        *(partial(efficiency, each, rounds) for each in MORE),
        lambda: system_calls.rows(programs()[0], folder),
        lambda: saturated_command.rows(programs()[0], folder),
        lambda: scaling.rows(programs()[0], folder, fewer),
        round_trip.rows,
        stops_under_load.rows,
        partial(virtual_time.rows, virtual_s),
        client_sample.rows,
        partial(counts.rows, ROOT, before),
        interlock_cost.rows,
        ring_cost.rows,
        partial(ports.rows, virtual_s),
    )
    return dict(zip(PARTS, found, strict=True))


def _efficiency_rows(result: Result) -> list[Row]:
    conditions = result.conditions
    what = f"{conditions}, {result.subject}"
    rows = [
        Row(f"{what}: turn-around, median", result.turnaround_p50_us, "us"),
        Row(f"{what}: turn-around, 99 %", result.turnaround_p99_us, "us"),
        Row(f"{what}: processor time for each exchange", result.cpu_us, "us"),
    ]
    if result.subject in FLOORS:
        return [
            *rows,
            Row(f"{what}: share of one processor", result.core),
            Row(f"{what}: the line's own lateness, 99 %", result.line_late_p99_us, "us"),
        ]
    loop = result.subject.rpartition(" ")[2]
    return [
        *rows,
        paired(f"{what}: bus efficiency / floor", result.efficiency_ratios, EFFICIENCY.get((conditions, loop))),
        Row(f"{what}: the same by the wall clock", result.wall_ratio),
        paired(f"{what}: processor time / {MINIMAL}", result.cpu_ratios, CPU_RATIO.get(conditions), at_most=True),
        Row(f"{what}: share of one processor", result.core),
        Row(f"{what}: processor time for each sample", result.cpu_us_per_sample, "us"),
    ]


if __name__ == "__main__":
    main()
