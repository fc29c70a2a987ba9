"""The records of an LDCN line in words: what an LDCN status packet holds follows from the requests before it."""

from collections.abc import Mapping
from dataclasses import fields

from ldcnd.contract.errors import BadReply
from ldcnd.drives.ldcn.packet import (
    FRAME_BYTES,
    HEADER,
    MOST_DATA_BYTES,
    STATUS_BYTE_ONLY,
    StatusFlag,
    StatusItem,
    StatusPacket,
    decode_status,
    status_bytes,
)
from ldcnd.drives.ldcn.pic_io import IoItem, IoStatus, decode_io_status
from ldcnd.drives.ldcn.profiles import LS_182AP, DeviceKind, Profile, identify
from ldcnd.drives.ldcn.received import DefineStatus, HardReset, PlainCommand, ReadStatus, interpret_bytes
from ldcnd.line.flight_recorder import Parts, WireEvent, WireRecord


class LdcnTranscript:
    """Reads the records of one LDCN line, oldest first.

    A node that tells its identity is read by its dialect from then on. Until then requests are read as those to an
    LS-182AP, and so are replies as far as their length allows.

    Args:
        profiles: the dialects by node address, as far as they are known.
    """

    def __init__(self, profiles: Mapping[int, Profile]) -> None:
        self._profiles = profiles
        self._learned: dict[int, Profile] = {}
        self._defined: dict[int, StatusItem] = {}
        self._asked: tuple[int, Profile, StatusItem] = (0, LS_182AP, STATUS_BYTE_ONLY)
        self._parts = Parts()
        self._buffered = bytearray(
            MOST_DATA_BYTES
        )  # data bytes of earlier packets, which modules fill short ones up with

    def describe(self, record: WireRecord) -> str:
        """Return the record's packet in words; empty when there is none."""
        data = self._parts.whole(record)
        if not data:
            return ""
        try:
            if record.event is WireEvent.SENT:
                return self._request(data)
            if record.event is WireEvent.RECEIVED:
                return self._reply(data)
        except BadReply as error:
            return error.message
        return ""

    def _request(self, data: bytes) -> str:
        # any dialect will do: all have the address in the same place
        address = interpret_bytes(LS_182AP, data).address
        profile = self._learned.get(address) or self._profiles.get(address, LS_182AP)
        meaning = interpret_bytes(profile, data, bytes(self._buffered))
        start = data.index(HEADER) + FRAME_BYTES - 1
        own = data[start : start + (data[start - 1] >> 4)]
        self._buffered[: len(own)] = own
        command = meaning.command
        items = self._defined.get(address, STATUS_BYTE_ONLY)
        match command:
            case DefineStatus():
                items = self._defined[address] = command.items
            case ReadStatus():
                items = command.items
            case HardReset():
                # of all of them: the record does not show whom it has reached
                self._defined.clear()
                self._learned.clear()
        self._asked = (address, profile, items)
        words = command.command.name if isinstance(command, PlainCommand) else str(command)
        return "; ".join((f"node {address}: {words}", *meaning.oddities))

    def _reply(self, data: bytes) -> str:
        address, profile, items = self._asked
        if profile.kind is DeviceKind.IO:
            return _io_words(decode_io_status(IoItem(items), data))
        known = address in self._learned or address in self._profiles
        if not known and len(data) != status_bytes(profile, items):
            return f"{len(data)} bytes of node {address}, of which nothing says what it is"
        status = decode_status(profile, items, data)
        if status.device_id is not None and status.version is not None:
            told = identify(status.device_id, status.version)
            if told:
                self._learned[address] = told
        return _status_words(status)


def _io_words(status: IoStatus) -> str:
    words = ["status CHECKSUM_ERROR" if status.rejected else "status"]
    for field in fields(status):
        value = getattr(status, field.name)
        if field.name != "rejected" and value is not None:
            words.append(f"{field.name} {value:03X}" if "levels" in field.name else f"{field.name} {value}")
    return ", ".join(words)


def _status_words(status: StatusPacket) -> str:
    values = ((field.name, getattr(status, field.name)) for field in fields(status) if field.name != "flags")
    flags = f"status {int(status.flags):02X} {_flag_names(status.flags)}".rstrip()
    return ", ".join((flags, *(f"{name} {value}" for name, value in values if value is not None)))


def _flag_names(flags: StatusFlag) -> str:
    return "+".join(flag.name or "" for flag in StatusFlag if flag in flags)
