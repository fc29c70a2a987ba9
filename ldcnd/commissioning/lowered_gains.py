"""Gains of a step for its own time: the old ones are on the disk before others are in the drive, and come back."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

from ldcnd.client.axis import Axis
from ldcnd.client.rig import Rig
from ldcnd.commissioning.step import Site, open_loop
from ldcnd.errors import LdcndError, WrongState
from ldcnd.model.meta import AxisInfo

REGISTERS = ("kp", "kd", "ki", "il", "ol", "cl", "el", "sr", "deadband")
NEEDED = frozenset({"kp", "kd", "ki", "il", "ol", "el"})
PUT_BACK_S = 15.0
"""Longest time that the old gains may take to come back, seconds."""


@asynccontextmanager
async def lowered_gains(site: Site, axis: Axis) -> AsyncIterator[dict[str, int]]:
    """Open the loop, yield the gains that the drive has, and put them back at the end, whatever ends the context.

    The loop is open afterwards. Where control was lost meanwhile they stay as they are: `put_back` does it later.

    Raises:
        WrongState: the gains are not known, or the axis does not come to rest.
        LdcndError: as the daemon refused it.
    """
    await open_loop(axis)
    await axis.set_gains()  # a drive that was not powered on since its reset has none yet
    info = next(each for each in await site.rig.describe() if each.axis == axis.name)
    old = gains_in(info)
    site.keep_gains(old)
    try:
        yield old
    finally:
        with suppress(LdcndError, TimeoutError):
            async with asyncio.timeout(PUT_BACK_S):
                await _restore(axis, old)
                site.keep_gains(None)


async def put_back(rig: Rig, axis: str, gains: dict[str, int], keep: Callable[[None], None]) -> None:
    """Put gains back that a step has left in the drive, under control of its own; the loop is open afterwards.

    Raises:
        LdcndError: as the daemon refused it; they are still to be put back.
        TimeoutError: it takes too long; likewise.
    """
    async with asyncio.timeout(PUT_BACK_S), rig.control(axis, client="ldcnd commission") as held:
        await _restore(held, gains)
        keep(None)


def gains_in(info: AxisInfo) -> dict[str, int]:
    """Return the gains that a drive has, as its daemon knows them.

    Raises:
        WrongState: it does not know them.
    """
    known = {each.name: each.value for each in info.registers if each.name in REGISTERS and each.value is not None}
    if not known.keys() >= NEEDED:
        raise WrongState(
            f"axis {info.axis}: the gains that it has are not known, so they could not be put back",
            axis=info.axis,
            remedy="give it `gains` in the configuration",
        )
    return known


async def _restore(axis: Axis, gains: dict[str, int]) -> None:
    await open_loop(axis)  # a closed loop would make a jump of any position error
    await axis.set_gains(**gains)
