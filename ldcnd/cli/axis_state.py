"""`ldcnd axis`: what axes are, and where they are."""

from datetime import UTC, datetime

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.quantities import decimals, sample_text, state_word
from ldcnd.cli.typed import Whole, axis_of
from ldcnd.client.rig_client import RigClient
from ldcnd.model.meta import AxisInfo
from ldcnd.model.samples import PositionSample, StateSample, TelemetryItem


@click.command("list")
@with_target
def list_axes(target: Target) -> None:
    """Show every axis with its state and position."""

    async def work(client: RigClient) -> tuple[list[AxisInfo], dict[str, StateSample], dict[str, PositionSample]]:
        return await client.axes(), await client.states(), await client.positions()

    axes, states, positions = target.run(work)
    for axis in axes:
        state, position = states.get(axis.axis), positions.get(axis.axis)
        where = f"{position.value:12.{decimals(axis)}f} {axis.unit}" if position else "?"
        what = state_word(state) if state else "unknown"
        target.show(axis, f"{axis.axis:8} {axis.model:14} {axis.bus}/{axis.address:<4} {where:20} {what}")


@click.command()
@click.argument("axis", type=AXIS)
@with_target
def faults(target: Target, axis: str) -> None:
    """Show the faults that AXIS has had, oldest first; `ldcnd fault CODE` explains them."""
    for each in target.run(lambda client: axis_of(client, axis)).past_faults:
        at = datetime.fromtimestamp(each.since / 1e9, UTC).isoformat(timespec="milliseconds")
        target.show(each, f"{at} {each.code:16} {each.source:7} {each.text}")


@click.command()
@click.argument("axis", type=AXIS, default="*")
@click.option("--item", type=click.Choice([item.value for item in TelemetryItem]), help="Only this item.")
@click.option("--count", type=Whole(min=1), help="End after this many samples.")
@with_target
def watch(target: Target, axis: str, item: str | None, count: int | None) -> None:
    """Show the telemetry of AXIS, an axis or an I/O module (or of all), as it comes."""

    async def work(client: RigClient) -> None:
        if axis != "*" and axis not in {module.name for bus in await client.buses() for module in bus.modules}:
            await axis_of(client, axis)
        seen = 0
        async with client.samples(axis, item or "*") as samples:
            async for name, sample in samples:
                target.show(sample, f"{name:8} {sample_text(sample)}")
                seen += 1
                if seen == count:
                    return

    target.run(work)
