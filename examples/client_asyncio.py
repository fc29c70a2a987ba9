"""Move an axis under a lease and follow it, with the asyncio client: `client_asyncio.py [ENDPOINT [AXIS]]`."""

import asyncio
import sys

from ldcnd.client.connecting import at, open_rig
from ldcnd.client.lease import control
from ldcnd.client.progress import follow
from ldcnd.errors import LdcndError
from ldcnd.model.commands import MoveAbsolute, Power


async def main(endpoint: str = "tcp/127.0.0.1:7447", axis: str = "x") -> None:
    """Move an axis to 5 and show how far it is, then ask for too much."""
    # the lease is renewed by itself; the axis halts when this program disappears
    async with open_rig(at(endpoint)) as rig, control(rig, "example", axis, lease_s=1.0) as held:
        await held.command(axis, Power(on=True))
        move = await held.command(axis, MoveAbsolute(position=5.0, velocity=2.0))
        async with follow(rig, move) as motion:
            async for step in motion:
                print(f"{step.position:8.3f} {step.unit}, {step.left:8.3f} to go")
        print("ended:", motion.end.state, motion.end.last_error or "as asked")
        try:
            await held.command(axis, MoveAbsolute(position=1e6))
        except LdcndError as error:
            print("refused:", error.code, error.message)


asyncio.run(main(*sys.argv[1:]))
