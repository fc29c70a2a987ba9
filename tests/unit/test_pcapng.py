"""The blocks are taken apart here by the layout in the format's description, not by the encoder's own code."""

import struct

from ldcnd.line.flight_recorder import WireEvent, WireRecord
from ldcnd.ops.pcapng import encode_pcapng

ZERO_NS = 1_700_000_000_000_000_000
RECORDS = (
    WireRecord(1.5, WireEvent.SENT, b"\xaa\x01\x0e\x0f"),
    WireRecord(1.50025, WireEvent.RECEIVED, b"\x08\x08\x10"),
    WireRecord(2.0, WireEvent.TIMEOUT, b"", "node 3"),
)


def blocks(file: bytes) -> list[tuple[int, bytes]]:
    """Return the type and body of each block; its length stands at both ends."""
    found, at = [], 0
    while at < len(file):
        kind, total = struct.unpack_from("<II", file, at)
        assert total % 4 == 0
        assert struct.unpack_from("<I", file, at + total - 4) == (total,)
        found.append((kind, file[at + 8 : at + total - 4]))
        at += total
    assert at == len(file)
    return found


def options(data: bytes) -> dict[int, bytes]:
    found, at = {}, 0
    while True:
        code, length = struct.unpack_from("<HH", data, at)
        if code == 0:
            assert at + 4 == len(data)
            return found
        found[code] = data[at + 4 : at + 4 + length]
        at += 4 + (length + 3) // 4 * 4


def test_a_file_begins_with_a_section_and_an_interface_in_nanoseconds():
    (section, head), (interface, body), *_ = blocks(encode_pcapng(RECORDS, "x-y", ZERO_NS))

    assert (section, head) == (0x0A0D0D0A, bytes.fromhex("4d3c2b1a 0100 0000 ffffffffffffffff"))
    assert interface == 1
    assert struct.unpack_from("<HHI", body) == (147, 0, 0)
    assert options(body[8:]) == {2: b"x-y", 9: b"\x09"}


def test_each_record_is_a_packet_with_time_direction_and_remark():
    packets = [body for kind, body in blocks(encode_pcapng(RECORDS, "x-y", ZERO_NS)) if kind == 6]

    decoded = []
    for body in packets:
        _, high, low, captured, original = struct.unpack_from("<IIIII", body)
        assert captured == original
        padded = (captured + 3) // 4 * 4
        decoded.append(((high << 32 | low) - ZERO_NS, body[20 : 20 + captured], options(body[20 + padded :])))
    assert decoded == [
        (1_500_000_000, b"\xaa\x01\x0e\x0f", {1: b"sent", 2: b"\x02\x00\x00\x00"}),
        (1_500_250_000, b"\x08\x08\x10", {1: b"received", 2: b"\x01\x00\x00\x00"}),
        (2_000_000_000, b"", {1: b"timeout node 3"}),
    ]
