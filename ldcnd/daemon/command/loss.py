"""What happens when somebody disappears: clients whose lease ended, the line, the daemon itself."""

import asyncio

from ldcnd.config.axis import LossPolicy
from ldcnd.daemon.axis.axis import AxisService
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.command.authority import Authority
from ldcnd.daemon.line.line import BusService
from ldcnd.daemon.line.rig import Rig
from ldcnd.drivers.driver import StopMode
from ldcnd.log import get_logger
from ldcnd.model.rig_commands import SHORTEST_LEASE_S, Rehearsal, RehearsalReply, Rehearse
from ldcnd.model.samples import Moving

log = get_logger("loss")


STOP_MODES = {
    LossPolicy.HALT: StopMode.SMOOTH,
    LossPolicy.QUICK_STOP: StopMode.ABRUPT,
    LossPolicy.POWER_OFF: StopMode.OFF,
}


class LeaseWatch:
    """Ends leases in time and brings what moved under them to rest."""

    def __init__(self, rig: Rig, authority: Authority, clock: Clock, group: asyncio.TaskGroup) -> None:
        self._rig = rig
        self._authority = authority
        self._clock = clock
        self._group = group

    async def run(self) -> None:
        """Act upon each end when it comes, until cancelled: no lease ends before it has been seen here."""
        while True:
            self.expire()
            left_s = self._authority.next_end_s() - self._clock.now_s()
            await asyncio.sleep(min(left_s, SHORTEST_LEASE_S))

    def expire(self) -> None:
        """End what was not renewed in time; called before any command that waited is looked at."""
        for lease in self._authority.expire(self._clock.now_s()):
            log.warning("lease ended", client=lease.client, axes=sorted(lease.axes))
            for name in sorted(lease.axes):
                axis = self._rig.axis(name)
                self._group.create_task(
                    apply_policy(axis, axis.config.loss.client, "client loss"), name=f"client loss {name}"
                )


async def apply_policy(axis: AxisService, policy: LossPolicy, cause: str) -> None:
    """Do to an axis that moves, or may move, what its policy says."""
    if policy is LossPolicy.RUN_TO_TARGET or axis.tracker.moving is Moving.NO:
        return
    log.warning("loss policy", axis=axis.config.name, policy=policy.value, cause=cause)
    await axis.bring_to_rest(STOP_MODES[policy])


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
