"""Leases: which client may move which axis, and since when none may. Pure; time is an input.

A lease ends by the daemon's own clock. It is ended before any waiting command is examined, so that a command which
was delivered late - because the daemon, the link or the client was frozen - finds no lease and is refused.
"""

import secrets
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from ldcnd.errors import LeaseExpired, LeaseHeld, LeaseRequired, LeaseUnknown, Remedy, StaleSequence, UnknownAxis, step

REMEMBERED = 256
"""Maximum number of ended leases kept, to distinguish a stale command from an invented lease."""


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
        self._ended: deque[str] = deque(maxlen=REMEMBERED)
        self._successors: dict[str, str] = {}  # of leases that their own holder has replaced, by token

    def holder(self, axis: str) -> Lease | None:
        """Return the lease on an axis."""
        return next((lease for lease in self._leases.values() if axis in lease.axes), None)

    def next_end_s(self) -> float:
        """Return when the next lease ends unless it is renewed; infinity when there is none."""
        return min((lease.ends_at_s for lease in self._leases.values()), default=float("inf"))

    def acquire(
        self, client: str, axes: Iterable[str], duration_s: float, now_s: float, *, force: bool
    ) -> tuple[Lease, list[Lease]]:
        """Give a client control; return the lease and those that it displaced.

        Raises:
            UnknownAxis: there is no such axis.
            LeaseHeld: another client holds one of the axes, and `force` was not requested.
        """
        wanted = frozenset(axes) or self._axes
        if unknown := sorted(wanted - self._axes):
            raise UnknownAxis(f"there is no axis {unknown[0]!r}", axis=unknown[0], value=unknown[0])
        self.expire(now_s)
        displaced = [lease for lease in self._leases.values() if lease.axes & wanted]
        foreign = [lease for lease in displaced if lease.client != client]
        if foreign and not force:
            axis = min(foreign[0].axes & wanted)
            raise LeaseHeld(
                f"axis {axis} is controlled by {foreign[0].client}",
                axis=axis,
                value=foreign[0].client,
                remedy=Remedy("wait until it is released, or {}", step("acquire", "acquire it with force", force=True)),
            )
        for lease in displaced:
            self._end(lease)
        lease = Lease(self._next_token(), client, wanted, duration_s, now_s + duration_s)
        self._leases[lease.token] = lease
        self._successors.update((old.token, lease.token) for old in displaced if old.client == client)
        return lease, displaced

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
        self._end(lease)
        return lease

    def expire(self, now_s: float) -> list[Lease]:
        """End the leases that were not renewed in time, and return them."""
        over = [lease for lease in self._leases.values() if lease.ends_at_s <= now_s]
        for lease in over:
            self._end(lease)
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
        while token in self._successors:
            token = self._successors[token]
        lease = self._leases.get(token)
        if lease is None or lease.ends_at_s <= now_s or axis not in lease.axes:
            raise LeaseExpired(
                f"axis {axis}: the lease of this command has ended before its motion began",
                axis=axis,
                value=token,
                remedy=Remedy("{}", step("acquire", "acquire a new one")),
            )

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
                f"axis {axis} moves only under a lease",
                axis=axis,
                remedy=Remedy("{}", step("acquire", "acquire one first")),
            )

    def _living(self, token: str, now_s: float) -> Lease:
        lease = self._leases.get(token)
        if lease and lease.ends_at_s > now_s:
            return lease
        if lease or token in self._ended:
            raise LeaseExpired(
                "the lease has ended: what was sent under it is stale",
                value=token,
                remedy=Remedy("{}", step("acquire", "acquire a new one")),
            )
        raise LeaseUnknown(
            "there was never such a lease", value=token, remedy=Remedy("{}", step("acquire", "acquire one first"))
        )

    def _end(self, lease: Lease) -> None:
        del self._leases[lease.token]
        if len(self._ended) == REMEMBERED:
            self._successors.pop(self._ended[0], None)
        self._ended.append(lease.token)
