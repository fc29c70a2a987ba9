"""`ldcnd twin`: a simulated rig in the state of one that runs, to rehearse a program on it, and what came of it."""

import asyncio
import signal
import sys
import threading
import traceback
from pathlib import Path

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.cli.output import on_end, show_lines
from ldcnd.cli.typed import CONFIGURATION, NewFile
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError
from ldcnd.log import configure_logging
from ldcnd.parts import require
from ldcnd.sim.plant import PlantConfig
from ldcnd.testing.rig import run, simulated_rig
from ldcnd.testing.run_report import RunReport, rehearse, watch_run
from ldcnd.testing.served import CONNECT, served_rig
from ldcnd.testing.twin import RigState, read_state


@click.command()
@click.argument("file", type=CONFIGURATION, required=False)
@click.argument("arguments", nargs=-1)
@click.option("--at", "endpoint", help="Where the twin listens, such as tcp/127.0.0.1:7600; a free port when missing.")
@click.option(
    "--fast",
    "program",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="Run this Python program with ARGUMENTS at the pace of its waits instead: a night in minutes.",
)
@click.option(
    "--plant",
    "plants",
    type=click.Path(path_type=Path, dir_okay=False),
    multiple=True,
    help="What `ldcnd tune AXIS --json` has printed: its machine is on the shaft of that axis. May be repeated.",
)
@click.option("--report", type=NewFile(), help="Write what the run has done to this file, for --diff.")
@click.option(
    "--diff",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="Watch the rig itself instead, and say where its run differed from this report; exits with 1 if it did.",
)
@with_target
def twin(
    target: Target,
    file: Path | None,
    arguments: tuple[str, ...],
    endpoint: str | None,
    program: Path | None,
    plants: tuple[Path, ...],
    report: Path | None,
    diff: Path | None,
) -> None:
    """Serve a simulated rig that stands as the running one does, until SIGTERM or SIGINT, and report what came of it.

    FILE is the configuration of the rig. Nothing of the rig changes: it is only read. Programs run on the twin
    unchanged when LDCND_CONNECT names its endpoint, which is printed first. With --fast, the program is one of
    `ldcnd.open` or `ldcnd.connect`; its clock, `time.sleep` and `asyncio.run` are those of the twin.
    """
    if diff:
        rehearsed = _read(diff)
        differs = _show(target, target.run(_watched), report, rehearsed)
        sys.exit(1 if differs else 0)
    if file is None:
        raise click.UsageError("name the configuration of the rig, or a report with --diff")
    if arguments and not program:
        raise click.UsageError(f"{arguments[0]} is for a program: name that with --fast")
    machines = _plants(plants)
    if not (target.connect or target.listen or target.config) and file.suffix == ".toml":
        target = Target.given((), (), file, target.rig, as_json=target.as_json)  # the rig that has this configuration
    state = target.run(lambda client: read_state(client, machines))
    configure_logging(level="error")
    if program:
        done, failure = run(_fast(file, state, program, arguments))
        _show(target, done, report, None)
        if failure:
            traceback.print_exception(failure)
            sys.exit(1)
        return
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: ended.set())
    with served_rig(file, endpoint=endpoint, state=state) as served:
        show_lines(
            f"export {CONNECT}={served.endpoint}",
            "# the twin stands where the rig does; SIGINT ends it",
            *(f"# an old program finds the port {name} at {link}" for name, link in served.ports.items()),
        )
        done = served.watch(lambda: asyncio.to_thread(ended.wait))
    _show(target, done, report, None)


def _plants(files: tuple[Path, ...]) -> dict[str, PlantConfig]:
    if not files:
        return {}
    require("numpy")
    from ldcnd.bench.tuning.watching import machine_of, read_report  # noqa: PLC0415 - needs an optional package

    return {report.axis: machine_of(report) for report in map(read_report, files)}


async def _fast(
    file: Path, state: RigState, program: Path, arguments: tuple[str, ...]
) -> tuple[RunReport, Exception | None]:
    async with simulated_rig(file, state=state) as rig:
        return await rehearse(rig, program, arguments)


async def _watched(client: RigClient) -> RunReport:
    ended = asyncio.Event()
    on_end(ended.set)
    show_lines("# watching the rig; SIGINT ends it")
    return await watch_run(client, ended.wait())


def _read(file: Path) -> RunReport:
    try:
        return RunReport.model_validate_json(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{file} is no report of a run: {error}", remedy="make one with `ldcnd twin FILE --report`"
        ) from error


def _show(target: Target, done: RunReport, file: Path | None, rehearsed: RunReport | None) -> bool:
    """Print and write what a run has done; tell whether it differed from what was rehearsed."""
    if file:
        file.write_text(done.model_dump_json(indent=2) + "\n", encoding="utf-8")
    lines = list(done.lines())
    differences = list(rehearsed.differences(done)) if rehearsed else []
    if rehearsed:
        lines += differences or ["as it was rehearsed"]
    target.show(done, *lines)
    return bool(differences)
