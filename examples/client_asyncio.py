"""Move an axis under control and follow it, with the asyncio client: `client_asyncio.py [ENDPOINT [AXIS]]`."""

import asyncio
import sys

import ldcnd


async def main(endpoint: str | None = None, axis: str = "x") -> None:
    """Move an axis to 5 and show how far it is, then ask for too much."""
    # control is a lease that renews itself; the axis halts when this program disappears
    async with ldcnd.connect(endpoint) as rig, rig.control(axis, client="example", lease_s=1.0) as x:
        await x.power(on=True)
        move = await x.move_absolute(5, velocity=2)
        async for step in move:
            print(f"{step.position:8.3f} {step.unit}, {step.left:8.3f} to go")
        print("ended:", await move.done())
        try:
            await x.move_absolute(1e6)
        except ldcnd.LdcndError as error:
            print("refused:", error.code, error.message)


asyncio.run(main(*sys.argv[1:]))
