"""A bus on a scripted line, on the jumping clock."""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any

from ldcnd.contract.errors import (
    BusError,
)
from ldcnd.line.bus import Bus
from ldcnd.line.settings import BusSettings
from tests.support import toy_family as toy
from tests.support.scripted_line import Say, Script, ScriptedLine, ScriptedOpener
from tests.support.toy_family import ToyPoller

SETTINGS = BusSettings("toy", 115_200)
BYTE_S = 10 / 115_200


class Rig:
    """A bus on a scripted line."""

    def __init__(self, script: Script = toy.answer, settings: BusSettings = SETTINGS):
        self.opener = ScriptedOpener(script)
        self.bus = Bus(settings, self.opener, toy.RESYNC)

    @property
    def line(self) -> ScriptedLine:
        return self.opener.line

    def sent(self) -> list[int]:
        """Numbers of the requests on the present line, probes and flushes left out."""
        numbers = [toy.number_of(packet) for packet in self.line.packets() if packet != toy.FLUSH]
        return [number for number in numbers if number != toy.PROBE_NUMBER]

    def nodes(self) -> list[int]:
        return [toy.node_of(packet) for packet in self.line.packets() if packet != toy.FLUSH]


@asynccontextmanager
async def running(rig: Rig) -> AsyncIterator[asyncio.TaskGroup]:
    """Run the bus; the group is for callers."""
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(rig.bus.run(), name="bus")
        await rig.bus.wait_opened()
        async with asyncio.TaskGroup() as callers:
            yield callers
        owner.cancel()


async def outcome(call: Coroutine[Any, Any, int]) -> int | BusError:
    try:
        return await call
    except BusError as error:
        return error


def scripted(says: dict[int, list[list[Say]]]) -> Script:
    """Answer some numbers in a special way, one answer after the other; healthy answers after that."""

    def script(packet: bytes) -> list[Say]:
        special = says.get(toy.number_of(packet)) if packet != toy.FLUSH else None
        return special.pop(0) if special else toy.answer(packet)

    return script


async def polled(
    rig: Rig, pollers: list[ToyPoller], seconds: float, meanwhile: Callable[[], None] | None = None
) -> None:
    """Let pollers run for a while, and the last poll end."""
    async with running(rig):
        for poller in pollers:
            rig.bus.add_poller(poller)
        await asyncio.sleep(seconds)
        if meanwhile:
            meanwhile()
            await asyncio.sleep(seconds)
        for poller in pollers:
            rig.bus.remove_poller(poller)
        await asyncio.sleep(0.05)
