"""The composition root: builds a daemon that is ready to run from a configuration; the only place with all parts."""

import secrets
import time
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from types import MappingProxyType
from typing import Any

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.axis.kept import KeptFiles
from ldcnd.axis.latches import LatchKeeper
from ldcnd.config.plan import demand_of
from ldcnd.config.ports import GuestView, StatusView, ports
from ldcnd.config.rig import RigConfig
from ldcnd.config.simulated import simulator
from ldcnd.contract.codec import Encoding
from ldcnd.contract.commands import Command
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import Keys
from ldcnd.daemon.daemon import Daemon
from ldcnd.daemon.dispatch import Dispatcher
from ldcnd.daemon.heartbeat import Heartbeat
from ldcnd.daemon.leases import Authority, random_token
from ldcnd.daemon.ledger import EventLog, Ledger
from ldcnd.daemon.line import BusService
from ldcnd.daemon.link_events import Note
from ldcnd.daemon.modules import ModuleService
from ldcnd.daemon.requests import EarlyStops
from ldcnd.daemon.rig import OwnedRig
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import Drive
from ldcnd.drives.family import OpenLine
from ldcnd.drives.known import FAMILIES
from ldcnd.drives.line_config import BusConfig
from ldcnd.line.bus import Bus
from ldcnd.line.transport import Opener
from ldcnd.net.publisher import Publisher
from ldcnd.net.session import Session
from ldcnd.net.zenoh_session import open_zenoh_session

ENCODINGS = {"msgpack": Encoding.MSGPACK, "json": Encoding.JSON}


@asynccontextmanager
async def open_daemon(config: RigConfig) -> AsyncIterator[Daemon]:
    """Open the session and build the daemon on it; nothing is sent to any line before it runs.

    Raises:
        SessionError: the session cannot be opened.
    """
    async with open_zenoh_session(config.zenoh.session()) as session:
        stops = EarlyStops()
        await stops.declare(session, Keys(config.rig))  # clients can connect by now; a daemon takes a while
        yield build_daemon(config, session, time.time_ns, secrets.token_hex(4), stops=stops)


def build_daemon(
    config: RigConfig,
    session: Session,
    now_ns: Callable[[], int],
    instance: str,
    openers: Mapping[str, Opener] = MappingProxyType({}),
    next_token: Callable[[], str] = random_token,
    stops: EarlyStops | None = None,
) -> Daemon:
    """Build a daemon on an open session.

    Args:
        config: the rig.
        session: where clients are.
        now_ns: the wall clock, UTC in ns since 1970.
        instance: names this run of the daemon.
        openers: what opens a line instead of its port, also of a simulated one, by the name of the bus.
        next_token: makes what a lease is known by.
        stops: what takes stops already.

    Raises:
        ConfigError: a line is simulated, and the simulator is not installed.
    """
    clock = Clock(now_ns)
    publisher = Publisher(session, Keys(config.rig), ENCODINGS[config.telemetry.encoding])
    events = EventLog(publisher, clock, instance)
    ledger = Ledger(events.changed, clock.now_s, events.is_reserved)

    def note(axis: str, verb: str, status: CommandStatus, reason: str, code: str | None) -> None:
        events.note(axis, verb, status, reason, code=code)

    places = {axis.name: f"{bus.name}/{axis.address}" for bus in config.bus for axis in bus.axis}
    kept = KeptFiles(config.state_dir, config.rig, places) if config.state_dir else None
    # a reset clears what proves a reference, so it is worth keeping only where drives are taken over
    taken_over = frozenset(axis.name for bus in config.bus if bus.takes_over for axis in bus.axis)

    def make_axis(axis: AxisConfig, bus: Bus, driver: Drive) -> AxisService:
        return AxisService(
            axis,
            bus,
            driver,
            publisher,
            clock,
            events.next_command_id,
            ledger.ended,
            note,
            kept=kept,
            keeps_reference=axis.name in taken_over,
        )

    open_lines = {name: FAMILIES[name].open_lines(config.state_dir) for name in {bus.family for bus in config.bus}}
    groups = {group.name: group.axes for bus in config.bus for group in bus.group}
    buses = tuple(
        _build_bus(config, bus, open_lines[bus.family], make_axis, openers, events.noting(bus.name))
        for bus in config.bus
    )
    modules = tuple(
        ModuleService(
            driver, publisher, clock, tuple(axis.config.name for axis in bus.axes), events.noting(driver.name)
        )
        for bus in buses
        for driver in bus.network.io.values()
    )
    rig = OwnedRig(config.rig, buses, groups, modules, kept.troubles if kept else {}, session.certificate)
    latches = LatchKeeper(
        kept, {name: axis.tracker for name, axis in rig.axes.items() if axis.stops.possible}, clock.now_ns
    )
    for each in rig.axes.values():
        each.stops.latches = latches
    authority = Authority(rig.axes, required=config.authority == "leased", next_token=next_token)
    dispatcher = Dispatcher(rig, authority, ledger, events, clock, instance, config.interlock)

    heartbeat = Heartbeat(config.heartbeat, rig) if config.heartbeat else None
    guests = tuple(
        partial(
            ports().serve,
            port,
            line.bus,
            tuple(line.network.axes.values()),
            tuple(line.network.io.values()),
            _GuestHost(line, rig, dispatcher),
        )
        for port in config.port
        for line in (rig.lines[port.bus],)
    )
    return Daemon(
        config,
        session,
        rig,
        dispatcher,
        publisher,
        clock,
        instance,
        latches,
        stops=stops,
        heartbeat=heartbeat,
        guests=guests,
    )


class _GuestHost:
    """What the daemon does for the guest of a port: see `ldcnd.config.ports.GuestHost`."""

    def __init__(self, line: BusService, rig: OwnedRig, dispatcher: Dispatcher) -> None:
        self._line, self._rig, self._dispatcher = line, rig, dispatcher

    def show(self, port: str, guest: GuestView | None, problem: str = "") -> None:
        self._line.guests.pop(port, None)
        self._line.unserved.pop(port, None)
        if guest:
            self._line.guests[port] = guest
        elif problem:
            self._line.unserved[port] = problem

    def is_up(self) -> bool:
        return self._line.report is not None

    def status(self, axis: str) -> StatusView:
        return self._rig.axes[axis].tracker.status

    def levels(self, module: str) -> Mapping[str, bool | None]:
        return self._rig.modules[module].values

    async def carry_out(self, about: str, command: Command[Frozen]) -> Frozen:
        return await self._dispatcher.answer(about, command)

    def check_rates(self, axis: str, velocity: float, acceleration: float | None) -> None:
        self._rig.axes[axis].motion.plans.at(velocity, acceleration)

    def is_traced(self, axis: str) -> bool:
        return self._rig.axes[axis].traces.is_busy

    def require_control(self, axis: str, lease: str) -> None:
        self._dispatcher.require_control(axis, lease)

    def leave(self, lease: str) -> None:
        self._dispatcher.leases.release(lease, gone=True)

    def tell(self, about: str, what: str, client: str) -> None:
        self._dispatcher.events.note(about, "guest", CommandStatus.DONE, what, client=client)

    def refuse(self, about: str, what: str, client: str) -> None:
        self._dispatcher.events.note(about, "guest", CommandStatus.REFUSED, what, client=client)


def _build_bus(
    config: RigConfig,
    settings: BusConfig,
    open_line: OpenLine[Any],
    make_axis: Callable[[AxisConfig, Bus, Drive], AxisService],
    openers: Mapping[str, Opener],
    note: Note,
) -> BusService:
    opener = openers.get(settings.name)
    if opener is None and settings.simulated:
        opener = simulator().opener_of(settings, config.sim)
    line = open_line(settings, opener)
    axes = tuple(make_axis(axis, line.bus, line.network.axes[axis.name]) for axis in settings.axis)
    return BusService(
        line.bus,
        line.network,
        axes,
        port=settings.port,
        family=settings.family,
        note=note,
        stop_probe_hz=demand_of(settings).stop_probe_hz,
    )
