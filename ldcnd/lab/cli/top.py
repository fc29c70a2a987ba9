"""`ldcnd top`: every axis and line of a rig on one screen."""

import asyncio
import sys

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.client.rig_client import RigClient
from ldcnd.lab.top.columns import as_text
from ldcnd.lab.top.follow import follow
from ldcnd.lab.top.glance import RigGlance
from ldcnd.lab.top.rig_view import RigView
from ldcnd.parts import require

ENOUGH_S = 2.5
"""Two reports of each line come in this time, so rates are known."""


@click.command()
@with_target
def command(target: Target) -> None:
    """Show every axis and line of a rig, what is wrong first; S or Esc stops its axes, Q quits.

    Without a terminal, or with --json, the rig is printed once. The stop is no emergency stop.
    """
    if target.as_json or not sys.stdout.isatty():
        glance = target.run(_once)
        target.show(glance, *as_text(glance))
        return
    target.run(_watch)


async def _once(client: RigClient) -> RigGlance:
    loop = asyncio.get_running_loop()
    view = RigView(client.rig, loop.time())
    async with asyncio.TaskGroup() as group:
        following = group.create_task(follow(client, view), name="follow")
        await asyncio.sleep(ENOUGH_S)
        following.cancel()
    return view.glance(loop.time())


async def _watch(client: RigClient) -> None:
    require("textual")
    from ldcnd.lab.top.screen import TopScreen  # noqa: PLC0415 - needs an optional package

    await TopScreen(client).run_async()
