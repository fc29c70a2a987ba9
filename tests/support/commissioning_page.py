"""The commissioning page of a console in this process, as a page's web socket sees it, on the jumping clock."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

from typing_extensions import override

from ldcnd.console.commissioning.messages import ToCommissioningPage, View
from ldcnd.console.commissioning.routes import Commissioning
from ldcnd.net.hand_over import Answer
from ldcnd.testing.memory_session import MemorySession
from tests.support.browser import Browser
from tests.support.commissioning import AXIS, CommissioningRig
from tests.support.console_rig import PageSocket, RunningConsole, console_of, page

HELD_EACH_S = 0.1
COMMANDS = "@cmd"
COMMAND = "ldcnd run --config rig.toml"


class ViewerSession(MemorySession):
    """The session of a login that may look, and command nothing: access control drops what it asks."""

    @override
    async def query(self, key: str, payload: bytes = b"", **more: Any) -> list[Answer]:
        return [] if f"/{COMMANDS}/" in key else await super().query(key, payload, **more)


@asynccontextmanager
async def commissioning_console(
    rig: CommissioningRig, session_class: type[MemorySession] = MemorySession
) -> AsyncIterator[RunningConsole]:
    """Run a console that commissions an axis of a daemon."""
    async with (
        closing(session_class(rig.running.broker)) as session,
        console_of(rig.running, session, lambda rigs: Commissioning(rigs, rig.config, COMMAND).routes()) as console,
    ):
        yield console


@asynccontextmanager
async def closing(session: MemorySession) -> AsyncIterator[MemorySession]:
    """Close a session at the end of the context."""
    try:
        yield session
    finally:
        await session.close()


@dataclass
class OpenCommissioning:
    """A page that has the checklist of an axis.

    Attributes:
        view: what it shows now.
    """

    socket: PageSocket
    view: View

    def say(self, **message: object) -> None:
        """Say something."""
        self.socket.say(json.dumps(message))

    async def until(self, wanted: Callable[[View], object]) -> View:
        """Wait until the page shows what is wanted."""
        while not wanted(self.view):
            told = await told_to(self.socket)
            assert told.view, told
            self.view = told.view
        return self.view

    async def begin(self, step: str) -> None:
        """Begin a step, and agree to it."""
        await self.until(lambda view: not view.running and view.steps)
        self.say(begin=step, by="ada")
        await self.until(lambda view: view.running)
        await self.answer("run it", "yes")

    async def answer(self, words: str, text: str) -> None:
        """Wait for a question, and answer it."""
        question = await self.asked(words)
        self.say(answer={"number": question, "text": text})
        await self.until(lambda view: view.question is None or view.question.number != question)

    async def asked(self, words: str) -> int:
        """Wait for a question; return its number."""
        view = await self.until(lambda view: view.problem or (view.question and words in view.question.text))
        assert view.question, view.problem
        return view.question.number

    @asynccontextmanager
    async def holding(self, words: str) -> AsyncIterator[int]:
        """Hold the button, once it is there; the messages of the page end with the context."""
        number = await self.asked(words)

        async def hold() -> None:
            while True:
                self.say(hold={"number": number, "on": True})
                await asyncio.sleep(HELD_EACH_S)

        async with asyncio.TaskGroup() as group:
            holding = group.create_task(hold(), name="held button")
            await self.until(lambda view: view.held)
            yield number
            holding.cancel()

    async def ended(self) -> View:
        """Wait until nothing runs any more."""
        return await self.until(lambda view: not view.running)

    def state(self, step: str) -> str:
        """Return how far a step is."""
        return next(each.state for each in self.view.steps if each.name == step)


async def told_to(socket: PageSocket) -> ToCommissioningPage:
    """Return the next message to a page."""
    return ToCommissioningPage.model_validate_json(await socket.frame())


@asynccontextmanager
async def commissioning_page(
    console: RunningConsole, axis: str = AXIS, browser: Browser | None = None
) -> AsyncIterator[OpenCommissioning]:
    """Open the checklist of an axis; everything that it has begun is over when the context has ended."""
    async with page(console.app, browser or console.browser, path=f"/api/commissioning/axes/{axis}") as socket:
        opened = OpenCommissioning(socket, View())
        yield opened
