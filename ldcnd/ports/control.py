"""Control of axes by a guest: a lease that it takes with its first command, and loses when it goes or falls idle."""

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass

from ldcnd.config.ports import GuestHost
from ldcnd.contract.commands import Command
from ldcnd.contract.errors import LdcndError, LeaseExpired
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import RIG_ITSELF
from ldcnd.contract.leases import Acquire, LeaseReply, Release, Renew

LEASE_S = 2.0
"""Duration of a guest's lease, renewed while the guest is there, seconds."""
LOOKS_S = 0.5


@dataclass(slots=True)
class Visit:
    """One time that the program is there, from its first byte until it closes its port or falls idle.

    Attributes:
        ended: what it has commanded and has not begun begins nothing any more.
    """

    ended: bool = False


class GuestControl:
    """The lease of one guest.

    Attributes:
        axes: that it controls.
    """

    def __init__(self, name: str, host: GuestHost, idle_s: float) -> None:
        self.axes: frozenset[str] = frozenset()
        self._claimed: frozenset[str] = frozenset()  # what it controls again, if at all, after force has ended that
        self._name, self._host, self._idle_s = name, host, idle_s
        self._token: str | None = None
        self._changing = asyncio.Lock()
        self._loop = asyncio.get_running_loop()
        self._heard_s = self._commanded_s = self._loop.time()

    def heard(self) -> None:
        """The guest has sent something."""
        self._heard_s = self._loop.time()

    async def over(self, axes: Iterable[str], visit: Visit) -> str:
        """Return the lease under which the guest commands these axes, and take it if need be.

        Args:
            axes: that it commands.
            visit: in which it sent the command.

        Raises:
            LdcndError: another client controls one of them, or the guest has gone since.
        """
        self._commanded_s = self._loop.time()
        async with self._changing:
            if visit.ended:  # a command may have waited for its axis to come to rest
                raise LeaseExpired(f"{self._name} has gone before it began")
            wanted = self._claimed.union(axes)
            if self._token is None or wanted != self.axes:
                own = () if self._token is None else (self._token,)
                axes = tuple(sorted(wanted))
                await self._ask(Acquire(client=self._name, axes=axes, lease_s=LEASE_S, replaces=own))
            if self._token is None:
                raise AssertionError("a lease that was given has a name")
            return self._token

    async def end(self, *, gone: bool = False) -> None:
        """Give control back; an axis that still moves does what its policy for the loss of a client says.

        Args:
            gone: its program is not there any more; then outputs do likewise.
        """
        async with self._changing:
            self._claimed = self.axes = frozenset()
            if self._token is not None:
                token, self._token = self._token, None
                with suppress(LdcndError):  # it was taken away meanwhile
                    if gone:
                        self._host.leave(token)
                    else:
                        await self._host.carry_out(RIG_ITSELF, Release(lease=token))

    async def watch(self, gone: Callable[[], Awaitable[None]]) -> None:
        """Keep the lease for as long as the guest uses it, until cancelled.

        Args:
            gone: called when nothing has come from the guest for its time.
        """
        while True:
            await asyncio.sleep(LOOKS_S)
            if self._token is None:
                continue
            now_s = self._loop.time()
            if now_s - self._heard_s > self._idle_s:
                await gone()
            elif now_s - self._commanded_s > self._idle_s and all(
                self._host.status(axis).at_rest for axis in self.axes
            ):
                await self.end()
            else:
                await self._renew()

    async def _renew(self) -> None:
        async with self._changing:
            if self._token is None:
                return
            try:
                await self._ask(Renew(lease=self._token))
            except LdcndError:  # taken by force: the next command of the guest asks anew, for all that it had
                self._token, self.axes = None, frozenset()

    async def _ask(self, command: Command[Frozen]) -> None:
        reply = await self._host.carry_out(RIG_ITSELF, command)
        if isinstance(reply, LeaseReply):
            self._token, self._claimed = reply.lease, frozenset(reply.axes)
            self.axes = self._claimed
