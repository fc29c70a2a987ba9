"""Control over axes for the time of a context: acquired or inherited, renewed by itself, released."""

import asyncio
import contextlib
import os
import socket
from collections.abc import AsyncIterator
from itertools import count
from typing import TypeVar

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.codec import valid
from ldcnd.contract.commands import LONGEST_NAME, AxisCommand, CommandReply
from ldcnd.contract.errors import LdcndError, LeaseExpired, LeaseUnknown, OutcomeUnknown, Remedy, SessionError, step
from ldcnd.contract.leases import Acquire, LeaseReply, Release, Renew

ReplyT = TypeVar("ReplyT", bound=CommandReply)
RequestT = TypeVar("RequestT", bound=AxisCommand[CommandReply])

RENEWALS_PER_LEASE = 4
"""Number of consecutive renewals that may be lost before a lease ends."""
LEASE_VARIABLE = "LDCND_LEASE"
"""Variable of the environment in which `ldcnd lease hold` gives its lease to the program that it runs."""
ACQUIRE_AGAIN = Remedy("{}", step("acquire", "acquire it again"))


def inherited_lease() -> str | None:
    """Return the lease that the program which has started this one shares with it; None without one."""
    return os.environ.get(LEASE_VARIABLE) or None


def program_name(name: str) -> str:
    """Return the name under which this process takes control: people see which one it is of several.

    A name gives no right: a lease belongs to the session that has its token.
    """
    return f"{name}, process {os.getpid()} on {socket.gethostname()}"[:LONGEST_NAME]


async def acquire(
    client: RigClient, name: str, axes: tuple[str, ...], lease_s: float, *, force: bool = False
) -> "Control":
    """Acquire control; leases on these axes that this program has here under the same name are replaced.

    So is the lease that the program was started with, where it covers one of them.

    Raises:
        LeaseHeld: the lease of another client covers one of the axes, or one of this client's that was acquired
            elsewhere or before it was started.
    """
    own = [token for token, held in client.held.items() if held.client == name]
    if client.lease:
        own.append(client.lease)
    request = valid(Acquire, client=name, axes=axes, lease_s=lease_s, force=force, replaces=tuple(own))
    lease = await client.ask(request)
    for token in own:
        if token in client.held and not set(lease.axes).isdisjoint(client.held[token].axes):
            del client.held[token]
    client.held[lease.lease] = lease
    return Control(client, lease)


class Control:
    """A lease that this program holds, or shares with the one that has started it.

    Attributes:
        lease: as acquired.
        inherited: whether another program holds it as well: then it is not released here.
        lost: why it does not hold any more; None while it does.
        over: is set when it does not.
        after_stops: what is sent goes with these `stops` of its axes, by axis, so that no stop or halt of anybody comes
            between; where it is one of this program itself, its own count follows. Empty to go on behind any.
    """

    def __init__(self, client: RigClient, lease: LeaseReply, *, inherited: bool = False) -> None:
        self.lease = lease
        self.inherited = inherited
        self.lost: LdcndError | None = None
        self.over = asyncio.Event()
        self.after_stops: dict[str, int] = {}
        self._client = client
        self._sequence = count(1)

    async def command(self, axis: str, command: AxisCommand[ReplyT], timeout_s: float | None = None) -> ReplyT:
        """Send one command under the lease; see `RigClient.command`.

        Raises:
            LeaseExpired: the lease was lost.
            LdcndError: as the daemon refused it.
        """
        if not command.takes_energy_out:
            await self._client.meet(f"axis {axis}: {command.verb}")  # from its number on nothing may overtake it
        try:
            reply = await self._client.command(axis, self.stamped(command, axis), timeout_s)
        except LeaseUnknown as error:
            raise self._ended(error) from error
        # a count that is higher tells of another stop before it, behind which nothing goes on
        if axis in self.after_stops and reply.stops == self.after_stops[axis] + 1:
            self.after_stops[axis] = reply.stops
        return reply

    async def check(self) -> None:
        """Query the daemon whether control is still here; without an answer it is taken to be.

        Raises:
            LeaseExpired: control was lost.
        """
        with contextlib.suppress(OutcomeUnknown, SessionError):
            await self._renew()

    async def _renew(self) -> None:
        try:
            await self._client.ask(Renew(lease=self.lease.lease), timeout_s=self.lease.lease_s)
        except (LeaseExpired, LeaseUnknown) as error:
            raise self._ended(error) from error

    def _ended(self, error: LeaseExpired | LeaseUnknown) -> LeaseExpired:
        """Keep why control was lost: a daemon that does not know the lease which it gave is another one."""
        self._client.held.pop(self.lease.lease, None)
        if isinstance(error, LeaseUnknown):
            error = LeaseExpired("the daemon was restarted, and control ended with it", remedy=ACQUIRE_AGAIN)
        self.lost = error
        return error

    def stamped(self, request: RequestT, axis: str) -> RequestT:
        """Return a request for an axis under the lease, with the next sequence number unless others count as well.

        It goes with `after_stops` of its axis.

        What takes energy out needs no lease, and is returned without one when that was lost.

        Raises:
            LeaseExpired: the lease was lost.
        """
        if self.lost:
            if isinstance(request, AxisCommand) and request.takes_energy_out:
                return request
            raise LeaseExpired(
                f"control was lost: {self.lost.message}",
                axis=axis,
                remedy=ACQUIRE_AGAIN,
            )
        sequence = None if self.inherited else next(self._sequence)
        behind = {"after_stops": self.after_stops[axis]} if axis in self.after_stops else {}
        return request.model_copy(update={"lease": self.lease.lease, "sequence": sequence, **behind})

    async def keep(self) -> None:
        """Renew until cancelled or until the lease has ended: by the daemon's word, or unrenewed for its duration."""
        loop, lease_s = asyncio.get_running_loop(), self.lease.lease_s
        until_s = loop.time() + lease_s
        while self.lost is None:
            await asyncio.sleep(lease_s / RENEWALS_PER_LEASE)
            asked_at_s = loop.time()
            try:
                await self._renew()
            except LeaseExpired:
                break
            except LdcndError as error:
                if loop.time() >= until_s:  # until then an answer may have been lost; the next renewal is due soon
                    self.lost = LeaseExpired(f"it could not be renewed for {lease_s:g} s: {error.message}")
            else:
                until_s = asked_at_s + lease_s
        self.over.set()

    async def release(self, *, leave_running: bool = False) -> None:
        """Give control back; it may have been taken away meanwhile, or end by itself when the daemon is out of reach.

        An axis that moves then does what its `loss.client` says, unless it is left running on purpose. What is
        inherited stays with its holder.
        """
        if self.inherited:
            return
        with contextlib.suppress(OutcomeUnknown, SessionError):  # then it is still the one to be replaced
            with contextlib.suppress(LeaseExpired, LeaseUnknown):
                await self._client.ask(Release(lease=self.lease.lease, leave_running=leave_running))
            self._client.held.pop(self.lease.lease, None)


async def take_control(client: RigClient, name: str, axes: tuple[str, ...], lease_s: float, *, force: bool) -> Control:
    """Take control over axes (all, when none is named), or share it with the program that has started this one.

    Raises:
        LeaseHeld: another client controls one of the axes.
        LeaseExpired, LeaseUnknown: what was inherited does not hold any more.
    """
    if client.lease and not force:
        lease = await client.ask(Renew(lease=client.lease))
        if set(axes) <= set(lease.axes):
            return Control(client, lease, inherited=True)
    return await acquire(client, name, axes, lease_s, force=force)


@contextlib.asynccontextmanager
async def control(
    client: RigClient,
    name: str,
    *axes: str,
    lease_s: float = 1.0,
    force: bool = False,
    leave_running: bool = False,
) -> AsyncIterator[Control]:
    """Hold control over axes until the context ends; see `take_control`.

    Args:
        client: the rig.
        name: who this is, for people.
        axes: what to control.
        lease_s: how soon the daemon shall act when this program disappears, 0.2 to 60 s.
        force: take control away from the present holder.
        leave_running: let what still moves at the end go on, without a holder of control, though no further motion of
            its command begins; otherwise it does what its `loss.client` says.

    Raises:
        LeaseHeld: another client controls one of the axes.
    """
    held = await take_control(client, name, axes, lease_s, force=force)
    try:
        async with asyncio.TaskGroup() as group:
            keeper = group.create_task(held.keep(), name=f"lease of {name}")
            try:
                yield held
            finally:
                keeper.cancel()
                await held.release(leave_running=leave_running)
    except BaseExceptionGroup as errors:
        raise told_once(errors) from None


def told_once(errors: BaseExceptionGroup) -> BaseException:
    """Return the error of a program that has control: where the renewals have failed with the same one, it is one."""
    first, *others = errors.exceptions
    return first if all(type(each) is type(first) for each in others) else errors
