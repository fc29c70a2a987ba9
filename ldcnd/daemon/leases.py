"""Leases: which client may move which axis, since when none may, and what happens when control is lost.

A lease belongs to who has its token: two programs may have one name, which is for people and gives no right.

A lease ends by the daemon's own clock. It is ended before any waiting command is examined, so that a command which
was delivered late - because the daemon, the link or the client was frozen - finds no lease and is refused. Control over
an axis ends in one place: however it ends - not renewed in time, taken by force, exchanged for a lease that covers
less, given back - an axis that moves then does what its `loss.client` says. `Authority` is pure; time is an input.
"""

import asyncio
import secrets
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.axis.status import STRENGTH
from ldcnd.contract.errors import (
    ErrorCode,
    LdcndError,
    LeaseExpired,
    LeaseHeld,
    LeaseRequired,
    LeaseUnknown,
    Remedy,
    StaleSequence,
    UnknownAxis,
    step,
)
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.leases import SHORTEST_LEASE_S, Acquire, LeaseReply
from ldcnd.contract.samples import Moving
from ldcnd.daemon.ledger import EventLog
from ldcnd.daemon.modules import Situation
from ldcnd.daemon.rig import OwnedRig
from ldcnd.drives.axis_config import LossPolicy
from ldcnd.drives.driver import StopMode
from ldcnd.log import LogLimit, get_logger

log = get_logger("loss")

NOT_RENEWED = "ended because it was not renewed"
REMEMBERED = 256
"""Maximum number of ended leases kept, to distinguish a stale command from an invented lease."""
STOP_MODES = {
    LossPolicy.HALT: StopMode.SMOOTH,
    LossPolicy.QUICK_STOP: StopMode.ABRUPT,
    LossPolicy.POWER_OFF: StopMode.OFF,
}


@dataclass(frozen=True, slots=True)
class Lease:
    """Control over some axes for some time.

    Attributes:
        token: what commands must carry; hard to guess, but no secret against those who listen.
        client: who holds it.
        axes: what it covers.
        duration_s: how long it lasts from each renewal.
        ends_at_s: when it ends, in loop time.
        sequence: of the last command that was admitted under it.
    """

    token: str
    client: str
    axes: frozenset[str]
    duration_s: float
    ends_at_s: float
    sequence: int = -1

    def reply(self) -> LeaseReply:
        """Return the reply to its holder."""
        return LeaseReply(lease=self.token, client=self.client, axes=tuple(sorted(self.axes)), lease_s=self.duration_s)


@dataclass(frozen=True, slots=True)
class Acquired:
    """What became of a request for control.

    Attributes:
        lease: that was given.
        own: leases of the requester that it replaces; what it has begun under them goes on.
        taken: leases that were taken from others by force.
    """

    lease: Lease
    own: tuple[Lease, ...]
    taken: tuple[Lease, ...]


def random_token() -> str:
    """Return what a new lease is known by."""
    return secrets.token_hex(8)


class Authority:
    """All leases of one rig."""

    def __init__(self, axes: Iterable[str], *, required: bool, next_token: Callable[[], str] = random_token) -> None:
        """Begin without leases.

        Args:
            axes: the axes of the rig.
            required: whether a motion needs a lease; without, an axis without a holder is open to all.
            next_token: makes what a lease is known by.
        """
        self._next_token = next_token
        self.required = required
        self._axes = frozenset(axes)
        self._leases: dict[str, Lease] = {}
        self._ended: dict[str, str] = {}  # how the latest that are over have ended, by token
        self._successors: dict[str, str] = {}  # of leases that their own holder has replaced, by token

    def holder(self, axis: str) -> Lease | None:
        """Return the lease on an axis."""
        for lease in self._leases.values():
            if axis in lease.axes:
                return lease
        return None

    def next_end_s(self) -> float:
        """Return when the next lease ends unless it is renewed; infinity when there is none."""
        return min((lease.ends_at_s for lease in self._leases.values()), default=float("inf"))

    def acquire(
        self,
        client: str,
        axes: Iterable[str],
        duration_s: float,
        now_s: float,
        *,
        force: bool,
        replaces: Iterable[str] = (),
    ) -> Acquired:
        """Give a client control.

        Args:
            client: its name, for people.
            axes: what it wants; none means all.
            duration_s: of the lease.
            now_s: the time.
            force: take control from its holders.
            replaces: the tokens of its own leases.

        Raises:
            UnknownAxis: there is no such axis.
            LeaseHeld: one of the axes is held under a lease that is not the requester's, and `force` was not requested.
        """
        wanted = frozenset(axes) or self._axes
        if unknown := sorted(wanted - self._axes):
            raise UnknownAxis(
                f"there is no axis {unknown[0]!r}; there are {', '.join(sorted(self._axes))}",
                axis=unknown[0],
                value=unknown[0],
            )
        self.expire(now_s)
        tokens = {self._latest(token) for token in replaces}
        displaced = [lease for lease in self._leases.values() if lease.axes & wanted]
        own = tuple(lease for lease in displaced if lease.token in tokens)
        taken = tuple(lease for lease in displaced if lease.token not in tokens)
        if taken and not force:
            axis = min(taken[0].axes & wanted)
            raise LeaseHeld(
                f"axis {axis} is controlled by {taken[0].client}, for {taken[0].ends_at_s - now_s:.1f} s more unless"
                " renewed",
                axis=axis,
                value=taken[0].client,
                remedy=Remedy(
                    "wait until it is released or not renewed, {}, or share it by its token in LDCND_LEASE",
                    step("acquire", "acquire it with force", force=True),
                ),
            )
        for old in own:
            self._end(old, "was replaced by its own client")
        for old in taken:
            self._end(old, f"was taken by {client}")
        lease = Lease(self._next_token(), client, wanted, duration_s, now_s + duration_s)
        self._leases[lease.token] = lease
        # what its holder has begun, or has waiting, goes on under the new one
        self._successors.update((old.token, lease.token) for old in own)
        return Acquired(lease, own, taken)

    def renew(self, token: str, now_s: float) -> Lease:
        """Let a lease last for its duration from now on.

        Raises:
            LeaseExpired, LeaseUnknown: it does not hold any more, or never did.
        """
        lease = self._living(token, now_s)
        renewed = self._leases[token] = replace(lease, ends_at_s=now_s + lease.duration_s)
        return renewed

    def release(self, token: str, now_s: float) -> Lease:
        """End a lease that its holder needs no longer.

        Raises:
            LeaseExpired, LeaseUnknown: it does not hold any more, or never did.
        """
        lease = self._living(token, now_s)
        self._end(lease, "was released")
        return lease

    def expire(self, now_s: float) -> list[Lease]:
        """End the leases that were not renewed in time, and return them."""
        over = [lease for lease in self._leases.values() if lease.ends_at_s <= now_s]
        for lease in over:
            self._end(lease, NOT_RENEWED)
        return over

    def admit(self, axis: str, token: str | None, sequence: int | None, now_s: float) -> str | None:
        """Decide whether a command may be considered; return its sender, if the command names one.

        Raises:
            LeaseRequired: the axis needs a lease and the command carries none.
            LeaseHeld: another client holds the axis, or the lease does not cover it.
            LeaseExpired, LeaseUnknown: the lease does not hold.
            StaleSequence: the command is not newer than the last one under this lease.
        """
        if token is None:
            self._admit_without(axis, now_s)
            return None
        lease = self._living(token, now_s)
        if axis not in lease.axes:
            raise LeaseHeld(
                f"the lease of {lease.client} does not cover axis {axis}",
                axis=axis,
                remedy=Remedy("{}", step("acquire", "acquire that axis, too")),
            )
        if sequence is not None:
            if sequence <= lease.sequence:
                raise StaleSequence(
                    f"axis {axis}: command {sequence} came after command {lease.sequence} of the same lease",
                    axis=axis,
                    value=sequence,
                    limit=lease.sequence,
                    remedy="number commands upwards; do not send an old one again",
                )
            self._leases[token] = replace(lease, sequence=sequence)
        return lease.client

    def check_held(self, axis: str, token: str | None, now_s: float) -> None:
        """Refuse a motion whose sender has lost the right to the axis since it was admitted.

        A lease that its holder has replaced by another one that covers the axis still holds.

        Raises:
            LeaseExpired: the lease has ended, was taken away, or does not cover the axis any more.
            LeaseHeld, LeaseRequired: the command came without a lease, and now one is needed.
        """
        if token is None:
            self._admit_without(axis, now_s)
            return
        lease = self._leases.get(self._latest(token))
        if lease is None or lease.ends_at_s <= now_s or axis not in lease.axes:
            raise LeaseExpired(
                f"axis {axis}: the lease of this command has ended before its motion began",
                axis=axis,
                value=token,
                remedy=Remedy("{}", step("acquire", "acquire a new one")),
            )

    def _latest(self, token: str) -> str:
        """Return the lease by which its own holder has replaced one, the latest of several; itself without one."""
        # each was made behind the one before it, so this comes to an end
        while token in self._successors:
            token = self._successors[token]
        return token

    def _admit_without(self, axis: str, now_s: float) -> None:
        holder = self.holder(axis)
        if holder and holder.ends_at_s > now_s:
            raise LeaseHeld(
                f"axis {axis} is controlled by {holder.client}",
                axis=axis,
                value=holder.client,
                remedy=Remedy("wait until it is released, or {}", step("acquire", "acquire it with force", force=True)),
            )
        if self.required:
            raise LeaseRequired(
                f"axis {axis} takes commands only under a lease",
                axis=axis,
                remedy=Remedy("{}", step("acquire", "acquire one first")),
            )

    def _living(self, token: str, now_s: float) -> Lease:
        lease = self._leases.get(token)
        if lease and lease.ends_at_s > now_s:
            return lease
        if lease or token in self._ended:
            raise LeaseExpired(
                f"control {self._ended.get(token, NOT_RENEWED)}: what was sent under that lease is stale",
                value=token,
                remedy=Remedy("{}", step("acquire", "acquire a new one")),
            )
        raise LeaseUnknown(
            "there was never such a lease", value=token, remedy=Remedy("{}", step("acquire", "acquire one first"))
        )

    def _end(self, lease: Lease, how: str) -> None:
        del self._leases[lease.token]
        if len(self._ended) == REMEMBERED:
            oldest = next(iter(self._ended))
            self._successors.pop(oldest, None)
            del self._ended[oldest]
        self._ended[lease.token] = how


class LeaseWatch:
    """Gives control and ends it; what moved under a lease that has ended comes to rest as configured.

    Attributes:
        group: where policies run; None until the daemon runs, and until then no client has control.
    """

    def __init__(self, rig: OwnedRig, authority: Authority, events: EventLog, clock: Clock) -> None:
        self.group: asyncio.TaskGroup | None = None
        self._rig = rig
        self._authority = authority
        self._events = events
        self._clock = clock
        self._refusals = LogLimit(now_s=clock.now_s)

    async def run(self) -> None:
        """Act upon each end when it comes, until cancelled: no lease ends before it has been seen here."""
        while True:
            self.expire()
            left_s = self._authority.next_end_s() - self._clock.now_s()
            # a lease that is given meanwhile lasts at least as long as this sleeps
            await asyncio.sleep(min(left_s, SHORTEST_LEASE_S))

    def expire(self) -> None:
        """End leases that were not renewed in time; called before any waiting command is examined."""
        for lease in self._authority.expire(self._clock.now_s()):
            log.warning("lease ended", client=lease.client, axes=sorted(lease.axes))
            self._show(lease.axes)
            self._lost(lease, lease.axes, "its lease was not renewed", ErrorCode.LEASE_EXPIRED)

    def acquire(self, request: Acquire) -> Lease:
        """Give a client control; the previous holder loses it.

        Raises:
            UnknownAxis: there is no such axis.
            LeaseHeld: one of the axes is held under a lease that is not the requester's, and `force` was not requested.
        """
        self.expire()
        wanted = self._rig.members(request.axes)
        try:
            acquired = self._authority.acquire(
                request.client,
                wanted,
                request.lease_s,
                self._clock.now_s(),
                force=request.force,
                replaces=request.replaces,
            )
        except LeaseHeld as error:
            self._refused(request, error)
            raise
        lease = acquired.lease
        self._show(lease.axes.union(*(other.axes for other in acquired.own + acquired.taken)))
        for other in acquired.own:
            self._lost(other, other.axes - lease.axes, "its client took a lease that covers less", None)
        for other in acquired.taken:
            log.warning("control taken over", axes=sorted(other.axes), from_client=other.client, by=lease.client)
            self._lost(other, other.axes, f"taken by force by {lease.client}", ErrorCode.LEASE_EXPIRED)
        log.info("control acquired", client=lease.client, axes=sorted(lease.axes))
        return lease

    def release(self, token: str, *, leave_running: bool = False, gone: bool = False) -> Lease:
        """End a lease that its holder needs no longer.

        Args:
            token: the lease.
            leave_running: what moves goes on.
            gone: the holder is not there any more, so that outputs have their levels for the loss of a client.

        Raises:
            LeaseExpired, LeaseUnknown: it does not hold any more, or never did.
        """
        lease = self._authority.release(token, self._clock.now_s())
        self._show(lease.axes)
        log.info("control released", client=lease.client, axes=sorted(lease.axes), leave_running=leave_running)
        # what is not seen to rest counts as moving
        states = {name: self._rig.axes[name].tracker.status for name in lease.axes}
        moving = [name for name, each in states.items() if each.commanded and each.to_be_stopped]
        if gone:
            self._leave_outputs(lease)
        if not leave_running:
            for name in moving:
                seen = states[name].moving is Moving.YES
                why = "released while it moved" if seen else "released before it was seen to rest"
                self._lost(lease, (name,), why, None)
        self._take_gains_back(lease.axes)
        for name in sorted(moving) if leave_running else ():
            self._note(name, lease, CommandStatus.DONE, "released; what moves was left running on purpose", None)
        return lease

    def _show(self, axes: Iterable[str]) -> None:
        """Publish who controls axes from now on: it is a part of their states."""
        for name in axes:
            lease = self._authority.holder(name)
            self._rig.axes[name].controlled_by(lease.client if lease else None)

    def _take_gains_back(self, axes: Iterable[str]) -> None:
        if self.group is None:
            return
        for name in sorted(axes):
            self.group.create_task(self._rig.axes[name].take_gains_back(), name=f"gains of {name}")

    def _lost(self, lease: Lease, axes: Iterable[str], cause: str, code: ErrorCode | None) -> None:
        axes = sorted(axes)
        # who gives control back is there, and sets its outputs itself
        if code is ErrorCode.LEASE_EXPIRED:
            self._leave_outputs(lease)
        for name in axes:
            axis = self._rig.axes[name]
            commanded = axis.tracker.status.commanded
            policy = f"; policy: {axis.config.loss.client.value}" if commanded else ""
            self._note(name, lease, CommandStatus.ABORTED, f"{cause}{policy}", code)
            # at the end of the daemon its own policy is applied instead
            if self.group is not None and commanded and not axis.gate.closed:
                self.group.create_task(
                    apply_policy(axis, axis.config.loss.client, f"loss of control: {cause}"), name=f"client loss {name}"
                )
        self._take_gains_back(axes)

    def _leave_outputs(self, lease: Lease) -> None:
        for module in self._rig.modules.values():
            if not lease.axes.isdisjoint(module.axes):
                module.enter(Situation.CLIENT)

    def _note(self, axis: str, lease: Lease, status: CommandStatus, reason: str, code: ErrorCode | None) -> None:
        self._events.note(
            axis,
            Acquire.verb,
            status,
            reason,
            client=lease.client,
            code=code.value if code else None,
        )

    def _refused(self, request: Acquire, error: LdcndError) -> None:
        if error.axis is not None and self._refusals.admit() is not None:
            self._events.note(
                error.axis,
                Acquire.verb,
                CommandStatus.REFUSED,
                error.message,
                client=request.client,
                code=error.code.value,
            )


async def apply_policy(axis: AxisService, policy: LossPolicy, cause: str, *, daemon_ends: bool = False) -> str:
    """Do to an axis that moves, or may move, what its policy says; a latched stop outranks it.

    Args:
        axis: whose.
        policy: for what was lost.
        cause: for the log.
        daemon_ends: what has no end in the drive is halted then, since nothing else will end it.

    Returns what was done, in words; empty when nothing was to be done.
    """
    tracker = axis.tracker
    stop, weakest = tracker.status.stop, min(STRENGTH.values())
    strength = STRENGTH[STOP_MODES[policy]] if policy in STOP_MODES else weakest
    if stop and tracker.status.stop_due and (tracker.status.stop_latched or STRENGTH[stop.mode] >= strength):
        return ""  # it is sent again until the drive confirms it
    endless = tracker.status.driven_open or (daemon_ends and axis.commands.needs_daemon)  # a raw duty has no target
    if policy is LossPolicy.RUN_TO_TARGET and (tracker.status.stop_latched or endless):
        policy = LossPolicy.HALT
    if policy is LossPolicy.RUN_TO_TARGET or not tracker.status.to_be_stopped:
        return ""
    log.warning("loss policy", axis=axis.config.name, policy=policy.value, cause=cause)
    if (await axis.stops.bring_to_rest(STOP_MODES[policy])).confirmed:
        return policy.value
    return f"{policy.value}, not confirmed yet" if axis.stops.possible else ""
