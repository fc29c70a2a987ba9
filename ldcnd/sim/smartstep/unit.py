"""A simulated SmartStep on its line: receives characters, stays silent or replies, each at its time.

Time is an input: `receive` says when characters have arrived, `transmissions` what the unit has begun to send by then.
Source: manual 2.1 "Basic specifications" (the silent cases), 2.2.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ldcnd.drives.smartstep.addresses import TRACE_1_AREA, TRACE_2_AREA
from ldcnd.drives.smartstep.monitors import FEEDBACK_COUNTER_LOW, INPUT_COUNTER_LOW
from ldcnd.drives.smartstep.packet import (
    END,
    PACKET_CHARACTERS,
    CommandPacket,
    Function,
    ReplyPacket,
    ResponseStatus,
    checksum,
    decode_command,
)
from ldcnd.drives.smartstep.parameters import Parameter
from ldcnd.drives.smartstep.profiles import CountUnit, StringChecksum
from ldcnd.drives.smartstep.trace_data import join_words
from ldcnd.sim.smartstep.drive import SimulatedSmartStep
from ldcnd.sim.smartstep.variant import SimulatedVariant

CHARACTER_S = 10 / 9600
"""Start, seven data, parity, stop."""
_COUNTER_BYTES = 4


@dataclass(frozen=True, slots=True)
class Transmission:
    """Characters on the wire.

    Attributes:
        start_s: when the first start bit begins.
    """

    characters: bytes
    start_s: float

    @property
    def end_s(self) -> float:
        """When the last stop bit ends."""
        return self.start_s + len(self.characters) * CHARACTER_S


class SimulatedUnit:
    """One drive on a line.

    Attributes:
        drive: what is behind the packets.
    """

    def __init__(self, variant: SimulatedVariant | None = None, stored: Mapping[Parameter, int] | None = None) -> None:
        self.variant = variant or SimulatedVariant()
        self.drive = SimulatedSmartStep(self.variant, stored or {})
        self._powered = True
        self._line = bytearray()
        self._deaf_until_s = 0.0
        self._pending: Transmission | None = None
        self._sent: list[Transmission] = []
        self._events: deque[tuple[float, Callable[[float], None]]] = deque()

    @property
    def always_transmits(self) -> bool:
        """Whether the transmitter is never released: single-axis mode, unit number 0."""
        return self._powered and self.drive.unit == 0

    @property
    def next_start_s(self) -> float | None:
        """When the unit will next begin to send, as determined so far."""
        return self._pending.start_s if self._pending else None

    def receive(self, characters: bytes, at_s: float) -> None:
        """Receive characters without a gap, the last of which was complete at that time.

        `parity.DAMAGED` stands for a parity or framing error. Characters between a command and the end of its reply
        are lost: the drive does one thing at a time.
        """
        self._settle(at_s)
        if not self._powered:
            return
        for place, code in enumerate(characters):
            heard_s = at_s - (len(characters) - 1 - place) * CHARACTER_S
            if heard_s <= self._deaf_until_s or self._pending:
                continue
            if code != END[0]:
                # One more than a packet is as wrong as a thousand more.
                if len(self._line) < PACKET_CHARACTERS:
                    self._line.append(code)
                continue
            packet = bytes(self._line) + END
            self._line.clear()
            self._obey(packet, heard_s)

    def transmissions(self, to_s: float) -> list[Transmission]:
        """Return what the unit has begun to send by then and was not returned before."""
        self._settle(to_s)
        sent, self._sent = self._sent, []
        return sent

    def power_off(self, at_s: float) -> None:
        """Fall silent; an answer that has not begun is never sent."""
        self._settle(at_s)
        self._powered = False
        self._pending = None
        self._line.clear()

    def power_on(self, at_s: float) -> None:
        """Start afresh; EEPROM and alarm history are as they were."""
        self.drive.power_on(at_s)
        self._powered = True
        self._deaf_until_s = at_s

    def schedule(self, at_s: float, act: Callable[[float], None]) -> None:
        """Let something happen at an instant of the line's clock; calls come in order of time."""
        self._events.append((at_s, act))

    def _settle(self, to_s: float) -> None:
        while self._events and self._events[0][0] <= to_s:
            at_s, act = self._events.popleft()
            act(at_s)
        while self._pending and self._pending.start_s <= to_s:
            sending, self._pending = self._pending, None
            self._sent.append(sending)
            if self.variant.hears_itself:
                self._obey(sending.characters, sending.end_s)
            self._deaf_until_s = max(self._deaf_until_s, sending.end_s)
        if self._powered:
            self.drive.advance(to_s)

    def _obey(self, packet: bytes, at_s: float) -> None:
        command = decode_command(packet)
        if command is None or command.unit != self.drive.unit:
            return
        self.drive.advance(at_s)
        self._pending = Transmission(self._answer(command), at_s + self.variant.response_s)

    def _answer(self, command: CommandPacket) -> bytes:
        match command.function:
            case Function.REFERENCE:
                return self._reference(command).encode()
            case Function.SETTING:
                status = self.drive.write(command.address, command.data)
                return ReplyPacket(command.unit, status, command.address, command.data).encode()
            case Function.STRING_REFERENCE:
                return self._string(command)

    def _reference(self, command: CommandPacket) -> ReplyPacket:
        word = self.drive.read(command.address)
        if word is None:
            return ReplyPacket(command.unit, ResponseStatus.REFERENCE_ADDRESS_ERROR, command.address, command.data)
        if command.data:
            return ReplyPacket(command.unit, ResponseStatus.REFERENCE_DATA_ERROR, command.address, command.data)
        return ReplyPacket(command.unit, ResponseStatus.REFERENCE, command.address, word)

    def _string(self, command: CommandPacket) -> bytes:
        data = self._memory(command.address, self._byte_count(command.data))
        if isinstance(data, ResponseStatus):
            return ReplyPacket(command.unit, data, command.address, command.data).encode()
        return string_reply(command, data, self.variant.string_checksum)

    def _byte_count(self, count: int) -> int:
        match self.variant.string_count_unit:
            case CountUnit.BYTES:
                return count
            case CountUnit.WORDS:
                return count * 2
            case CountUnit.CHARS:
                return count // 2

    def _memory(self, address: int, byte_count: int) -> bytes | ResponseStatus:
        if not 1 <= byte_count <= self.variant.longest_string_bytes:
            return ResponseStatus.BYTE_COUNT_ERROR
        for area, ring in zip((TRACE_1_AREA, TRACE_2_AREA), self.drive.recorder.rings, strict=True):
            if address in area:
                at = address - area.start
                if at + byte_count > len(area):
                    return self.variant.overrun_status
                return join_words(ring, self.variant.trace_byte_order)[at : at + byte_count]
        counters = (INPUT_COUNTER_LOW.address, FEEDBACK_COUNTER_LOW.address)
        if self.variant.counter_strings and address in counters and byte_count == _COUNTER_BYTES:
            halves = (self.drive.read(address) or 0, self.drive.read(address + 1) or 0)
            return join_words(halves, self.variant.trace_byte_order)
        return ResponseStatus.STRING_ADDRESS_ERROR


def string_reply(command: CommandPacket, data: bytes, variant: StringChecksum) -> bytes:
    """Return the answer to a string reference in one of the ways that the manual allows."""
    body = data.hex().upper().encode("ascii")
    header = command.encode()[1:11]
    covered = header + body if variant is StringChecksum.ALL else header
    trailer = b"%02X" % checksum(body) if variant is StringChecksum.TRAILER else b""
    return b"W%b%02X%b%b\r" % (header, checksum(covered), body, trailer)
