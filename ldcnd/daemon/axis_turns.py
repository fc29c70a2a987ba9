"""Whose turn it is on one axis: commands one after another, in the order in which they came, and steps in between."""

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from ldcnd.daemon.procedure import Turn
from ldcnd.errors import LdcndError, TooManyRequests
from ldcnd.model.replies import CommandReply
from ldcnd.model.requests import Request

QUEUED_COMMANDS = 8

Obey = Callable[[Turn, Request], Awaitable[CommandReply]]


@dataclass(frozen=True, slots=True)
class WaitingCommand:
    """A command that found the axis at work, and the caller who waits for its answer."""

    turn: Turn
    request: Request
    future: "asyncio.Future[CommandReply]"

    async def carry_out(self, obey: Obey) -> None:
        """Let it have its turn, unless it was answered meanwhile or its caller has gone."""
        if self.future.done():
            return
        try:
            reply = await obey(self.turn, self.request)
        except Exception as error:  # noqa: BLE001 - the caller gets it whole; requests.py translates
            self.refuse(error)
            return
        if not self.future.done():
            self.future.set_result(reply)

    def refuse(self, error: Exception) -> None:
        """Give the caller an error, unless it has an answer or has gone."""
        if not self.future.done():
            self.future.set_exception(error)


class AxisTurns:
    """Who has one axis.

    Attributes:
        at_work: held by whoever carries out a command or a step.
    """

    def __init__(self, axis: str) -> None:
        self.at_work = asyncio.Lock()
        self._axis = axis
        self._waiting: deque[WaitingCommand] = deque()
        self._woken = asyncio.Event()

    @property
    def free(self) -> bool:
        """Whether a command that comes now need not wait for another one, or for a step."""
        return not (self._waiting or self.at_work.locked())

    async def wait(self, turn: Turn, request: Request) -> CommandReply:
        """Wait behind all others; return the answer.

        Raises:
            TooManyRequests: too many wait already.
            LdcndError: as the command itself, or as those that wait were refused.
        """
        if len(self._waiting) >= QUEUED_COMMANDS:
            raise TooManyRequests(
                f"axis {self._axis}: {QUEUED_COMMANDS} commands wait already",
                axis=self._axis,
                limit=QUEUED_COMMANDS,
                remedy="wait for a reply before sending the next command",
            )
        future: asyncio.Future[CommandReply] = asyncio.get_running_loop().create_future()
        self._waiting.append(WaitingCommand(turn, request, future))
        self.wake()
        return await future

    def take(self) -> WaitingCommand | None:
        """Remove and return the command that has waited longest, or None when none does."""
        return self._waiting.popleft() if self._waiting else None

    def refuse(self, error: LdcndError) -> None:
        """Refuse all commands that wait."""
        while waiting := self.take():
            waiting.refuse(error)

    def wake(self) -> None:
        """Have the axis look whether there is something to do."""
        self._woken.set()

    async def woken(self, deadline_s: float) -> None:
        """Return when a command waits, when the axis was woken, or at the deadline, in loop time."""
        if self._waiting:
            return
        self._woken.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(None if math.isinf(deadline_s) else deadline_s):
                await self._woken.wait()
