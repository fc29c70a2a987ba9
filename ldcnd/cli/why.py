"""`ldcnd why`: what is in the way of a motion."""

import sys

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.output import typed
from ldcnd.cli.typed import axis_of
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.codec import remedy_of
from ldcnd.contract.commands import Why, WhyReply


@click.command()
@click.argument("axis", type=AXIS)
@with_target
def command(target: Target, axis: str) -> None:
    """Tell why AXIS cannot move now, and what would clear that; exits with 1 when something is in the way."""

    async def work(client: RigClient) -> WhyReply:
        await axis_of(client, axis)
        return await client.ask(Why(), axis)

    reply = target.run(work)
    lines = [f"{axis}: {'ready to move' if reply.can_move else 'cannot move now'}"]
    for cause in reply.causes:
        known = remedy_of(cause)
        remedy = known and known.phrased(lambda step: typed(step, axis))
        lines.append(f"  {cause.text}{f': {remedy}' if remedy else ''}")
        if cause.page:
            lines.append(f"    more: ldcnd fault {cause.page.rpartition('/')[2]}")
    if reply.first_fault:
        lines.append(f"  first fault since the last reset: {reply.first_fault}")
    target.show(reply, *lines)
    if not reply.can_move:
        sys.exit(1)
