"""`ldcnd lease`: who controls which axis, and control for as long as a program runs."""

import asyncio
import os
import shlex
import sys

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.sending import NAME
from ldcnd.cli.typed import Finite, axis_of
from ldcnd.client.lease import control
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import LeaseExpired
from ldcnd.contract.leases import ListHolders


@click.group()
def command() -> None:
    """See who controls which axis, and take control."""


@command.command("list")
@with_target
def list_holders(target: Target) -> None:
    """Show who controls each axis."""
    reply = target.run(lambda client: client.ask(ListHolders()))
    needed = "a motion needs control" if reply.required else "an axis that is not controlled is open to all"
    lines = [f"{each.axis:8} {each.client or 'not controlled'}" for each in reply.holders]
    target.show(reply, *lines, f"({needed})")


@command.command(context_settings={"allow_interspersed_args": False})
@click.option("--axis", "axes", type=AXIS, multiple=True, help="This axis; may be repeated. All axes when missing.")
@click.option("--name", default=NAME, show_default=True, help="Who holds it, for people.")
@click.option(
    "--seconds",
    "lease_s",
    type=Finite(0.2, 60),
    default=2.0,
    show_default=True,
    help="The daemon applies `loss.client` so soon when this program disappears.",
)
@click.option("--force", is_flag=True, help="Take control from its holder.")
@click.argument("program", nargs=-1, metavar="[-- PROGRAM...]")
@with_target
def hold(
    target: Target, axes: tuple[str, ...], name: str, lease_s: float, program: tuple[str, ...], *, force: bool
) -> None:
    """Hold control until Ctrl-C, or for as long as PROGRAM runs.

    The lease is printed, and in $LDCND_LEASE of PROGRAM, where all commands of ldcnd find it.
    """

    async def work(client: RigClient) -> int:
        for axis in axes:
            await axis_of(client, axis)
        async with control(client, name, *axes, lease_s=lease_s, force=force) as held:
            if program:
                environment = {**os.environ, "LDCND_LEASE": held.lease.lease}
                running = await asyncio.create_subprocess_exec(*program, env=environment)
                return await running.wait()
            target.show(held.lease, f"{held.lease.lease}  controls {', '.join(held.lease.axes)}; Ctrl-C releases it")
            await held.over.wait()
            why = f": {held.lost.message}" if held.lost else ""
            raise LeaseExpired(f"control is lost{why}", remedy="hold it again")

    try:
        code = target.run(work)
    except FileNotFoundError as error:
        raise click.UsageError(f"{shlex.join(program)}: {error.strerror}") from error
    sys.exit(code)
