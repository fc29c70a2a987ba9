"""Waiting for an axis: until it has said where it is, and until it stands."""

import asyncio

from ldcnd.client.axis import Axis
from ldcnd.contract.errors import SessionError, WrongState
from ldcnd.contract.samples import Moving

REST_S = 5.0
"""Longest time that an axis takes to come to rest, or to be heard of, seconds."""
CHECK_PERIOD_S = 0.05


async def seen(axis: Axis) -> Axis:
    """Wait for the first state and position of an axis; return it.

    Raises:
        SessionError: nothing is received from it.
    """
    deadline_s = asyncio.get_running_loop().time() + REST_S
    while True:
        try:
            _ = axis.state, axis.position
        except SessionError:
            if asyncio.get_running_loop().time() > deadline_s:
                raise
            await axis.news(CHECK_PERIOD_S)
        else:
            return axis


async def at_rest(axis: Axis) -> None:
    """Wait until an axis stands.

    Raises:
        WrongState: it does not come to rest.
    """
    try:
        async with asyncio.timeout(REST_S):
            while axis.state.moving is not Moving.NO:
                await axis.news(CHECK_PERIOD_S)
    except TimeoutError:
        raise WrongState(
            f"axis {axis.name} does not come to rest within {REST_S:g} s",
            axis=axis.name,
            remedy="look for a load that moves it, then give the command again",
        ) from None
