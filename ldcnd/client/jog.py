"""A jog as a program sees it: it runs for as long as the program says that it is held."""

import asyncio
from collections.abc import Awaitable, Callable

from ldcnd.contract.commands import CommandReply, Jog

RENEWALS_PER_HOLD = 4
"""Number of consecutive renewals that may be lost before a jog ends."""


class Jogging:
    """One jog, begun by `begin`. Nothing renews it by itself: it ends when this program hangs, too.

    Args:
        send: sends one command to the axis, under control.
        request: the jog.

    Attributes:
        reply: to its first command; None before.
    """

    def __init__(self, send: Callable[[Jog], Awaitable[CommandReply]], request: Jog) -> None:
        self.reply: CommandReply | None = None
        self._send = send
        self._request = request
        self._due_s = 0.0

    async def begin(self) -> CommandReply:
        """Start it.

        Raises:
            LdcndError: as the daemon refused it.
        """
        self.reply = await self._send(self._request)
        self._request = self._request.model_copy(update={"renews": self.reply.command_id, "command_id": None})
        self._due_s = asyncio.get_running_loop().time()
        return self.reply

    async def renew(self, velocity: float | None = None, *, hold_s: float | None = None) -> None:
        """Say once that it is held.

        Args:
            velocity: from now on, in units a second; as before when missing. Any drive but PIC-SERVO SC comes to rest
                to change it.
            hold_s: from now on; as before when missing.

        Raises:
            LeaseExpired: it is over: not renewed in time, halted, or at the software limit.
            LdcndError: as the daemon refused it.
        """
        changed = {"velocity": velocity, "hold_s": hold_s}
        given = {name: value for name, value in changed.items() if value is not None}
        self._request = self._request.model_copy(update=given)
        await self._send(self._request)

    async def held(self, velocity: float | None = None) -> None:
        """Say that it is held and return when that is to be said again; see `renew`."""
        await self.renew(velocity)
        loop = asyncio.get_running_loop()
        self._due_s = max(self._due_s + self._request.hold_s / RENEWALS_PER_HOLD, loop.time())
        await asyncio.sleep(self._due_s - loop.time())
