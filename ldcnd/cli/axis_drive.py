"""`ldcnd axis`: what the drive of an axis says of itself, and its counters."""

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.typed import axis_of
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import NotSupported
from ldcnd.contract.parameters import (
    AlarmReport,
    ClearCounter,
    CounterName,
    CounterReply,
    ReadAlarms,
    ReadMonitors,
)
from ldcnd.contract.samples import MonitorName, MonitorSample


@click.command()
@click.argument("axis", type=AXIS)
@with_target
def monitors(target: Target, axis: str) -> None:
    """Show the last values of the monitors of AXIS."""

    async def work(client: RigClient) -> dict[MonitorName, MonitorSample]:
        info = await axis_of(client, axis)
        if not info.monitors:
            raise NotSupported(f"axis {axis} has no monitors: its drive is a {info.model}", axis=axis)
        return await client.monitors(axis)

    for name, sample in target.run(work).items():
        high = f"  high: {', '.join(sample.high)}" if sample.high else ""
        target.show(sample, f"{name:22} {sample.value:8d} {sample.unit:14} {sample.title}{high}  ({sample.quality})")


@click.command()
@click.argument("axis", type=AXIS)
@with_target
def alarms(target: Target, axis: str) -> None:
    """Show the present alarm of AXIS and the history that its drive keeps."""

    async def work(client: RigClient) -> AlarmReport:
        await axis_of(client, axis)
        return await client.command(axis, ReadAlarms())

    reply = target.run(work)
    past = (f"  {place} {entry.code:04X}H {entry.text}" for place, entry in enumerate(reply.history))
    target.show(reply, f"{axis}: {reply.present.code:04X}H {reply.present.text}", *past)


@click.command("read-monitors")
@click.argument("axis", type=AXIS)
@click.argument("names", nargs=-1, metavar="[NAME]...", type=click.Choice([name.value for name in MonitorName]))
@with_target
def read_monitors(target: Target, axis: str, names: tuple[str, ...]) -> None:
    """Read monitors of AXIS once, published or not; all of them without a NAME."""
    command = ReadMonitors(monitors=tuple(MonitorName(name) for name in names))
    reply = target.run(lambda client: client.command(axis, command))
    for each in reply.readings:
        on = "" if each.active is None else f"  on: {', '.join(each.active) or 'none'}"
        high = f"  high: {', '.join(each.high)}" if each.high else ""
        target.show(each, f"{each.monitor:24} {each.value:>8} {each.unit:14}{each.title}{high}{on}")


@click.command("clear-counter")
@click.argument("axis", type=AXIS)
@click.argument("counter", type=click.Choice([name.value for name in CounterName]))
@with_target
def clear_counter(target: Target, axis: str, counter: str) -> None:
    """Set a pulse counter of AXIS to 0; command pulses must be stopped, and the motor must stand."""

    async def work(client: RigClient) -> CounterReply:
        await axis_of(client, axis)
        return await client.command(axis, ClearCounter(counter=CounterName(counter)))

    reply = target.run(work)
    remarks = "".join(f"; {remark}" for remark in reply.remarks)
    target.show(reply, f"{axis}: the {counter} counter is cleared and reads {reply.value}{remarks}")
