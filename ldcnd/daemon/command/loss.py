"""Who controls what, and what happens when control, the line or the daemon is lost.

Control over an axis ends in one place: however it ends - not renewed in time, taken by force, exchanged for a lease
that covers less, given back - an axis that moves then does what its `loss.client` says.
"""

import asyncio
from collections.abc import Iterable

from ldcnd.config.axis import LossPolicy
from ldcnd.daemon.axis.axis import AxisService
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.command.authority import Authority, Lease
from ldcnd.daemon.command.ledger import EventLog
from ldcnd.daemon.line.line import BusService
from ldcnd.daemon.line.rig import Rig
from ldcnd.drivers.driver import StopMode
from ldcnd.errors import ErrorCode, LdcndError, LeaseHeld
from ldcnd.log import LogLimit, get_logger
from ldcnd.model.events import CommandStatus
from ldcnd.model.leases import SHORTEST_LEASE_S, Acquire
from ldcnd.model.rig_commands import Rehearsal, RehearsalReply, Rehearse
from ldcnd.model.samples import Moving

log = get_logger("loss")

STOP_MODES = {
    LossPolicy.HALT: StopMode.SMOOTH,
    LossPolicy.QUICK_STOP: StopMode.ABRUPT,
    LossPolicy.POWER_OFF: StopMode.OFF,
}


class LeaseWatch:
    """Gives control and ends it; what moved under a lease that has ended comes to rest as configured.

    Attributes:
        group: where policies run; None until the daemon runs, and until then no client has control.
    """

    def __init__(self, rig: Rig, authority: Authority, events: EventLog, clock: Clock) -> None:
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
            await asyncio.sleep(min(left_s, SHORTEST_LEASE_S))

    def expire(self) -> None:
        """End leases that were not renewed in time; called before any waiting command is examined."""
        for lease in self._authority.expire(self._clock.now_s()):
            log.warning("lease ended", client=lease.client, axes=sorted(lease.axes))
            self._lost(lease, lease.axes, "its lease was not renewed", ErrorCode.LEASE_EXPIRED)

    def acquire(self, request: Acquire) -> Lease:
        """Give a client control; the previous holder loses it.

        Raises:
            UnknownAxis: there is no such axis.
            LeaseHeld: another client holds one of the axes, and `force` was not requested.
        """
        self.expire()
        wanted = self._rig.members(request.axes)
        try:
            lease, displaced = self._authority.acquire(
                request.client, wanted, request.lease_s, self._clock.now_s(), force=request.force
            )
        except LeaseHeld as error:
            self._refused(request, error)
            raise
        for other in displaced:
            if other.client == lease.client:
                self._lost(other, other.axes - lease.axes, "its client took a lease that covers less", None)
                continue
            log.warning("control taken over", axes=sorted(other.axes), from_client=other.client, by=lease.client)
            self._lost(other, other.axes, f"taken by force by {lease.client}", ErrorCode.LEASE_EXPIRED)
        log.info("control acquired", client=lease.client, axes=sorted(lease.axes))
        return lease

    def release(self, token: str, *, leave_running: bool) -> Lease:
        """End a lease that its holder needs no longer; `leave_running` lets what moves go on.

        Raises:
            LeaseExpired, LeaseUnknown: it does not hold any more, or never did.
        """
        lease = self._authority.release(token, self._clock.now_s())
        log.info("control released", client=lease.client, axes=sorted(lease.axes), leave_running=leave_running)
        moving = [name for name in lease.axes if self._rig.axis(name).tracker.moving is not Moving.NO]
        if not leave_running:
            self._lost(lease, moving, "released while it moved", None)
        for name in sorted(moving) if leave_running else ():
            self._note(name, lease, CommandStatus.DONE, "released; what moves was left running on purpose", None)
        return lease

    def _lost(self, lease: Lease, axes: Iterable[str], cause: str, code: ErrorCode | None) -> None:
        for name in sorted(axes):
            axis = self._rig.axis(name)
            self._note(name, lease, CommandStatus.ABORTED, f"{cause}; policy: {axis.config.loss.client.value}", code)
            if self.group is not None:
                self.group.create_task(
                    apply_policy(axis, axis.config.loss.client, f"loss of control: {cause}"), name=f"client loss {name}"
                )

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


async def apply_policy(axis: AxisService, policy: LossPolicy, cause: str) -> None:
    """Do to an axis that moves, or may move, what its policy says; a latched stop outranks it."""
    tracker = axis.tracker
    if tracker.stop_pending:
        return  # it is sent again until the drive confirms it, whatever the policy
    if tracker.stop_latched and policy is LossPolicy.RUN_TO_TARGET:
        policy = LossPolicy.HALT
    if policy is LossPolicy.RUN_TO_TARGET or tracker.moving is Moving.NO:
        return
    log.warning("loss policy", axis=axis.config.name, policy=policy.value, cause=cause)
    await axis.bring_to_rest(STOP_MODES[policy])


def concerned(rig: Rig, request: Rehearse) -> tuple[str, ...]:
    """Return the axes that a rehearsed loss concerns: a lost line is lost for all on it.

    Raises:
        UnknownAxis: there is no such axis.
    """
    rig.axis(request.axis)
    if request.kind is Rehearsal.BUS_LOSS:
        return tuple(axis.config.name for axis in _bus_of(rig, request.axis).axes)
    return (request.axis,)


async def rehearse(rig: Rig, request: Rehearse) -> RehearsalReply:
    """Play a loss; returns once it was played, the axis may still be coming to rest.

    Raises:
        UnknownAxis: there is no such axis.
    """
    axis = rig.axis(request.axis)
    log.warning("rehearsal", axis=request.axis, kind=request.kind.value)
    if request.kind is Rehearsal.DAEMON_STOP:
        await apply_policy(axis, axis.config.loss.daemon, "rehearsed end of the daemon")
        policy = axis.config.loss.daemon
    else:
        bus = _bus_of(rig, request.axis)
        bus.bus.drop("rehearsed loss")
        await bus.wait_down()
        await bus.wait_up()
        policy = axis.config.loss.bus
    return RehearsalReply(kind=request.kind, axis=request.axis, policy=policy.value)


def _bus_of(rig: Rig, name: str) -> BusService:
    return next(bus for bus in rig.buses if any(axis.config.name == name for axis in bus.axes))
