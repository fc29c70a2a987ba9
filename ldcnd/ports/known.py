"""Ports of guests: a chain of their own behind a terminal, and what of it reaches the line."""

import asyncio
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from ldcnd.config.ports import GuestHost, PortConfig
from ldcnd.contract.commands import AxisCommand, CommandReply, Halt, Power
from ldcnd.contract.errors import LdcndError
from ldcnd.drives.driver import Drive
from ldcnd.drives.ldcn.commands import Node, read_status
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.io_module import IoModule
from ldcnd.drives.ldcn.packet import StatusItem
from ldcnd.drives.ldcn.pic_io import IoItem, IoNode, IoStatus, read_io_status
from ldcnd.drives.ldcn.profiles import PIC_IO, Profile
from ldcnd.drives.ldcn.received import PlainCommand, ReceivedCommand, StopMotor, UndescribedCommand
from ldcnd.drives.ldcn.servo import LdcnAxis
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.network import IoDriver
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange
from ldcnd.log import get_logger
from ldcnd.ports.guest_module import GuestModule, PendingReply
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.quirks import ModuleSettings

log = get_logger("ports")

PAUSE_PER_EXCHANGE = 3.0
"""A guest's exchange is followed by a pause of so many times its length: others keep three quarters of the line."""
SAME_REFUSAL_S = 1.0
"""The same refusal of an axis is one event in this time: old programs repeat themselves."""
READ_BYTES = 4096


def check(port: PortConfig, line: BusConfig) -> None:
    """Refuse a port of another family; raises ValueError."""
    if line.family != "ldcn":
        raise ValueError(
            f"port {port.name}: bus {line.name} is of the family {line.family}; only ldcn lines have ports"
        )


@dataclass(slots=True)
class _GuestAxis:
    """An axis or another module as a guest reaches it, with what it has set going.

    Attributes:
        stops: whether it is an axis, which a guest may stop.
    """

    name: str
    read: Callable[[StatusItem], Exchange[Any]]
    stops: bool
    under_way: "dict[type, asyncio.Task[None]]" = field(default_factory=dict)
    again: set[type] = field(default_factory=set)


class Guest:
    """A guest on one line: takes its bytes, returns what the modules answer.

    Attributes:
        chain: as the guest sees the line.
    """

    def __init__(
        self,
        name: str,
        bus: Bus,
        drives: Sequence[Drive],
        ios: Sequence[IoDriver],
        host: GuestHost,
        group: asyncio.TaskGroup,
    ) -> None:
        self._name, self._bus, self._host, self._group = name, bus, host, group
        self._loop = asyncio.get_running_loop()
        self._line, self._free_at_s = asyncio.Lock(), 0.0
        self._refused: dict[tuple[str, str], float] = {}
        self._timer: asyncio.TimerHandle | None = None
        self.receive: Callable[[bytes], None] = lambda _: None
        settings = ModuleSettings(reset_dead_s=0.0)  # programs take a terminal for drained at once
        modules: dict[int, GuestModule] = {}

        def add(address: int, profile: Profile, reached: _GuestAxis) -> None:
            ask, command = partial(self._ask, reached), partial(self._command, reached)
            modules[address] = GuestModule(profile, settings, ask, command)

        for drive in drives:
            if isinstance(drive, LdcnAxis):
                node = Node(drive.spec.address, drive.profile)
                add(node.address, drive.profile, _GuestAxis(drive.spec.name, partial(read_status, node), stops=True))
        for io in ios:
            if isinstance(io, IoModule):
                add(io.node, PIC_IO, _GuestAxis(io.name, partial(_read_io, io.node), stops=False))
        self.chain = Chain([modules[address] for address in sorted(modules)])

    def send(self, data: bytes) -> None:
        """Take bytes of the guest."""
        self.chain.write(self._loop.time(), data)
        self._advance()

    def _advance(self) -> None:
        """Do what is due on the guest's chain, and come back for what is due next."""
        if self._timer:
            self._timer.cancel()
        due = b"".join(piece for _, piece in self.chain.advance(self._loop.time()))
        next_s = self.chain.next_event_s()
        self._timer = self._loop.call_at(next_s, self._advance) if next_s is not None else None
        if due:
            self.receive(due)

    def _ask(self, axis: _GuestAxis, items: StatusItem, answer: PendingReply) -> None:
        self._group.create_task(self._read(axis, items, answer), name=f"guest {self._name} reads {axis.name}")

    async def _read(self, axis: _GuestAxis, items: StatusItem, answer: PendingReply) -> None:
        """PendingReply with a reading of the drive, made after what the guest has set going there before."""
        if axis.under_way:
            await asyncio.wait(tuple(axis.under_way.values()))
        async with self._line:
            await asyncio.sleep(self._free_at_s - self._loop.time())
            if not answer.wanted() or not self._host.is_up():
                return
            began_s = self._loop.time()
            try:
                status = await self._bus.execute(_as_sent(axis.read(items)))
            except LdcndError as error:
                log.debug("not read", guest=self._name, axis=axis.name, reason=error.message)
                return
            finally:
                now_s = self._loop.time()
                self._free_at_s = now_s + PAUSE_PER_EXCHANGE * (now_s - began_s)
        answer.give(status, self._loop.time())
        self._advance()

    def _command(self, axis: _GuestAxis, command: ReceivedCommand) -> None:
        """Take energy out at once; refuse everything else."""
        relief = _relief(command, self._name) if axis.stops else None
        if relief is None:
            self._refuse(axis.name, command)
            return
        kind = type(relief)
        if kind in axis.under_way:
            axis.again.add(kind)  # one more behind it, however many come: each is followed by one that begins later
            return
        task = self._group.create_task(self._carry_out(axis, relief), name=f"guest {self._name} stops {axis.name}")
        axis.under_way[kind] = task
        task.add_done_callback(lambda _: axis.under_way.pop(kind))

    async def _carry_out(self, axis: _GuestAxis, command: AxisCommand[CommandReply]) -> None:
        again = True
        while again:
            with suppress(LdcndError):  # the daemon has entered it among the events
                await self._host.carry_out(axis.name, command)
            again = type(command) in axis.again
            axis.again.discard(type(command))

    def _refuse(self, axis: str, command: ReceivedCommand) -> None:
        match command:
            case PlainCommand(code):
                what = code.name.lower()
            case UndescribedCommand(code):
                what = f"command {int(code)}"
            case _:
                what = type(command).__name__
        now_s = self._loop.time()
        if now_s - self._refused.get((axis, what), -SAME_REFUSAL_S) >= SAME_REFUSAL_S:
            self._refused[axis, what] = now_s
            self._host.refuse(axis, what, self._name)


def _read_io(address: int, items: StatusItem) -> Exchange[IoStatus]:
    return read_io_status(IoNode(address), IoItem(int(items)))


def _as_sent(exchange: Exchange[Any]) -> Exchange[bytes]:
    """Return an exchange that returns the reply as it was sent: intact, and not decoded."""
    return replace(exchange, decode=bytes)


def _relief(command: ReceivedCommand, client: str) -> AxisCommand[CommandReply] | None:
    """Return what takes the energy out that a guest's Stop Motor takes out; None for what does more or something else.

    Without its amplifier bit it switches the power driver off whatever else it says; going to a position is motion.
    """
    if not isinstance(command, StopMotor):
        return None
    if command.control & StopControl.MOTOR_OFF or not command.control & StopControl.AMP_ENABLE:
        return Power(on=False, client=client)
    if command.control & (StopControl.ABRUPT | StopControl.SMOOTH):
        return Halt(client=client)
    return None


async def serve(port: PortConfig, bus: Bus, drives: Sequence[Drive], ios: Sequence[IoDriver], host: GuestHost) -> None:
    """Serve a guest on a terminal until cancelled; a failure ends its port and nothing else."""
    try:
        async with asyncio.TaskGroup() as group:
            with ExitStack() as stack:
                _open(port, Guest(port.name, bus, drives, ios, host, group), stack)
                await asyncio.Event().wait()
    except Exception:
        log.exception("port ended", guest=port.name, bus=port.bus)


def _open(port: PortConfig, guest: Guest, stack: ExitStack) -> None:
    """Put a terminal in front of a guest's chain, until the stack closes."""
    # a configuration with a port can be read where there are no terminals
    import tty  # noqa: PLC0415

    from ldcnd.line.line_discipline import actual_baud  # noqa: PLC0415
    from ldcnd.line.terminal_link import TerminalLink  # noqa: PLC0415

    loop = asyncio.get_running_loop()
    master, slave = os.openpty()
    stack.callback(os.close, master)
    stack.callback(os.close, slave)  # our end stays open, so that a program may come and go
    tty.setraw(slave)
    os.set_blocking(master, False)
    path = Path(os.ttyname(slave))
    path.chmod(int(port.mode, 8))
    link = TerminalLink(port.link, path)
    stack.callback(link.close)

    def to_guest(data: bytes) -> None:
        with suppress(BlockingIOError):  # the program does not read: a real line does not wait either
            os.write(master, data)

    def from_guest() -> None:
        with suppress(BlockingIOError):
            data = os.read(master, READ_BYTES)
            guest.chain.baud = actual_baud(master) or guest.chain.baud
            guest.send(data)

    guest.receive = to_guest
    loop.add_reader(master, from_guest)
    stack.callback(loop.remove_reader, master)
    log.info("port", guest=port.name, bus=port.bus, link=str(port.link), terminal=str(path), access=port.access)
