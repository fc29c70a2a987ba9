"""`ldcnd shadow`: the identified model beside the axis, from a process of its own."""

import asyncio
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.cli.ending import on_end
from ldcnd.cli.output import show_lines
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError

if TYPE_CHECKING:
    from ldcnd.bench.tuning.ldcn.watching import ShadowAlarm


@click.command()
@click.argument(
    "reports", metavar="REPORT...", nargs=-1, required=True, type=click.Path(path_type=Path, dir_okay=False)
)
@with_target
def command(target: Target, reports: tuple[Path, ...]) -> None:
    """Watch axes for friction, load and coupling (LDCN drives that report their position error), until SIGTERM.

    Each REPORT is what `ldcnd tune AXIS --json` has printed; it names the axis. The first 100 motions teach what is
    usual, and are kept on this host; later ones are compared. It takes no lease, moves nothing and stops nothing.
    Needs the extra `tune`.
    """
    if find_spec("numpy") is None:
        raise ConfigError("the shadow needs numpy; install it with: pip install 'ldcnd[tune]'")
    from ldcnd.bench.tuning.ldcn.watching import read_report, watch  # noqa: PLC0415 - needs an optional package

    plants = [read_report(path) for path in reports]
    twice = {plant.axis for plant in plants if [each.axis for each in plants].count(plant.axis) > 1}
    if twice:
        raise ConfigError(f"two reports are of axis {min(twice)}", value=min(twice), remedy="name the newer one only")

    async def work(client: RigClient) -> None:
        ending = asyncio.Event()
        on_end(ending.set)
        await watch(client, plants, lambda alarm: target.show(alarm, _line(alarm)), _tell, ending)

    target.run(work)


def _tell(line: str) -> None:
    show_lines(line, err=True)


def _line(alarm: "ShadowAlarm") -> str:
    at = datetime.fromtimestamp(alarm.t / 1e9, UTC).isoformat(timespec="seconds")
    if alarm.over:
        return f"{at} {alarm.axis}: {alarm.figure} is as usual again: {alarm.value:.3g} {alarm.unit}"
    low = "" if alarm.low is None else f"{alarm.low:.3g} to "
    return (
        f"{at} {alarm.axis}: {alarm.figure} is {alarm.value:.3g} {alarm.unit} over {alarm.motions} motions,"
        f" {alarm.latest:.3g} in the last five; usual is {alarm.usual:.3g}, allowed {low or 'up to '}{alarm.high:.3g}:"
        f" {alarm.meaning}"
    )
