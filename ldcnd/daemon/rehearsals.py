"""Losses played on purpose, with what the policies really do, so that an operator has seen it before it happens."""

from ldcnd.daemon.bus_service import BusService
from ldcnd.daemon.loss_policies import apply_policy
from ldcnd.daemon.rig import Rig
from ldcnd.log import get_logger
from ldcnd.model.rehearsal import Rehearsal, RehearsalReply, RehearsalRequest

log = get_logger("drill")


async def rehearse(rig: Rig, request: RehearsalRequest) -> RehearsalReply:
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
