"""Requests whose packets wait in the queue of a line, which waits for a reply that is lost."""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from typing_extensions import override

from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Lane
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultInjector, FaultPlan, FaultyReply

ReplyT = TypeVar("ReplyT")
LONG = {"margin_ms": 300.0}
"""Settings of a line that waits for long."""


class _Mute(FaultInjector):
    """Loses every reply."""

    def __init__(self) -> None:
        super().__init__(FaultPlan())
        self.lost = False

    @override
    def reply(self, data: bytes, at_s: float) -> FaultyReply:
        self.lost = True
        return FaultyReply(b"")


async def queued(bus: Bus, chain: Chain, asking: Coroutine[Any, Any, ReplyT]) -> asyncio.Task[ReplyT]:
    """Lose the reply to a poll of a line that is `LONG`, and ask; return as soon as a packet of that waits."""
    before, chain.injector = chain.injector, (mute := _Mute())
    async with asyncio.timeout(5.0):
        while not mute.lost:
            await asyncio.sleep(0.0005)
        chain.injector = before
        asked = asyncio.create_task(asking)
        while not bus.waiting(Lane.COMMAND):
            await asyncio.sleep(0.0005)
    return asked
