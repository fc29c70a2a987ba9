"""A guest on a line of SmartSteps: its frames are exchanges of the line, or commands of an axis.

The line is not simulated before its drives, as one of LDCN is: a frame goes on as soon as it is complete, and the reply
comes in one piece once it is known to be intact, at the same time as its last character on the line.
"""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from pydantic import ValidationError
from typing_extensions import override

from ldcnd.config.ports import GuestHost, PortConfig
from ldcnd.contract.codec import explained
from ldcnd.contract.errors import AxisUnreachable, BusError, DataRefused, LdcndError, ValueOutOfRange
from ldcnd.drives.driver import Drive
from ldcnd.drives.smartstep.addresses import OperatingMode, Register, TraceRegister
from ldcnd.drives.smartstep.commands import (
    Refusal,
    execute,
    reference,
    set_operating_mode,
    string_reference,
    write_trace_register,
)
from ldcnd.drives.smartstep.drive import SmartStepAxis
from ldcnd.drives.smartstep.modes import leave
from ldcnd.drives.smartstep.network import BAUD
from ldcnd.drives.smartstep.packet import (
    END,
    PACKET_CHARACTERS,
    CommandPacket,
    Function,
    ReplyPacket,
    ResponseStatus,
    add_parity,
    decode_command,
    decode_reply,
    strip_parity,
)
from ldcnd.drives.smartstep.profiles import CountUnit, SmartStepProfile
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange
from ldcnd.line.proof import only_while
from ldcnd.log import get_logger
from ldcnd.ports.control import Visit
from ldcnd.ports.fresh import FreshReplies
from ldcnd.ports.guest_unit import GuestUnit
from ldcnd.ports.presence import Presence
from ldcnd.ports.share import LineShare

log = get_logger("ports")

UNPAUSED_S = 7.0
"""Time of the line that a guest which has paused may use without a pause, seconds: more than a trace takes."""
PARITY_BIT = 0x80
_BYTES_OF_COUNT = {CountUnit.BYTES: 1.0, CountUnit.WORDS: 2.0, CountUnit.CHARS: 0.5}


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """A frame whose reply the guest waits for."""

    frame: bytes
    command: CommandPacket
    visit: Visit


class UnitsGuest(Presence):
    """A guest on one line: takes its bytes, returns what the drives answer."""

    def __init__(
        self, port: PortConfig, bus: Bus, drives: Sequence[Drive], host: GuestHost, group: asyncio.TaskGroup
    ) -> None:
        super().__init__(port, host, group)
        self._fresh = FreshReplies(bus, port.fresh_ms)
        self._units = {
            drive.spec.address: GuestUnit(drive, partial(host.is_traced, drive.spec.name))
            for drive in drives
            if isinstance(drive, SmartStepAxis)
        }
        self._share = LineShare(UNPAUSED_S, lambda: bus.guests_s.get(port.name, 0.0))
        self._line = bytearray()
        self._latest: _Asked | None = None
        self._came = asyncio.Event()
        group.create_task(self._serve(), name=f"guest {self._name}")

    def send(self, data: bytes, baud: int | None) -> int:
        """Take bytes of the guest, sent at this rate; see `Door.take`."""
        if self.ended:
            return len(data)
        if self._heard():
            self._line.clear()
        if baud not in (None, BAUD):
            return len(data)  # its drives hear noise
        for byte in data:
            if len(self._line) <= PACKET_CHARACTERS:  # one more than a frame is as wrong as a thousand more
                self._line.append(byte)
            if byte & ~PARITY_BIT == END[0]:
                self._take(bytes(self._line))
                self._line.clear()
        return len(data)

    @override
    def close(self) -> None:
        super().close()
        self._fresh.close()

    @override
    async def gone(self) -> None:
        self._latest = None
        entered = [unit for unit in self._units.values() if unit.leaves()]  # of the next program, soon
        await super().gone()
        for unit in entered:
            if not unit.is_in_mode:
                await leave(unit.drive.words)

    def _take(self, frame: bytes) -> None:
        """Take what may be a frame; drives are silent about what is none, and about those of other units."""
        command = decode_command(strip_parity(frame) if _has_parity(frame) else frame)
        if command is None or command.unit not in self._units or self._visit is None:
            return
        if self._latest and self._latest.frame == frame:
            return  # it is repeated because no reply has come yet; there will be one
        self.packets += 1
        self._latest = _Asked(frame, command, self._visit)
        self._came.set()

    async def _serve(self) -> None:
        """Answer frames, one after another; the reply to one that another has followed is not sent any more."""
        while True:
            await self._came.wait()
            self._came.clear()
            while asked := self._latest:
                reply = self._fresh_reply(asked.command)
                if reply is None:
                    async with self._share.turn():
                        reply = await self._answer(asked) if asked is self._latest and self._host.is_up() else None
                if asked is self._latest:
                    self._latest = None
                    if reply is not None:
                        self.receive(add_parity(reply) if _has_parity(asked.frame) else reply)

    def _fresh_reply(self, command: CommandPacket) -> bytes | None:
        """Return what the drive has just replied to the same frame; None where it may be another one now."""
        if command.function is Function.SETTING or not self._host.is_up():
            return None
        request = command.encode()
        return next((reply for frame, reply in self._fresh.of(command.unit) if frame == request), None)

    async def _answer(self, asked: _Asked) -> bytes | None:
        """Return the reply; None where the drive is silent."""
        unit, command = self._units[asked.command.unit], asked.command
        try:
            if command.function is Function.SETTING:
                try:
                    return await self._set(unit, asked)
                finally:
                    self._fresh.changed(command.unit)
                    if asked.visit is not self._visit and unit.leaves():  # it has gone meanwhile
                        await leave(unit.drive.words)
            return await self._read(unit, command)
        except (BusError, AxisUnreachable) as error:
            log.debug("not answered", guest=self._name, axis=unit.drive.spec.name, reason=error.message)
            return None

    async def _read(self, unit: GuestUnit, command: CommandPacket) -> bytes | None:
        name, what = unit.drive.spec.name, f"reading {command.address:04X}H"
        try:
            return await unit.drive.words.ask(_reading(command, unit.drive.profile))
        except ValueOutOfRange as error:  # what a drive does with an odd address or count is not known
            self._refuse(name, what, error.message)
            return _answered(command, ResponseStatus.BYTE_COUNT_ERROR)
        except BusError:
            raise
        except LdcndError as error:
            self._refuse(name, what, error.message)
            return None

    async def _set(self, unit: GuestUnit, asked: _Asked) -> bytes:
        """Carry out a setting; return what the drive says to it, or would say to one that it does not get."""
        axis, command, control = unit.drive.spec.name, asked.command, self._control
        what = f"setting {command.address:04X}H to {command.data:04X}H"
        if control is None:
            self._refuse(axis, what, f"the port {self._name} has access = read")
            return _answered(command, ResponseStatus.SETTING_ADDRESS_ERROR)
        try:
            wanted = unit.command_for(command.address, command.data)
            lease = await control.over((axis,), asked.visit)
            if wanted is None:
                return await self._send(unit, command, lease)
            await self._host.carry_out(axis, wanted.model_copy(update={"lease": lease}))
        except (BusError, AxisUnreachable):
            raise
        except LdcndError as error:
            self._refuse(axis, what, error.message)
            refused = isinstance(error, DataRefused)
            return _answered(
                command, ResponseStatus.SETTING_DATA_ERROR if refused else ResponseStatus.SETTING_ADDRESS_ERROR
            )
        except ValidationError as error:  # a frame holds values that no command has
            self._refuse(axis, what, explained(error).message)
            return _answered(command, ResponseStatus.SETTING_DATA_ERROR)
        return _answered(command, ResponseStatus.SETTING)

    async def _send(self, unit: GuestUnit, command: CommandPacket, lease: str) -> bytes:
        """Send a setting as it is, as long as the guest has control; return the drive's reply."""
        axis = unit.drive.spec.name
        with only_while(partial(self._host.require_control, axis, lease)), unit.sending(command.address):
            try:
                reply = await unit.drive.words.ask(_setting(command), once=True)
            except BusError:
                unit.may_have_taken(command.address, command.data)
                raise
        if decode_reply(reply).status.normal and (begun := unit.sends(command.address, command.data)):
            self._host.tell(axis, begun, self._name)
        return reply


def _has_parity(frame: bytes) -> bool:
    """Tell whether a program makes parity by itself: the first character of a frame has its bit set then."""
    return bool(frame[0] & PARITY_BIT)


def _answered(command: CommandPacket, status: ResponseStatus) -> bytes:
    return ReplyPacket(command.unit, status, command.address, command.data).encode()


def _setting(command: CommandPacket) -> Exchange[bytes | Refusal]:
    """Return the exchange of a setting that goes to the drive as it is, as is its reply.

    The guest itself repeats one whose reply is lost, or does not: the line sends it once, and so need not wait whether
    an older reply came.
    """
    exchange: Exchange[Any] = (
        set_operating_mode(command.unit, OperatingMode(command.data))
        if command.address == Register.OPERATING_MODE
        else execute(command.unit)
        if command.address == Register.OPERATION
        else write_trace_register(command.unit, TraceRegister(command.address), command.data)
    )
    return replace(exchange, decode=bytes, repeatable=True)


def _reading(command: CommandPacket, profile: SmartStepProfile) -> Exchange[bytes | Refusal]:
    """Return the exchange of a frame that reads; its reply, a refusal too, stays as it was sent.

    Raises:
        ValueOutOfRange: see `string_reference`.
    """
    exchange: Exchange[Any] = reference(command.unit, command.address)
    if command.function is Function.STRING_REFERENCE:
        count = int(command.data * _BYTES_OF_COUNT[profile.unit.trace.string_count_unit])
        exchange = string_reference(command.unit, command.address, count, profile)
    # data of a reference other than 0 are a data error, which the drive itself tells (manual 2.2, example 5)
    return replace(exchange, request=command.encode(), decode=bytes)
