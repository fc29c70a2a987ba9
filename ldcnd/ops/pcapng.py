"""A wire log as a pcapng file, for Wireshark: one packet for each record, in the direction it went.

There is no registered link type for these lines, so packets carry the first of those that are free for private use.
Source: PCAP Next Generation file format (IETF draft-ietf-opsawg-pcapng), section header, interface description and
enhanced packet blocks; link types of tcpdump.org, LINKTYPE_USER0.
"""

import struct
from collections.abc import Iterable

from ldcnd.line.flight_recorder import WireEvent, WireRecord

LINKTYPE_USER0 = 147

_SECTION_HEADER, _INTERFACE, _ENHANCED_PACKET = 0x0A0D0D0A, 1, 6
_BYTE_ORDER_MAGIC = 0x1A2B3C4D
_UNKNOWN_LENGTH = -1
_END_OF_OPTIONS, _COMMENT, _IF_NAME, _PACKET_FLAGS, _IF_TIME_RESOLUTION = 0, 1, 2, 2, 9
_NANOSECONDS = bytes([9])
_INBOUND, _OUTBOUND = 1, 2
_DIRECTIONS = {
    WireEvent.SENT: _OUTBOUND,
    WireEvent.RECEIVED: _INBOUND,
    WireEvent.PART: _INBOUND,
    WireEvent.STRAY: _INBOUND,
}


def encode_pcapng(records: Iterable[WireRecord], bus: str, zero_ns: int) -> bytes:
    """Return a whole file; what is no packet, such as a time-out, becomes an empty one with a comment.

    Args:
        records: in the order in which they happened.
        bus: the name of the line.
        zero_ns: the wall time at which the records' clock was 0, UTC in ns since 1970.
    """
    header = _block(_SECTION_HEADER, struct.pack("<IHHq", _BYTE_ORDER_MAGIC, 1, 0, _UNKNOWN_LENGTH))
    options = _option(_IF_NAME, bus.encode()) + _option(_IF_TIME_RESOLUTION, _NANOSECONDS) + _option(_END_OF_OPTIONS)
    interface = _block(_INTERFACE, struct.pack("<HHI", LINKTYPE_USER0, 0, 0) + options)
    return header + interface + b"".join(_packet(record, zero_ns) for record in records)


def _packet(record: WireRecord, zero_ns: int) -> bytes:
    at_ns = zero_ns + round(record.at_s * 1e9)
    size = len(record.data)
    comment = f"{record.event} {record.note}".rstrip().encode()
    options = _option(_COMMENT, comment)
    if direction := _DIRECTIONS.get(record.event):
        options += _option(_PACKET_FLAGS, struct.pack("<I", direction))
    body = struct.pack("<IIIII", 0, at_ns >> 32, at_ns & 0xFFFFFFFF, size, size) + _padded(record.data)
    return _block(_ENHANCED_PACKET, body + options + _option(_END_OF_OPTIONS))


def _block(kind: int, body: bytes) -> bytes:
    total = len(body) + 12  # type, and the length at both ends
    return struct.pack("<II", kind, total) + body + struct.pack("<I", total)


def _option(code: int, value: bytes = b"") -> bytes:
    return struct.pack("<HH", code, len(value)) + _padded(value)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)
