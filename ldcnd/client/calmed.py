"""Whether another client has brought an axis to rest: what goes on in steps ends then, also between two of them.

A stop is latched, and seen by that; a halt or power off leaves nothing but its event.
"""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager

from ldcnd.client.axis import Axis
from ldcnd.client.rig import Rig
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import WrongState
from ldcnd.contract.events import CommandEvent, CommandStatus

UNNAMED_S = 1.0
WORDS: dict[str, str] = {Verb.HALT: "halted", Verb.QUICK_STOP: "halted quickly", Verb.POWER: "switched off"}


async def until_calmed(
    events: AsyncIterator[CommandEvent], axes: Mapping[str, Axis], who: str, what: str
) -> WrongState:
    """Wait until another client halts or switches off one of some axes, whether it moves then or not.

    Args:
        events: of the rig; what came since they were opened counts.
        axes: by their names, as they are controlled here.
        who: the client whose own commands are passed over; of a lease that is shared those of its holder are.
        what: ends by it.

    Returns:
        What is to be raised.
    """
    own = {who, *(axis.control.lease.client for axis in axes.values() if axis.control)}
    while True:
        event = await anext(events)
        if event.axis in axes and event.client not in own and _calms(event):
            if event.client is None:  # perhaps the daemon itself: where control was lost, that is said first
                await asyncio.sleep(UNNAMED_S)
            by = event.client or "a client without a name"
            return WrongState(
                f"axis {event.axis} was {WORDS[event.verb]} by {by}; {what} ends",
                axis=event.axis,
                remedy="look why, then begin it again",
            )


def _calms(event: CommandEvent) -> bool:
    is_calm = event.verb in WORDS and (event.verb != Verb.POWER or event.on is False)
    return is_calm and event.status is not CommandStatus.REFUSED


@asynccontextmanager
async def ended_by_calm(rig: Rig, axis: Axis, who: str, what: str) -> AsyncIterator[None]:
    """Cut the body short when another client brings an axis to rest.

    Raises:
        WrongState: one did; see `until_calmed`.
    """

    async def watch(events: AsyncIterator[CommandEvent]) -> None:
        raise await until_calmed(events, {axis.name: axis}, who, what)

    try:
        async with rig.events() as events, asyncio.TaskGroup() as group:
            watching = group.create_task(watch(events), name=f"whether {what} is ended")
            yield
            watching.cancel()
    except BaseExceptionGroup as failures:
        raise failures.exceptions[0] from None
