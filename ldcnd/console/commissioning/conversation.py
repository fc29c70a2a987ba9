"""A conversation with one page: what it begins runs here, one thing at a time, and ends when the page goes.

When a page goes, all of it ends: its questions stay without answer, its button is let go, and what runs is
cancelled, which halts what moves, brings gains back and gives control up. What was settled before is kept.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Coroutine

from ldcnd.bench.person import Left
from ldcnd.console.commissioning.messages import FromCommissioningPage, View
from ldcnd.console.commissioning.page_person import PagePerson
from ldcnd.contract.codec import error_reply
from ldcnd.contract.commands import ErrorReply
from ldcnd.contract.errors import LdcndError, OutcomeUnknown

LOOK_EACH_S = 1.0
"""Interval at which files and daemon are checked again while nothing runs, seconds."""


class Conversation(ABC):
    """What one page does; `run` carries it out.

    Attributes:
        person: at the page.
    """

    def __init__(self) -> None:
        self._changed = asyncio.Event()
        self._changed.set()
        self.person = PagePerson(self._changed.set)
        self._begun: FromCommissioningPage | None = None
        self._begin = asyncio.Event()
        self._activity: asyncio.Task[None] | None = None
        self._failure: ErrorReply | None = None
        self._hindrance: ErrorReply | None = None

    def heard(self, message: FromCommissioningPage) -> None:
        """Take a message of the page; it may begin something only while nothing runs."""
        if message.answer:
            self.person.answer(message.answer)
        if message.hold:
            self.person.hold(message.hold)
        if message.leave:
            self._leave()
        if message.begin and not self._begun:
            self._begun = message
            self._begin.set()

    def _leave(self) -> None:
        """End what runs, or was about to; once only, for a second time would end how it is brought to its end."""
        if self._activity is None:
            self._begun = None
            self._begin.clear()
        elif not self._activity.cancelling():
            self._activity.cancel()

    async def view(self) -> View:
        """Wait until there is something else to show, and return it."""
        await self._changed.wait()
        self._changed.clear()
        return self.shown().model_copy(
            update={
                "running": self._begun.begin if self._begun else "",
                "lines": self.person.lines,
                "question": self.person.question,
                "held": self.person.holds,
                "problem": None if self._begun else self._failure or self._hindrance,
            }
        )

    async def run(self) -> None:
        """Carry out what the page begins until cancelled."""
        try:
            while True:
                await self._refresh()
                while not await self._wanted():
                    if self.is_stale():
                        await self._refresh()
                await self._carry_out()
        finally:
            self.person.leave()

    @abstractmethod
    def shown(self) -> View:
        """Return what it shows of its own."""

    @abstractmethod
    async def refresh(self) -> None:
        """Learn anew what it shows."""

    @abstractmethod
    def is_stale(self) -> bool:
        """Tell whether that has changed since."""

    @abstractmethod
    async def carry_out(self, begun: FromCommissioningPage) -> None:
        """Do what the page has begun.

        Raises:
            LdcndError: it has failed.
            Left: the person has left it.
        """

    async def _refresh(self) -> None:
        self._hindrance = await self._failed(self.refresh())
        self._changed.set()

    async def _wanted(self) -> bool:
        """Wait a while for the page to begin something; tell whether it has."""
        try:
            async with asyncio.timeout(LOOK_EACH_S):
                await self._begin.wait()
        except TimeoutError:
            return False
        return True

    async def _carry_out(self) -> None:
        begun = self._begun
        if begun is None:
            return
        self._failure = None
        self.person.begin_anew()
        self._changed.set()

        async def activity() -> None:
            self._failure = await self._failed(self.carry_out(begun))

        try:
            async with asyncio.TaskGroup() as group:  # which is not cancelled by what the page cancels
                self._activity = group.create_task(activity(), name=f"commissioning: {begun.begin}")
        finally:
            self._activity = self._begun = None
            self._begin.clear()
            self._changed.set()

    async def _failed(self, activity: Coroutine[None, None, None]) -> ErrorReply | None:
        """Await something; return why it has failed."""
        try:
            await activity
        except LdcndError as error:
            return error_reply(error)
        except TimeoutError:
            return error_reply(OutcomeUnknown("the drive or the daemon took too long", remedy="look at the axis"))
        except Left as left:
            self.person.tell(str(left))
        except ExceptionGroup as errors:  # control was lost in the middle of what failed by that
            known, unknown = errors.split(LdcndError)
            if known is None or unknown is not None:
                raise
            return error_reply(_first(known))
        return None


def _first(errors: ExceptionGroup[LdcndError]) -> LdcndError:
    first = errors.exceptions[0]
    return _first(first) if isinstance(first, ExceptionGroup) else first
