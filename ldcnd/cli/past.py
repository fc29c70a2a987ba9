"""`ldcnd axis at`: where an axis was, by the daemon or by a recording."""

from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.quantities import decimals
from ldcnd.cli.there import axis_of
from ldcnd.cli.typed import Finite
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import Quality

OF_RECORDINGS = "ldcnd.lab.cli.record"
"""It is named, as in `names.COMMANDS`: what asks a daemon does without the wing."""


@click.command()
@click.argument("axis", type=AXIS)
@click.argument("instant", required=False)
@click.option("--to", "until", help="From INSTANT to this one: both, and every reading between them.")
@click.option("--ago", "ago_s", type=Finite(0, 600), help="In place of INSTANT: so many seconds ago.")
@click.option(
    "--recording",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Ask this MCAP file instead of a daemon.",
)
@with_target
def at(
    target: Target, axis: str, instant: str | None, until: str | None, ago_s: float | None, recording: Path | None
) -> None:
    """Show where AXIS was at INSTANT of the last 600 s, with bounds: RFC 3339, or UTC in ns since 1970."""
    if (instant is None) == (ago_s is None):
        raise click.UsageError("say INSTANT or --ago, one of them")
    said = instant or f"now(-{ago_s}s)"
    said = said if until is None else f"[{said}..{until}]"

    async def work(client: RigClient) -> tuple[list[AxisInstant], AxisInfo]:
        info = await axis_of(client, axis)
        return (await client.past(said, axis))[axis], info

    found, info = (
        target.run(work) if recording is None else import_module(OF_RECORDINGS).recorded(recording, axis, said)
    )
    for each in found:
        _show(target, axis, each, info, named=until is not None)


def _show(target: Target, axis: str, found: AxisInstant, info: AxisInfo, *, named: bool) -> None:
    when = f" {datetime.fromtimestamp(found.t / 1e9, UTC).isoformat(timespec='milliseconds')}" if named else ""
    if found.position is None or found.velocity is None:
        target.show(found, f"{axis}{when}: not known: {found.reason}")
        return
    place, speed, digits = found.position, found.velocity, decimals(info)
    target.show(
        found,
        f"{axis}{when}: {place.value:.{digits}f} {found.unit},"
        f" from {place.lower:.{digits}f} to {place.upper:.{digits}f}",
        f"  at {speed.value:.4g} {found.unit}/s, from {speed.lower:.4g} to {speed.upper:.4g}",
        *([f"  its data are {found.quality.value}"] if found.quality is not Quality.GOOD else []),
        *([] if found.referenced else ["  no place of the machine: the axis had no reference"]),
    )
