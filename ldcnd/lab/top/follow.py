"""Keeping a view up to date with a daemon that may go away and come back."""

import asyncio

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import LdcndError
from ldcnd.lab.top.rig_view import Description, RigView

CHECK_PERIOD_S = 1.0
"""Period of queries for the daemon's description; everything else it publishes by itself."""


async def follow(client: RigClient, view: RigView) -> None:
    """Feed a view until cancelled; a daemon that does not answer is queried again."""
    loop = asyncio.get_running_loop()
    async with client.published(lambda sample: view.take(sample, loop.time())):
        instance = None
        while True:
            try:
                daemon = await client.daemon()
                if daemon.instance != instance:
                    for sample in await client.last_published():
                        view.take(sample, loop.time())
                    instance = daemon.instance
                view.describe(Description(daemon, tuple(await client.axes())))
            except LdcndError:
                pass  # the view shows how long the daemon has been silent
            await asyncio.sleep(CHECK_PERIOD_S)
