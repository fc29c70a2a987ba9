"""`ldcnd twin`: a simulated rig in the state of one that runs, to rehearse a program on it, and what came of it."""

import asyncio
import signal
import threading
from pathlib import Path

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.cli.output import on_end, show_lines
from ldcnd.cli.typed import NewFile
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError
from ldcnd.log import configure_logging
from ldcnd.testing.run_report import RunReport, watch_run
from ldcnd.testing.served import CONNECT, served_rig
from ldcnd.testing.twin import read_state


@click.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False), required=False)
@click.option("--at", "endpoint", help="Where the twin listens, such as tcp/127.0.0.1:7600; a free port when missing.")
@click.option("--report", type=NewFile(), help="Write what the run has done to this file, for --diff.")
@click.option(
    "--diff",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="Watch the rig itself instead, and say where its run differed from this report.",
)
@with_target
def twin(target: Target, file: Path | None, endpoint: str | None, report: Path | None, diff: Path | None) -> None:
    """Serve a simulated rig that stands as the running one does, until SIGTERM or SIGINT, and report what came of it.

    FILE is the configuration of the rig. Nothing of the rig changes: it is only read. Programs run on the twin
    unchanged when LDCND_CONNECT names its endpoint, which is printed first.
    """
    if diff:
        rehearsed = _read(diff)
        _show(target, target.run(_watched), report, rehearsed)
        return
    if file is None:
        raise click.UsageError("name the configuration of the rig, or a report with --diff")
    state = target.run(read_state)
    configure_logging(level="error")
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: ended.set())
    with served_rig(file, endpoint=endpoint, state=state) as served:
        show_lines(f"export {CONNECT}={served.endpoint}", "# the twin stands where the rig does; SIGINT ends it")
        done = served.watch(lambda: asyncio.to_thread(ended.wait))
    _show(target, done, report, None)


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


def _show(target: Target, done: RunReport, file: Path | None, rehearsed: RunReport | None) -> None:
    if file:
        file.write_text(done.model_dump_json(indent=2) + "\n", encoding="utf-8")
    lines = list(done.lines())
    if rehearsed:
        lines += list(rehearsed.differences(done)) or ["as it was rehearsed"]
    target.show(done, *lines)
