"""A host's characters on a SmartStep line cut into packets, and records of the line in words."""

from ldcnd.drivers.smartstep.packet import END, START, decode_command, decode_reply
from ldcnd.drivers.transcript import Parts
from ldcnd.errors import BadReply
from ldcnd.wirelog.recorder import WireEvent, WireRecord

CHARACTER = 0x7F
"""The eighth bit is the parity, where the host makes it."""


class CommandCutter:
    """Cuts what a host sends: W begins a packet, CR ends it."""

    def begins(self, byte: int) -> bool:
        """Tell whether this byte would begin a packet."""
        return byte & CHARACTER == START[0]

    def feed(self, byte: int) -> bool:
        """Take a byte; tell whether it completes a packet."""
        return byte & CHARACTER == END[0]


class SmartStepTranscript:
    """Reads the records of one SmartStep line, oldest first."""

    def __init__(self) -> None:
        self._parts = Parts()

    def describe(self, record: WireRecord) -> str:
        """Return the record's packet in words; empty when there is none."""
        data = self._parts.whole(record)
        if record.event is WireEvent.SENT:
            command = decode_command(data)
            if command is None:
                return ""
            return f"unit {command.unit}: {command.function.name} {command.address:04X}H, {command.data:04X}H"
        if record.event is not WireEvent.RECEIVED:
            return ""
        try:
            reply = decode_reply(data)
        except BadReply as error:
            return error.message
        return f"unit {reply.unit}: {reply.status.name} {reply.address:04X}H, {reply.data:04X}H"
