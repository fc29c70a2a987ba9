"""Whether an axis stands, as its states tell: one rule and one time-out for all who wait for it."""

import asyncio
from collections.abc import Awaitable, Callable

from ldcnd.contract.errors import OutcomeUnknown, Remedy, WrongState, step
from ldcnd.contract.samples import LinkState, Moving, StateSample

REST_S = 10.0
"""Longest time that an axis takes to come to rest, or to be heard of, seconds."""
PATIENCE_S = 10.0
"""Time without samples after which nothing is known of an axis any more, seconds."""


async def until_at_rest(
    axis: str,
    state: Callable[[], StateSample | None],
    news: Callable[[], Awaitable[object]],
    within_s: float | None,
    *,
    watched: bool = False,
) -> StateSample:
    """Wait until an axis stands, and return the state that says so: one that is out of sight does not stand.

    Args:
        axis: its name.
        state: returns the last one.
        news: returns once something has come from the axis.
        within_s: longest wait, in seconds; without one as long as anything comes from it.
        watched: an operator is at the machine: what may move unseen counts as standing once its readings rest.

    Raises:
        OutcomeUnknown: the drive does not answer, nothing comes any more, or its readings prove no rest.
        WrongState: it does not come to rest in time.
    """
    try:
        async with asyncio.timeout(within_s):
            while (last := state()) is None or last.moving is not Moving.NO:
                if last and last.link is LinkState.DOWN:
                    raise drive_silent(axis)
                if last and last.has_ended:
                    if watched:
                        break
                    raise motion_hidden(axis, last)
                await heard(axis, news)
    except TimeoutError:
        last = state()
        unseen = last is not None and last.moving is Moving.UNKNOWN and last.unseen is not None
        raise WrongState(
            f"axis {axis} {'is not known to stand after' if unseen else 'does not come to rest within'} {within_s:g} s",
            axis=axis,
            remedy="wait for four times its coast_s, for its encoder has not counted yet, then give the command again"
            if unseen
            else "look for a load that moves it, then give the command again",
        ) from None
    return last


async def heard(axis: str, news: Callable[[], Awaitable[object]]) -> None:
    """Wait until something has come from an axis.

    Raises:
        OutcomeUnknown: nothing has for too long.
    """
    try:
        async with asyncio.timeout(PATIENCE_S):
            await news()
    except TimeoutError:
        raise nothing_received(axis) from None


def drive_silent(axis: str) -> OutcomeUnknown:
    """Return the error for an axis whose drive has stopped answering."""
    return OutcomeUnknown(
        f"axis {axis}: the drive does not answer any more",
        axis=axis,
        remedy=Remedy(
            "look whether it moves, check the power of the drive and its line; once it answers, {}", step("halt")
        ),
    )


def motion_hidden(axis: str, state: StateSample) -> OutcomeUnknown:
    """Return the error for an axis whose readings do not prove that it stands."""
    fault, unknown = state.motion_hidden_by, f"axis {axis}: it is not known whether it stands"
    off = step("power", 'send power {"on": false}', on=False)
    if not fault:
        return OutcomeUnknown(
            f"{unknown}: it was taken over, and its encoder has not counted in a motion of this daemon yet",
            axis=axis,
            value=state.unseen,
            remedy=Remedy("{} and wait until it stands, or {} if nothing is in the way of that", off, step("home")),
        )
    look = "look whether it stands, then {}"
    return OutcomeUnknown(
        f"{unknown}: after {fault} its encoder does not prove it",
        axis=axis,
        value=fault,
        # a reset of a motor under voltage is refused
        remedy=Remedy(f"{{}}, {look}", off, step("reset")) if state.enabled else Remedy(look, step("reset")),
    )


def nothing_received(axis: str) -> OutcomeUnknown:
    """Return the error for an axis of which nothing has come for too long."""
    return OutcomeUnknown(
        f"axis {axis}: nothing was received from it for {PATIENCE_S:g} s",
        axis=axis,
        remedy="look whether it moves, then whether the daemon runs and can be reached",
    )
