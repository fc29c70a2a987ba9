"""A guest on one line: a chain of its own, and what of its packets reaches the drives."""

import asyncio
import math
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from typing import Any

from pydantic import ValidationError
from typing_extensions import override

from ldcnd.config.ports import GuestHost, PortConfig
from ldcnd.contract.codec import explained
from ldcnd.contract.commands import AxisCommand, CommandReply, Effect, Halt, Home, MoveRelative, Power
from ldcnd.contract.errors import CommandAborted, LdcndError, OutcomeUnknown
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import RIG_ITSELF
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import Drive
from ldcnd.drives.ldcn.commands import Node, read_status
from ldcnd.drives.ldcn.io_module import IoModule
from ldcnd.drives.ldcn.packet import POSITION, CommandCode, StatusFlag, StatusItem, decode_packet, item_bytes
from ldcnd.drives.ldcn.pic_io import (
    ITEM_BYTES,
    IoItem,
    IoNode,
    IoStatus,
    SetPwmOutputs,
    SynchInput,
    read_io_status,
)
from ldcnd.drives.ldcn.profiles import PIC_IO, Profile
from ldcnd.drives.ldcn.received import LoadTrajectory, PlainCommand, ReceivedCommand, StopMotor
from ldcnd.drives.ldcn.servo import LdcnAxis
from ldcnd.drives.ldcn.trajectory import Trajectory
from ldcnd.drives.network import IoDriver
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange
from ldcnd.line.proof import Condition
from ldcnd.log import get_logger
from ldcnd.ports.control import GuestControl, Visit
from ldcnd.ports.fresh import FreshReplies
from ldcnd.ports.guest_module import GuestModule, PendingReply
from ldcnd.ports.outputs import GuestOutputs
from ldcnd.ports.presence import Presence
from ldcnd.ports.share import LineShare
from ldcnd.ports.translate import GuestServo, name_of, relief
from ldcnd.sim.chain import BITS_PER_BYTE, Chain
from ldcnd.sim.ldcn.chain import model

log = get_logger("ports")

UNPAUSED_S = 0.05
"""Time of the line that a guest which has paused may use without a pause, seconds: its replies come at once."""
MOST_UNSENT_BYTES = 4096
"""Bytes of a guest that are on their way to its modules, as much as a serial driver keeps; more wait in its door."""
MOST_WAITING = 32
"""Commands of a guest that wait for their turn at one module; what comes beyond is refused."""
OBEYED_S = 0.005
"""Some servo cycles, seconds: a module obeys a packet at the end of one."""
REPLY_WAIT_S = 0.04
"""How long a reply waits for what was commanded before it, seconds: programs wait for 50 ms and more."""
SETTLES_S = 2.0
COMES_TO_REST_S = 60.0
LOOK_S = 0.01


@dataclass(slots=True)
class _Reached:
    """An axis or another module as a guest reaches it, with what it has set going.

    Attributes:
        node: its address on the line.
        width: returns how many bytes of its status packets an item of the mask takes.
        servo: its drive as the guest commands it; None of a module that is none.
        outputs: of a module, likewise.
        reliefs: what takes energy out and is on its way, by its kind.
        again: of these, what is asked for once more meanwhile.
        waiting: what waits for its turn.
        stops: how many stops its guest has sent.
        own: how many of the stops that the axis has carried out are of this guest.
        idle: set while nothing of the guest's commands is under way.
        at_work: the command that is being carried out.
        restarts: how often its drive had restarted when the guest's module was as that drive was last.
        captured: levels and counter that the guest's latest Synch Input has found.
        capture: reads them.
    """

    name: str
    profile: Profile
    node: int
    read: Callable[[StatusItem], Exchange[Any]]
    width: Callable[[int], int]
    servo: GuestServo | None = None
    outputs: GuestOutputs | None = None
    reliefs: "dict[type, asyncio.Task[None]]" = field(default_factory=dict)
    again: set[type] = field(default_factory=set)
    waiting: "deque[_Waiting]" = field(default_factory=deque)
    stops: int = 0
    own: int = 0
    idle: asyncio.Event = field(default_factory=asyncio.Event)
    at_work: "_Waiting | None" = None
    restarts: int = 0
    captured: tuple[int, int] = (0, 0)
    capture: "asyncio.Task[None] | None" = None

    def about_to_move(self) -> bool:
        """Tell whether a motion of the guest has yet to begin: a drive that has the command itself would move."""
        at_work = (self.at_work,) if self.at_work else ()
        return any(_moves(each.command) for each in (*at_work, *self.waiting))


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A command that waits for its turn, or has it.

    Attributes:
        command: as it was sent.
        stops: number of the latest stop that came before it; see `Guest._stops`.
        starts: the trajectory that it starts; None for none.
        visit: in which it was sent.
    """

    command: ReceivedCommand
    stops: int
    starts: Trajectory | None
    visit: Visit


def _begins(command: AxisCommand[CommandReply] | None) -> bool:
    """Tell whether a stop is to keep a command from beginning; what only sets or forgets moves nothing."""
    return command is not None and (command.effect is Effect.MOTION or (isinstance(command, Power) and command.on))


def _moves(command: ReceivedCommand) -> bool:
    match command:
        case LoadTrajectory(trajectory):
            return trajectory.start_now
        case PlainCommand(code):
            return code is CommandCode.START_MOTION
    return False


class Guest(Presence):
    """A guest on one line: takes its bytes, returns what the modules answer.

    Attributes:
        chain: as the guest sees the line.
    """

    def __init__(
        self,
        port: PortConfig,
        bus: Bus,
        drives: Sequence[Drive],
        ios: Sequence[IoDriver],
        host: GuestHost,
        group: asyncio.TaskGroup,
    ) -> None:
        super().__init__(port, host, group)
        self._bus = bus
        self._share = LineShare(UNPAUSED_S, lambda: bus.guests_s.get(port.name, 0.0))
        self._fresh = FreshReplies(bus, port.fresh_ms)
        self._timer: asyncio.TimerHandle | None = None
        self._axes = tuple(drive.spec.name for drive in drives)
        self._reached: list[_Reached] = []
        modules: dict[int, GuestModule] = {}

        def add(address: int, reached: _Reached) -> None:
            reached.idle.set()
            self._reached.append(reached)
            ask, command = partial(self._ask, reached), partial(self._command, reached)
            # a reset takes no time: programs take a terminal for drained as soon as they have written
            settings = model(reached.profile.name)[1].model_copy(update={"reset_dead_s": 0.0})
            modules[address] = GuestModule(reached.profile, settings, ask, command, partial(self._reset, reached))

        for drive in drives:
            if isinstance(drive, LdcnAxis):
                name, node = drive.spec.name, Node(drive.spec.address, drive.profile)
                servo = GuestServo(drive, partial(host.status, name), port.name)
                read, width = partial(read_status, node), partial(_servo_width, drive.profile)
                add(node.address, _Reached(name, drive.profile, node.address, read, width, servo))
        for io in ios:
            if isinstance(io, IoModule):
                outputs = GuestOutputs(io.name, io.outputs, host.levels)
                read_io = partial(_read_io, io.node)
                add(io.node, _Reached(io.name, PIC_IO, io.node, read_io, _io_width, outputs=outputs))
        self._by_node = modules
        self._modules = tuple(modules[address] for address in sorted(modules))
        self.chain = Chain(self._modules)
        for each in self._modules:
            each.neighbours = self._modules

    def send(self, data: bytes, baud: int | None) -> int:
        """Take bytes of the guest, and return how many; see `Door.take`."""
        if self.ended:
            return len(data)
        if self._heard():
            self.chain.unplug(self._loop.time())  # a reply to the one before may be on its way
            self.chain.replug()
            for module in self._modules:
                module.drop_half_packets()
            for reached in self._reached:
                if reached.servo:
                    reached.servo.restart()  # the one before may have loaded something with the last that it sent
        now_s, self.chain.baud = self._loop.time(), self._rate(baud)
        room = MOST_UNSENT_BYTES - math.ceil(self.chain.leaving_s(now_s) * self.chain.baud / BITS_PER_BYTE)
        taken = data[: max(0, room)]
        self.chain.write(now_s, taken)
        self._advance()
        return len(taken)

    @override
    def leave(self, left: bytes, baud: int | None) -> None:
        super().leave(left, baud)
        now_s = self._loop.time()
        if left:
            self.chain.baud = self._rate(baud)
            self.chain.write(now_s, left[-MOST_UNSENT_BYTES:])  # all other work stands still meanwhile
        # a stop is the last that a program sends: it does not wait for the rate, as the next program may come before
        self.chain.pass_until(now_s + self.chain.leaving_s(now_s) + OBEYED_S)
        self._advance()

    def _rate(self, baud: int | None) -> int:
        return baud or int(self.chain.modules[0].baud)

    @override
    def close(self) -> None:
        super().close()
        self._fresh.close()
        if self._timer:
            self._timer.cancel()

    @override
    async def gone(self) -> None:
        # what it sent last comes to its modules yet: they stop by it and begin nothing
        for each in self._reached:
            self._drop(each)
            # the next program does not begin what this one has loaded
            if each.servo:
                each.servo.restart()
            if each.outputs:
                each.outputs.gone()
        await super().gone()

    def _advance(self) -> None:
        """Do what is due on the guest's chain, and come back for what is due next."""
        if self.ended:
            return
        if self._timer:
            self._timer.cancel()
        due = b"".join(piece for _, piece in self.chain.advance(self._loop.time()))
        next_s = self.chain.next_event_s()
        self._timer = self._loop.call_at(next_s, self._advance) if next_s is not None else None
        if due:
            self.receive(due)

    # -- reading -----------------------------------------------------------------------------------------------------

    def _has_restarted(self, module: _Reached) -> bool:
        """Tell whether its drive was reset or lost power since; the guest's module is then as after that."""
        seen = module.servo.drive.restarts if module.servo else 0
        if seen == module.restarts:
            return False
        module.restarts = seen
        self._by_node[module.node].lose_power(self._loop.time())
        return True

    def _ask(self, module: _Reached, items: StatusItem, answer: PendingReply) -> None:
        if self._visit is None:
            return  # nobody waits for it
        self.packets += 1
        if self._has_restarted(module):
            return  # what counts from 0 anew would pass for where the program has left it
        self._group.create_task(self._read(module, items, answer), name=f"guest {self._name} reads {module.name}")

    async def _read(self, module: _Reached, items: StatusItem, answer: PendingReply) -> None:
        """Answer with a reading of the drive, made after what the guest has set going there before."""
        if module.reliefs:
            await asyncio.wait(tuple(module.reliefs.values()))
        with suppress(TimeoutError):
            async with asyncio.timeout(REPLY_WAIT_S):
                await module.idle.wait()
                if module.capture:
                    await asyncio.wait((module.capture,))
        status = self._fresh_status(module, int(items)) if self._host.is_up() else None
        if status is None:
            async with self._share.turn():
                if not answer.wanted() or not self._host.is_up():
                    return
                try:
                    status = await self._bus.execute(_as_sent(module.read(items)))
                except LdcndError as error:
                    log.debug("not read", guest=self._name, axis=module.name, reason=error.message)
                    return
        answer.give(_as_guest(module, items, status, self._loop.time()), self._loop.time())
        self._advance()

    def _fresh_status(self, module: _Reached, items: int) -> bytes | None:
        """Return a status packet with these items that is made of a fresh one; None without one that has them all."""
        for request, reply in self._fresh.of(module.node):
            packet = decode_packet(request)
            if packet.command is CommandCode.READ_STATUS and not items & ~packet.data[0]:
                return _narrowed(reply, packet.data[0], items, module.width)
        return None

    # -- commanding --------------------------------------------------------------------------------------------------

    def _command(self, module: _Reached, command: ReceivedCommand) -> None:
        """Take energy out at once; what does more waits for its turn, or is refused."""
        if self._has_restarted(module) and not isinstance(command, StopMotor):
            return
        if module.outputs and isinstance(command, SynchInput):  # the registers of the module are the daemon's
            earlier = module.capture
            work = self._capture(module, earlier)
            module.capture = self._group.create_task(work, name=f"guest {self._name} captures {module.name}")
            return
        if module.servo and isinstance(command, StopMotor):
            module.servo.stopped(command.control)
        starts = module.servo.takes(command) if module.servo else None
        # of a program that may only read, Stop Motor alone reaches the line
        found = relief(command, self._name, starts if self._control else None) if module.servo else None
        module.stops += found is not None  # from here on: what it overtakes may be about to begin
        if found is not None and not (self._control and self._closes_the_loop(module, found)):
            # what only sets something was done by then on the bare line, and the program counts on it
            module.waiting = deque(each for each in module.waiting if not each.starts)
            self._relieve(module, found)
        elif self._control is None:
            self._miss(module, command, f"the port {self._name} has access = read")
        elif self._visit is None:
            self._miss(module, command, f"{self._name} has gone before it began")
        elif len(module.waiting) >= MOST_WAITING:
            self._miss(module, command, f"{MOST_WAITING} commands wait already")
        else:
            if found is not None and not module.idle.is_set():
                self._relieve(module, found)  # whatever is on its way may move it by then
            module.waiting.append(_Waiting(command, self._stops(module), starts, self._visit))
            if module.idle.is_set():
                module.idle.clear()
                work = self._work(module, self._control)
                self._group.create_task(work, name=f"guest {self._name} commands {module.name}")

    def _miss(self, module: _Reached, command: ReceivedCommand, why: str, *, unknown: bool = False) -> None:
        """Refuse a command: its program takes it for done."""
        if module.servo:
            module.servo.missed(command)
        self._refuse(module.name, name_of(command), why, unknown=unknown)

    def _drop(self, module: _Reached) -> None:
        """Drop what waits."""
        while module.waiting:
            command = module.waiting.popleft().command
            if module.servo:
                module.servo.missed(command)

    def _stops(self, module: _Reached) -> int:
        """Return the number of the latest stop: the guest's own count when they come, and others' when they happen."""
        return module.stops - module.own + self._host.status(module.name).stops if module.servo else 0

    async def _stop(self, module: _Reached, command: AxisCommand[CommandReply]) -> Frozen:
        """Carry out a stop that the guest has counted already, or that is no stop of what it has sent before."""
        module.own += 1
        return await self._host.carry_out(module.name, command)

    async def _capture(self, module: _Reached, earlier: "asyncio.Task[None] | None") -> None:
        """Keep what the inputs are, behind what the guest has commanded before."""
        if earlier:
            await asyncio.wait((earlier,))
        await module.idle.wait()
        with suppress(LdcndError):  # then it keeps what it captured before, as a module that did not hear
            async with self._share.turn():
                found = await self._bus.execute(read_io_status(IoNode(module.node), IoItem.LEVELS | IoItem.COUNTER))
                module.captured = (found.levels or 0, found.counter or 0)

    def _closes_the_loop(self, module: _Reached, found: AxisCommand[CommandReply]) -> bool:
        return isinstance(found, Halt) and not self._host.status(module.name).enabled

    def _relieve(self, module: _Reached, command: AxisCommand[CommandReply]) -> None:
        kind = type(command)
        if kind in module.reliefs:
            module.again.add(kind)  # one more behind it, however many come: each is followed by one that begins later
            return
        task = self._group.create_task(self._carry_out(module, command), name=f"guest {self._name} stops {module.name}")
        module.reliefs[kind] = task
        task.add_done_callback(lambda _: module.reliefs.pop(kind))

    async def _carry_out(self, module: _Reached, command: AxisCommand[CommandReply]) -> None:
        again = True
        while again:
            with suppress(LdcndError):  # the daemon has entered it among the events
                await self._stop(module, command)
            self._fresh.changed(module.node)
            again = type(command) in module.again
            module.again.discard(type(command))

    def _reset(self, module: _Reached) -> None:
        """A Hard Reset of the guest's chain: the motors of the axes that it controls are off, as on a line."""
        self._drop(module)
        module.stops += 1
        if module.outputs:
            module.outputs.restart()
            module.captured = (0, 0)
            if module.outputs.drives_pwm:
                self._command(module, SetPwmOutputs(0, 0))  # as a reset leaves it
        if module.servo:
            module.restarts = module.servo.drive.restarts
            module.servo.hard_reset()
            if self._control and module.name in self._control.axes:
                self._relieve(module, Power(on=False, client=self._name))
            if self._control and self._visit and self._host.status(module.name).state is AxisState.ERROR_STOP:
                self._command(module, PlainCommand(CommandCode.CLEAR_STICKY_BITS))  # a drive has no fault afterwards

    async def _work(self, module: _Reached, control: GuestControl) -> None:
        """Carry out what waits, one after another."""
        try:
            while module.waiting:
                if module.reliefs:
                    await asyncio.wait(tuple(module.reliefs.values()))
                    continue
                module.at_work = module.waiting.popleft()
                command = module.at_work.command
                try:
                    await self._obey(module, module.at_work, control)
                except LdcndError as error:
                    self._miss(module, command, error.message, unknown=isinstance(error, OutcomeUnknown))
                except ValidationError as error:  # a packet holds values that no command has
                    self._miss(module, command, explained(error).message)
                except TimeoutError:
                    self._miss(module, command, "the axis does not come to rest")
        finally:
            self._fresh.changed(module.node)
            module.at_work = None
            module.idle.set()

    async def _obey(self, module: _Reached, at_work: _Waiting, control: GuestControl) -> None:
        command = at_work.command
        if module.servo:
            await self._obey_servo(module, module.servo, at_work, partial(control.over, visit=at_work.visit))
        elif module.outputs:
            wanted, before = module.outputs.meaning(command), module.outputs.resets
            if wanted:
                lease = await control.over(self._axes, at_work.visit)
                if module.outputs.resets != before:
                    return
                module.outputs.begins(wanted)
                await self._host.carry_out(RIG_ITSELF, wanted.model_copy(update={"lease": lease}))
            module.outputs.carried_out(command, wanted)

    async def _obey_servo(
        self,
        module: _Reached,
        servo: GuestServo,
        at_work: _Waiting,
        take_control: Callable[[Sequence[str]], Awaitable[str]],
    ) -> None:
        axis, received, starts = module.name, at_work.command, at_work.starts

        def ask() -> None:
            if _begins(meaning.command) and self._stops(module) != at_work.stops:
                raise CommandAborted("a stop has come before it began")

        meaning = servo.meaning(received, starts)
        if meaning.from_rest:
            # a drive ignores what it does not carry out: nobody's motion ends for a move that is refused
            await take_control((axis,))
            self._check_rates(axis, meaning.command)
            await self._come_to_rest(module, ask)
            meaning = servo.meaning(received, meaning.from_rest)  # way and direction are others from there
        elif not meaning.interrupts:
            await self._settled(axis, ask)
        if meaning.zeroes_home:
            await self._zero_home(servo)
        command = meaning.command
        if command is None:
            return
        if command.takes_energy_out:
            reply = await self._stop(module, command)
        else:
            command = command.model_copy(update={"lease": await take_control((axis,))})
            ask()  # its permit is only made now: a stop that came before overtakes nothing in the axis
            reply = await self._host.carry_out(axis, command)
        if isinstance(reply, CommandReply):
            servo.begun(command, reply.command_id, self._loop.time(), starts)
        if meaning.zeroes is not None:
            scale = self._host.status(axis).scale
            placed = meaning.zeroes / scale.counts_per_unit - scale.position(0)
            servo.set_zero(placed * scale.counts_per_unit, meaning.zeroes)

    def _check_rates(self, axis: str, command: AxisCommand[CommandReply] | None) -> None:
        """Refuse a motion whose speed or acceleration would be; way and switches are others from where the axis rests.

        Raises:
            RequestRefused: as the motion would be refused.
        """
        if isinstance(command, MoveRelative | Home) and command.velocity:
            self._host.check_rates(axis, command.velocity, command.acceleration)

    async def _settled(self, axis: str, ask: Condition) -> None:
        """Wait until a motion whose profile is over has settled: its program knows no more than that it is over."""
        with suppress(TimeoutError):
            async with asyncio.timeout(SETTLES_S):
                await self._until(lambda: self._host.status(axis).command is None, ask)

    async def _come_to_rest(self, module: _Reached, ask: Condition) -> None:
        """Wait until the axis stands, after having halted what goes on."""
        axis = module.name
        status = self._host.status(axis)
        if status.command is not None and (status.ends_at_s or math.inf) <= self._loop.time():
            await self._settled(axis, ask)
        if self._host.status(axis).command is not None or not self._host.status(axis).at_rest:
            await self._stop(module, Halt(client=self._name))
        async with asyncio.timeout(COMES_TO_REST_S):
            await self._until(lambda: self._host.status(axis).command is None and self._host.status(axis).at_rest, ask)

    async def _until(self, condition: Callable[[], bool], ask: Condition) -> None:
        """Wait for a condition, as long as what waits may begin."""
        ask()
        while not condition():  # its readings tell, and nobody announces them here
            await asyncio.sleep(LOOK_S)
            ask()

    async def _zero_home(self, servo: GuestServo) -> None:
        servo.require_home()
        drive = servo.drive
        status = await self._bus.execute(read_status(Node(drive.spec.address, drive.profile), StatusItem.HOME))
        if status.home is not None:
            servo.set_zero(status.home + drive.state.offset_counts, 0)


def _read_io(address: int, items: StatusItem) -> Exchange[IoStatus]:
    return read_io_status(IoNode(address), IoItem(int(items)))


def _servo_width(profile: Profile, item: int) -> int:
    return item_bytes(profile, StatusItem(item))


def _io_width(item: int) -> int:
    return ITEM_BYTES[item.bit_length() - 1]


def _narrowed(status: bytes, mask: int, items: int, width: Callable[[int], int]) -> bytes:
    """Return the status packet with fewer items: they come in the order of the bits of the mask.

    Source: PIC-SERVO manual, 5.2, "Define Status"; PIC-I/O data sheet, 3.1.
    """
    body, at = bytearray(status[:1]), 1
    for item in (1 << bit for bit in range(8) if mask & 1 << bit):
        body += status[at : at + width(item)] if items & item else b""
        at += width(item)
    return bytes(body) + bytes((sum(body) & 0xFF,))


def _as_sent(exchange: Exchange[Any]) -> Exchange[bytes]:
    """Return an exchange that returns the reply as it was sent: intact, and not decoded."""
    return replace(exchange, decode=bytes)


def _as_guest(module: _Reached, items: StatusItem, status: bytes, now_s: float) -> bytes:
    """Return a status packet as this guest's own drive would send it now: its counter, and what it has set going."""
    servo = module.servo
    if servo is None:
        return _with_captured(module, int(items), status)
    told, flags = bytearray(status), servo.flags(StatusFlag(status[0]), now_s)
    told[0] = int(flags & ~StatusFlag.MOVE_DONE if module.about_to_move() else flags)
    for item, shown in ((StatusItem.POSITION, servo.counter), (StatusItem.HOME, servo.home)):
        if items & item:
            at = 1 + item_bytes(module.profile, items & (int(item) - 1))
            counter = shown(POSITION.decode(bytes(told[at : at + POSITION.width])))
            told[at : at + POSITION.width] = counter.to_bytes(POSITION.width, "little", signed=True)
    return bytes(told)


def _with_captured(module: _Reached, items: int, status: bytes) -> bytes:
    """Return a status packet of a PIC-I/O with what its guest has captured, not with what the daemon has."""
    told, at = bytearray(status), 1
    for item in (1 << bit for bit in range(8) if items & 1 << bit):
        width = module.width(item)
        if captured := _CAPTURED.get(item):
            told[at : at + width] = captured(module.captured).to_bytes(width, "little")
        at += width
    return bytes(told)


_CAPTURED = {int(IoItem.CAPTURED_LEVELS): itemgetter(0), int(IoItem.CAPTURED_COUNTER): itemgetter(1)}
