"""The SECoP node: modules of frappy-core for axes and their values, and the server that they are on.

frappy-core has threads and no asyncio: what clients ask for runs on their threads and waits for the rig's loop. What
the rig publishes is announced on a thread of its own, as a client that does not read may hold that up for a second.
"""

import asyncio
import logging
import math
import socket
import threading
import time
from collections.abc import Coroutine
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, TypeVar

from frappy.datatypes import BoolType, FloatRange, StatusType
from frappy.errors import (
    CommunicationFailedError,
    HardwareError,
    ImpossibleError,
    RangeError,
    SECoPError,
    WrongTypeError,
)
from frappy.lib import generalConfig
from frappy.logging import init_remote_logging
from frappy.modules import Command, Drivable, Parameter, Readable
from frappy.protocol.dispatcher import Dispatcher, make_update
from frappy.protocol.interface.tcp import TCPServer
from frappy.protocol.messages import COMMANDREPLY, COMMANDREQUEST, ERRORPREFIX, WRITEREPLY, WRITEREQUEST
from frappy.server import Server

from ldcnd.client.loop_thread import LoopThread
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import check_axes
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import (
    AxisUnreachable,
    DriveFault,
    LdcndError,
    OutcomeUnknown,
    PositionLimit,
    SessionError,
    ValueOutOfRange,
)
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.number_text import is_number
from ldcnd.lab.secop.connection import Connection, Message, Stops
from ldcnd.lab.secop.link import AxisLink, StatusCode, Update, described_by, linked
from ldcnd.listen_address import ListenAddress

ENABLED = "_enabled"
"""What clients call `AxisDrivable.enabled`: SECoP has no such parameter."""

ResultT = TypeVar("ResultT")


class FiniteNumber(FloatRange):  # type: ignore[misc] # frappy has no types
    """A finite number; frappy takes a truth for 0 or 1, and infinity for the largest number."""

    def __call__(self, value: object) -> float:
        """Return what a client has sent as a number.

        Raises:
            WrongTypeError: it is none, or not finite.
        """
        if not is_number(value) or not math.isfinite(value):
            raise WrongTypeError("this is no finite number")
        number: float = super().__call__(value)
        return number

    def copy(self) -> "FiniteNumber":
        """Return another one that is alike; each module has copies, and frappy would make a FloatRange."""
        return FiniteNumber(**self.exportProperties())


class ValueModule(Readable):  # type: ignore[misc] # frappy has no types
    """What an axis publishes besides its position."""

    enablePoll = False  # noqa: N815 - frappy's name; values come by themselves
    status = Parameter(datatype=StatusType(Readable))


class AxisReadable(Readable):  # type: ignore[misc]
    """An axis that clients do not move."""

    enablePoll = False  # noqa: N815


class AxisDrivable(Drivable):  # type: ignore[misc]
    """An axis that clients move."""

    enablePoll = False  # noqa: N815
    status = Parameter(datatype=StatusType(Drivable, "DISABLED"))
    target = Parameter(datatype=FiniteNumber(unit="$"), readonly=False, default=0.0)
    speed = Parameter("velocity of the moves that follow", FiniteNumber(0, unit="$/s"), readonly=False, default=0.0)
    enabled = Parameter("the position loop is closed", BoolType(), readonly=False, default=False)

    def __init__(self, name: str, logger: object, cfgdict: dict[str, Any], srv: "SecNodeServer") -> None:
        super().__init__(name, logger, cfgdict, srv)
        self._node = srv

    @property
    def _link(self) -> AxisLink:
        return self._node.links[self.name]

    @property
    def _stops(self) -> int:
        """How often the axis had been stopped when the request under way was read."""
        return self._node.stops_of_request().get(self.name, self._link.stops)

    def write_target(self, value: float) -> float:
        """Send the axis there."""
        return self._node.wait(self._link.go(value, self._stops))

    def write_speed(self, value: float) -> float:
        """Have the moves that follow be so fast; 0 is the default of the axis."""
        self._link.speed = value or None
        return value

    def write_enabled(self, value: bool) -> bool:  # noqa: FBT001 - frappy's signature
        """Close or open the position loop."""
        self._node.wait(self._link.power_on(self._stops) if value else self._link.power_off())
        return value

    @Command()  # type: ignore[untyped-decorator]
    def stop(self) -> None:
        """Halt the axis."""
        self._node.wait(self._link.stop())

    @Command(export="clear_errors")  # type: ignore[untyped-decorator]
    def clear_errors(self) -> None:
        """Clear a latched stop and faults; nothing moves."""
        self._node.wait(self._link.clear_errors(self._stops))

    @Command()  # type: ignore[untyped-decorator]
    def reset(self) -> None:
        """Clear a latched stop and faults; nothing moves."""
        self.clear_errors()

    @Command()  # type: ignore[untyped-decorator]
    def home(self) -> None:
        """Find the reference position, as the configuration of the axis says."""
        self._node.wait(self._link.home(self._stops))


class AxisDispatcher(Dispatcher):  # type: ignore[misc]
    """Has requests of one axis wait for one another, and for those of no other.

    It says of a value how wrong it may be, and answers a read as its last update did, which frappy leaves out.
    """

    def handle_request(self, conn: Connection, msg: Message) -> Message:
        """Answer a request of a connection."""
        action, specifier, _ = msg
        module = self.secnode.modules.get((specifier or "").partition(":")[0])
        self.srv.take_request(conn)
        answer: Message
        if action in (COMMANDREQUEST, WRITEREQUEST) and module is not None:
            with module.accessLock:
                answer = getattr(self, f"handle_{action}")(conn, *msg[1:])
        else:
            answer = super().handle_request(conn, msg)
        return answer

    def announce_update(self, moduleobj: Any, pobj: Any) -> None:  # noqa: ANN401
        """Send an update to those who listen."""
        action, name, report = make_update(moduleobj.name, pobj)
        report[-1].update(self._error_of(moduleobj.name, pobj.export))
        self.broadcast_event((action, name, report))

    def _getParameterValue(self, modulename: str, exportedname: str) -> tuple[object, dict[str, object]]:  # noqa: N802
        value, qualifiers = super()._getParameterValue(modulename, exportedname)
        module = self.secnode.get_module(modulename)
        if error := module.parameters[module.accessiblename2attr[exportedname]].readerror:
            raise error
        return value, {**qualifiers, **self._error_of(modulename, exportedname)}

    def _error_of(self, module: str, parameter: str) -> dict[str, float]:
        error = self.srv.errors.get(module) if parameter == "value" else None
        return {} if error is None else {"e": error}


class LocalServer(TCPServer):  # type: ignore[misc]
    """A server that listens where it is told to, and not on every interface."""

    def server_bind(self) -> None:
        """Bind to the address of the node."""
        self.RequestHandlerClass = Connection  # frappy has its own
        self.server_address: tuple[str, int] = (self.dispatcher.srv.host, self.server_address[1])
        super().server_bind()


class SecNodeServer(Server):  # type: ignore[misc]
    """The node; it is made anew when what the axes are has changed.

    Args:
        rig: the name of the rig.
        address: where it listens.
        loop: where the rig is.
    """

    def __init__(self, rig: str, address: ListenAddress, loop: LoopThread) -> None:  # not frappy's: it reads files
        self.name = rig
        self.host = address.host
        self.links: dict[str, AxisLink] = {}
        self.errors: dict[str, float | None] = {}
        self.log = logging.getLogger("ldcnd.secop")
        self.log.setLevel(logging.CRITICAL)  # it logs every refusal with a traceback
        init_remote_logging(self.log)
        self.node_cfg = {
            "cls": f"{AxisDispatcher.__module__}.{AxisDispatcher.__name__}",
            "equipment_id": f"ldcnd.{rig}",
            "description": f"The axes of rig {rig}.",
        }
        self.module_cfg: dict[str, dict[str, Any]] = {}
        self._testonly = False
        self._port = address.port
        self._loop = loop
        self._announcing = ThreadPoolExecutor(1, "secop announcements")
        self._replying = ThreadPoolExecutor(8, "secop replies")  # a client that reads nothing holds up one
        self._request = threading.local()
        self._tcp: LocalServer | None = None
        self._early: dict[tuple[str, str], Update] | None = {}  # what came before there were modules

    def add(self, link: AxisLink) -> None:
        """Have modules for an axis and its values."""
        info = link.info
        self.links[info.axis] = link
        config: dict[str, Any] = {"cls": AxisReadable, "description": f"{info.axis}, {info.model}"}
        config["value"] = {"unit": info.unit}
        if link.moves:
            low, high = info.limits.position_min, info.limits.position_max
            limits = {"min": low, "max": high}
            config["cls"] = AxisDrivable
            config["target"] = {name: value for name, value in limits.items() if value is not None}
            most = info.limits.velocity or math.inf
            link.speed = link.speed and min(link.speed, most)
            config["speed"] = {"default": link.speed or 0.0} | ({"max": most} if math.isfinite(most) else {})
        self.module_cfg[info.axis] = config
        for name, unit in link.values().items():
            self.module_cfg[name] = {"cls": ValueModule, "description": name, "value": {"unit": unit}}

    def begin(self) -> None:
        """Make the modules, and listen; returns when clients can connect.

        Raises:
            OSError: the address cannot be had.
        """
        if not generalConfig.initialized:
            generalConfig.testinit()
        self._processCfg()
        self._loop.call(self._announce_early)
        self._tcp = LocalServer("tcp", self.log, {"uri": f"tcp://{self._port}"}, self)
        threading.Thread(target=self._tcp.serve_forever, name="secop", daemon=True).start()

    def end(self) -> None:
        """Close all connections, and stop to listen."""
        if self._tcp:
            self._tcp.shutdown()
            self._tcp.server_close()
            for connection in list(self.dispatcher._connections):  # noqa: SLF001 - frappy ends with its process
                connection.running = False
                # close alone ends nothing while the thread of the connection reads from it
                with suppress(OSError):  # the client may have gone
                    connection.request.shutdown(socket.SHUT_RDWR)
                connection.request.close()
        self._announcing.shutdown(wait=False, cancel_futures=True)
        self._replying.shutdown(wait=False, cancel_futures=True)

    def shutdown(self) -> None:
        """Do nothing: it is not for clients to end the node."""

    def restart(self) -> None:
        """Do nothing, likewise."""

    def announce(self, update: Update) -> None:
        """Tell clients of a new value, soon."""
        if self._early is None:
            self._announcing.submit(self._announce, update)
        else:
            self._early[update.module, update.parameter] = update

    def _announce_early(self) -> None:
        early, self._early = self._early or {}, None
        for update in early.values():
            self.announce(update)

    def _announce(self, update: Update) -> None:
        module = self.secnode.modules.get(update.module)
        if module is None or update.parameter not in module.parameters:
            return
        if update.parameter == "value":
            self.errors[update.module] = update.error
        problem = CommunicationFailedError(update.problem) if update.problem else None
        module.announceUpdate(update.parameter, update.value, problem, update.at_s)
        if isinstance(module, ValueModule):
            status = (StatusCode.ERROR, update.problem) if update.problem else (StatusCode.IDLE, "")
            if status != module.status:
                module.announceUpdate("status", status)

    # -- what waits for nothing --------------------------------------------------------------------------------------

    def stops(self) -> Stops:
        """Return how often each axis was stopped or switched off so far."""
        return {name: link.stops for name, link in self.links.items()}

    def take_request(self, connection: Connection) -> None:
        """Note what the thread of a connection answers from now on."""
        self._request.stops = connection.stops

    def stops_of_request(self) -> Stops:
        """Return how often each axis had been stopped when the request of this thread was read."""
        stops: Stops = getattr(self._request, "stops", {})
        return stops

    def calm(self, message: Message) -> Coroutine[object, object, object] | None:
        """Return what carries a message out that takes energy out, None for any other; it counts from here on."""
        action, specifier, value = message
        name, _, accessible = (specifier or "").partition(":")
        link = self.links.get(name)
        if link is None or not link.moves:
            return None
        if (action, accessible) == (COMMANDREQUEST, "stop"):
            return link.stop()
        is_false = isinstance(value, int | float) and not value
        return link.power_off() if is_false and (action, accessible) == (WRITEREQUEST, ENABLED) else None

    def carry_out(self, work: Coroutine[object, object, object], connection: Connection, message: Message) -> None:
        """Begin what takes energy out, and answer its client once it is done."""
        done = self._loop.start(work)

        def reply() -> None:
            action, specifier, _ = message
            try:
                done.result()
            except LdcndError as error:
                refusal = _as_secop(error)
                connection.send_reply((ERRORPREFIX + action, specifier, [refusal.name, str(refusal), {}]))
            except CancelledError:  # the node ends
                pass
            else:
                said = (COMMANDREPLY, None) if action == COMMANDREQUEST else (WRITEREPLY, False)
                connection.send_reply((said[0], specifier, [said[1], {"t": time.time()}]))

        def reply_soon(_: Future[object]) -> None:
            with suppress(RuntimeError):  # the node ends
                self._replying.submit(reply)

        done.add_done_callback(reply_soon)

    def wait(self, work: Coroutine[object, object, ResultT]) -> ResultT:
        """Do something on the rig's loop, and wait for it on the thread of a client.

        Raises:
            SECoPError: the rig refused it, or did not answer.
        """
        try:
            return self._loop.run(work)
        except LdcndError as error:
            raise _as_secop(error) from error


def _as_secop(error: LdcndError) -> SECoPError:
    text = f"{error}; {error.remedy}" if error.remedy else str(error)
    match error:
        case PositionLimit() | ValueOutOfRange():
            return RangeError(text)
        case DriveFault() | AxisUnreachable():
            return HardwareError(text)
        case SessionError() | OutcomeUnknown():
            return CommunicationFailedError(text)
        case _:
            return ImpossibleError(text)


async def serve(
    rig: Rig, address: ListenAddress, axes: tuple[str, ...], moves: tuple[str, ...], ready: asyncio.Event
) -> None:
    """Serve axes as a SECoP node until cancelled; what they are is described anew when that changes.

    Args:
        rig: the rig.
        address: where to listen.
        axes: which; all of them when none is named.
        moves: those that clients may move.
        ready: set when clients can connect.

    Raises:
        UnknownAxis: the rig has no such axis.
        OSError: the address cannot be had.
    """
    described = rig.follow_descriptions()
    infos = dict(await anext(described))
    check_axes(rig.name, axes, infos)
    former_units: dict[str, str] = {}
    speeds: dict[str, float | None] = {}
    while True:
        chosen = {name: info for name, info in infos.items() if not axes or name in axes}
        can_move = tuple(name for name in moves if name in chosen and Verb.MOVE_ABSOLUTE in chosen[name].capabilities)
        node = SecNodeServer(rig.name, address, LoopThread(asyncio.get_running_loop()))
        async with linked(rig, chosen, node.announce, can_move, former_units) as links:
            for name, link in links.items():
                link.speed = speeds.get(name)
                node.add(link)
            try:
                await asyncio.to_thread(node.begin)
                ready.set()
                async for again in described:
                    infos = dict(again)
                    if _is_other(chosen, infos, axes):
                        break
                former_units = {
                    name: link.former_unit or link.info.unit
                    for name, link in links.items()
                    if name in infos and (link.former_unit or link.info.unit != infos[name].unit)
                }
                # what a client has set it sets once; in another unit it would be another speed
                speeds = {name: link.speed for name, link in links.items() if name not in former_units}
            finally:
                await asyncio.to_thread(node.end)


def _is_other(before: dict[str, AxisInfo], now: dict[str, AxisInfo], axes: tuple[str, ...]) -> bool:
    shown = {name: described_by(info) for name, info in now.items() if not axes or name in axes}
    return shown != {name: described_by(info) for name, info in before.items()}
