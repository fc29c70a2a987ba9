"""The order of the commands of one axis: those that wait, and the lock under which one command or step is at work."""

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from ldcnd.axis.permit import Permit
from ldcnd.contract.commands import AxisCommand, CommandReply
from ldcnd.contract.errors import LdcndError, TooManyRequests

QUEUED_COMMANDS = 8
"""Largest number of commands that wait for their turn on one axis."""

CarryOut = Callable[[Permit, AxisCommand[CommandReply]], Awaitable[CommandReply]]
"""Carries out a command whose turn has come."""


@dataclass(frozen=True, slots=True)
class WaitingCommand:
    """A command that found the axis at work, and the caller who waits for its answer."""

    permit: Permit
    request: AxisCommand[CommandReply]
    future: "asyncio.Future[CommandReply]"

    async def carry_out(self, execute: CarryOut) -> None:
        """Let it have its turn, unless it was answered meanwhile or its caller has gone."""
        if self.future.done():
            return
        try:
            reply = await execute(self.permit, self.request)
        except Exception as error:  # noqa: BLE001 - the caller gets it whole; requests.py translates
            self.refuse(error)
            return
        if not self.future.done():
            self.future.set_result(reply)

    def refuse(self, error: Exception) -> None:
        """Give the caller an error, unless it has an answer or has gone."""
        if not self.future.done():
            self.future.set_exception(error)


class CommandQueue:
    """Order of the commands of one axis.

    Attributes:
        at_work: held while a command or a step is carried out.
        changed: set when something has changed that a move which waits for its turn has to look at.
    """

    def __init__(self, axis: str) -> None:
        self.at_work = asyncio.Lock()
        self.changed = asyncio.Event()
        self._axis = axis
        self._waiting: deque[WaitingCommand] = deque()
        self._woken = asyncio.Event()

    @property
    def free(self) -> bool:
        """Whether a command that comes now need not wait for another one, or for a step."""
        return not (self._waiting or self.at_work.locked())

    async def wait(self, permit: Permit, request: AxisCommand[CommandReply]) -> CommandReply:
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
        self._waiting.append(WaitingCommand(permit, request, future))
        self.wake()
        return await future

    def take(self) -> WaitingCommand | None:
        """Remove and return the command that has waited longest, or None when none does."""
        return self._waiting.popleft() if self._waiting else None

    def refuse(self, error: LdcndError) -> None:
        """Refuse the commands that wait in vain, and have the moves that wait for their turn look whether they may."""
        self.changed.set()
        for waiting in tuple(self._waiting):
            if waiting.permit.is_void:
                self._waiting.remove(waiting)
                waiting.refuse(error)

    def wake(self) -> None:
        """Wake the task of the axis to check for work."""
        self._woken.set()

    async def woken(self, deadline_s: float) -> None:
        """Return when a command waits, when the axis was woken, or at the deadline, in loop time."""
        if self._waiting:
            return
        # no await between this look and the wait, so that no wake-up is lost
        self._woken.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(None if math.isinf(deadline_s) else deadline_s):
                await self._woken.wait()
