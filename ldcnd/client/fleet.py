"""Every rig that can be reached, across routers: what it is, which axes it has, and what is wrong with it."""

import asyncio

from ldcnd.client.overview import last_bus_health, last_health
from ldcnd.client.rig_client import RigClient, daemons, find_rigs
from ldcnd.contract.condition import Condition, assess, assess_module
from ldcnd.contract.errors import LdcndError, OutcomeUnknown
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.health import AxisHealth, BusHealth, DaemonHealth
from ldcnd.contract.meta import AxisInfo, DaemonInfo
from ldcnd.contract.samples import FaultSample, StateSample
from ldcnd.contract.troubles import OWN, daemon_troubles, line_troubles
from ldcnd.net.session import Session

ASKED_AT_ONCE = 8
"""Maximum number of concurrent queries of rigs."""
LATE_S = 0.25
"""A daemon whose timers come later than this has too much to do."""


class AxisReport(Frozen):
    """One axis of a fleet."""

    info: AxisInfo
    """The description of the axis."""
    state: StateSample | None
    """Its last state; null before the first."""
    fault: FaultSample | None
    """Its last faults; null before the first."""
    health: AxisHealth | None
    """How fresh its samples are; null before the first report."""
    line_up: bool | None = True
    """Its line is up; null before the first report about it."""

    @property
    def condition(self) -> Condition:
        """Whether its place is known, and all that is to be said of it."""
        return assess(self.state, self.fault, self.health, line_up=self.line_up)


class RigReport(Frozen):
    """One run of a daemon, and its rig."""

    rig: str
    """The rig id."""
    instance: str
    """The run of the daemon."""
    daemon: DaemonInfo | None
    """The daemon's description; null when it shows its token and does not answer."""
    health: DaemonHealth | None
    """How its process is doing; null before the first report."""
    buses: tuple[BusHealth, ...] = ()
    """How its lines are doing."""
    axes: tuple[AxisReport, ...] = ()
    """Its axes, in the order of lines and addresses."""
    problems: tuple[str, ...] = ()
    """Problems that need attention; empty when all is well."""


async def survey(session: Session, rig: str | None = None) -> tuple[RigReport, ...]:
    """Query the state of every rig, and return the reports by name; a rig that does not answer delays no other.

    A daemon that shows its liveliness token and answers nothing is in the list, with that as its problem.

    Args:
        session: where the rigs are.
        rig: only this one.
    """
    alive: set[tuple[str, str]] = set()

    def on_daemon(name: str, instance: str, there: bool) -> None:  # noqa: FBT001 - as `daemons` calls it
        (alive.add if there else alive.discard)((name, instance))

    async with daemons(session, on_daemon):
        answering = await _daemons(session)
    runs = [daemon.rig for daemon in answering]
    silent = alive - {(daemon.rig, daemon.instance) for daemon in answering}
    slots = asyncio.Semaphore(ASKED_AT_ONCE)
    async with asyncio.TaskGroup() as group:
        looks = [
            group.create_task(_look(session, daemon, slots, rival=runs.count(daemon.rig) > 1), name=f"ask {daemon.rig}")
            for daemon in answering
            if rig in (None, daemon.rig)
        ]
    views = [look.result() for look in looks]
    views += [_silent(name, instance) for name, instance in silent if rig in (None, name)]
    return tuple(sorted(views, key=lambda view: (view.rig, view.instance)))


async def _daemons(session: Session) -> list[DaemonInfo]:
    try:
        return await find_rigs(session)
    except OutcomeUnknown:  # there are daemons, and none of them answers
        return []


async def _look(session: Session, daemon: DaemonInfo, slots: asyncio.Semaphore, *, rival: bool) -> RigReport:
    """Query one rig; a query without answer is a problem of its own."""
    view = RigReport(rig=daemon.rig, instance=daemon.instance, daemon=daemon, health=None)
    client = RigClient(session, daemon.rig)
    try:
        async with slots:
            axes = await client.axes()
            states = await client.states()
            faults = await client.faults()
            health = await last_health(client)
            buses = tuple(sorted(await last_bus_health(client), key=lambda bus: bus.bus))
    except LdcndError as error:
        return view.model_copy(update={"problems": (f"stopped answering: {error.message}",)})
    freshness = {axis.axis: axis for bus in buses for axis in bus.axes}
    known = {axis.axis: axis for axis in axes}  # two daemons on one rig tell of each axis twice
    lines_up = {bus.bus: bus.up for bus in buses}
    views = tuple(
        AxisReport(
            info=axis,
            state=states.get(name),
            fault=faults.get(name),
            health=freshness.get(name),
            line_up=lines_up.get(axis.bus),
        )
        for name, axis in known.items()
    )
    problems = ["another daemon serves this rig: nothing is moved"] if rival else []
    problems += _problems(health, buses, views)
    return view.model_copy(update={"health": health, "buses": buses, "axes": views, "problems": tuple(problems)})


def _silent(rig: str, instance: str) -> RigReport:
    problem = "is alive and does not answer: frozen, or this login may not query it"
    return RigReport(rig=rig, instance=instance, daemon=None, health=None, problems=(problem,))


def _problems(health: DaemonHealth | None, buses: tuple[BusHealth, ...], axes: tuple[AxisReport, ...]) -> list[str]:
    problems = []
    if health and health.loop_lag_s > LATE_S:
        problems.append(f"the daemon is late by {health.loop_lag_s:.2f} s")
    problems += daemon_troubles(health)
    problems += [f"{bus.bus}: {trouble.text}" for bus in buses for trouble in line_troubles(up=bus.up)]
    down = {bus.bus for bus in buses if not bus.up}
    problems += [
        f"{module.module}: {trouble.text}"
        for bus in buses
        if bus.up
        for module in bus.modules
        for trouble in assess_module(module).wrong
    ]
    problems += [
        f"{axis.info.axis}: {trouble.text}"
        for axis in axes
        for trouble in axis.condition.wrong
        if axis.info.bus not in down or trouble.kind in OWN
    ]
    return problems
