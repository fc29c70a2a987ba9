"""Commands for a whole rig: stop, reset, power and the speed override."""

import sys

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.output import FAILED, show_lines
from ldcnd.cli.sending import NAME, Sender, commanding
from ldcnd.client.rig_client import RigClient
from ldcnd.model.commands import Power, Reset, StopReply


def stop_rig(target: Target, axis: str | None) -> None:
    """Stop one axis or all, and say which drives have confirmed it."""

    async def work(client: RigClient) -> StopReply:
        return await client.stop(axis, client=NAME)

    # a rig that is named is not searched for first: the stop is what reaches it first
    rig = target.rig
    reply = target.run_session(lambda session: work(RigClient(session, rig))) if rig else target.run(work)
    unconfirmed = sorted(set(reply.axes) - set(reply.confirmed))
    target.show(reply, f"stopped and latched: {', '.join(reply.confirmed) or 'none'}")
    if unconfirmed:
        show_lines(
            f"NOT confirmed: {', '.join(unconfirmed)}; the latch holds, look at the machine, use its emergency stop",
            err=True,
        )
        sys.exit(FAILED)


@click.command()
@click.argument("axis", type=AXIS, required=False)
@with_target
def stop(target: Target, axis: str | None) -> None:
    """Stop AXIS, or every axis of the rig, and latch: nothing moves again before `ldcnd reset`.

    It needs no lease and works in any state. It is no emergency stop.
    """
    stop_rig(target, axis)


@click.command()
@click.argument("axes", type=AXIS, nargs=-1, metavar="[AXIS]...")
@commanding
def reset(sender: Sender, axes: tuple[str, ...]) -> None:
    """Clear stop latches and faults of each AXIS, or of all axes; nothing moves."""
    sender.send_to_all(axes, Reset())


@click.command()
@click.argument("switch", type=click.Choice(["on", "off"]))
@click.argument("axes", type=AXIS, nargs=-1, metavar="[AXIS]...")
@commanding
def power(sender: Sender, switch: str, axes: tuple[str, ...]) -> None:
    """Close (on) or open (off) the position loops of each AXIS, or of all axes; nothing moves."""
    sender.send_to_all(axes, Power(on=switch == "on"))
