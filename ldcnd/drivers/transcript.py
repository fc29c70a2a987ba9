"""A wire log in words: what each packet asked, and what its reply said.

For people; nothing decides by it. Packets are read in the order in which they were on the line, because the layout of
an LDCN status packet follows from the requests before it.
"""

from collections.abc import Callable, Mapping
from dataclasses import fields

from ldcnd.bus.wire_log import WireEvent, WireRecord
from ldcnd.drivers.ldcn.profiles import LS_182AP, Profile
from ldcnd.drivers.ldcn.received import DefineStatus, HardReset, PlainCommand, ReadStatus, interpret_bytes
from ldcnd.drivers.ldcn.status import STATUS_BYTE_ONLY, Status, StatusFlag, StatusItem, decode_status
from ldcnd.drivers.smartstep.packet import decode_command, decode_reply
from ldcnd.errors import BadReply

Describe = Callable[[WireRecord], str]


class LdcnTranscript:
    """Reads the records of one LDCN line, oldest first.

    Args:
        profiles: the dialects by node address; nodes that are not in it are read as LS-182AP.
    """

    def __init__(self, profiles: Mapping[int, Profile]) -> None:
        self._profiles = profiles
        self._defined: dict[int, StatusItem] = {}
        self._asked: tuple[Profile, StatusItem] = (LS_182AP, STATUS_BYTE_ONLY)

    def describe(self, record: WireRecord) -> str:
        """Return the record's packet in words; empty when there is none."""
        if not record.data:
            return ""
        try:
            if record.event is WireEvent.SENT:
                return self._request(record.data)
            if record.event is WireEvent.RECEIVED:
                return self._reply(record.data)
        except BadReply as error:
            return error.message
        return ""

    def _request(self, data: bytes) -> str:
        address = interpret_bytes(LS_182AP, data).address
        profile = self._profiles.get(address, LS_182AP)
        meaning = interpret_bytes(profile, data)
        command = meaning.command
        items = self._defined.get(address, STATUS_BYTE_ONLY)
        match command:
            case DefineStatus():
                items = self._defined[address] = command.items
            case ReadStatus():
                items = command.items
            case HardReset():
                self._defined.clear()
        self._asked = (profile, items)
        words = command.command.name if isinstance(command, PlainCommand) else str(command)
        return "; ".join((f"node {address}: {words}", *meaning.oddities))

    def _reply(self, data: bytes) -> str:
        profile, items = self._asked
        return _status_words(decode_status(profile, items, data))


def describe_smartstep(record: WireRecord) -> str:
    """Return the packet of a record of a SmartStep line in words; empty when there is none."""
    if record.event is WireEvent.SENT:
        command = decode_command(record.data)
        if command is None:
            return ""
        return f"unit {command.unit}: {command.function.name} {command.address:04X}H, {command.data:04X}H"
    if record.event is not WireEvent.RECEIVED:
        return ""
    try:
        reply = decode_reply(record.data)
    except BadReply as error:
        return error.message
    return f"unit {reply.unit}: {reply.status.name} {reply.address:04X}H, {reply.data:04X}H"


def _status_words(status: Status) -> str:
    values = ((field.name, getattr(status, field.name)) for field in fields(status) if field.name != "flags")
    flags = f"status {int(status.flags):02X} {_flag_names(status.flags)}".rstrip()
    return ", ".join((flags, *(f"{name} {value}" for name, value in values if value is not None)))


def _flag_names(flags: StatusFlag) -> str:
    return "+".join(flag.name or "" for flag in StatusFlag if flag in flags)
