"""LDCN/NMC framing: manuals, "Serial Command Interface"."""

import pytest

from ldcnd.contract.errors import BadReply, ValueOutOfRange
from ldcnd.drives.ldcn.packet import CommandCode, Packet, PacketReader, ReceivedPacket, decode_packet, encode_packet

READ_POSITION = bytes.fromhex("aa 01 13 01 15")


def feed(reader, data):
    return [received for received in map(reader.feed, data) if received]


def test_the_checksum_leaves_the_header_out():
    packet = Packet(1, CommandCode.READ_STATUS, b"\x01")

    assert encode_packet(packet) == READ_POSITION
    assert decode_packet(READ_POSITION) == packet


def test_the_checksum_is_a_byte():
    assert encode_packet(Packet(0xFF, CommandCode.HARD_RESET)) == bytes.fromhex("aa ff 0f 0e")


@pytest.mark.parametrize(("address", "limit"), [(-1, 0), (256, 255)])
def test_an_address_that_is_no_byte_is_refused(address, limit):
    with pytest.raises(ValueOutOfRange) as refusal:
        encode_packet(Packet(address, CommandCode.NO_OPERATION))

    assert (refusal.value.value, refusal.value.limit) == (address, limit)


def test_the_count_nibble_limits_the_data():
    encode_packet(Packet(1, CommandCode.LOAD_TRAJECTORY, bytes(15)))

    with pytest.raises(ValueOutOfRange) as refusal:
        encode_packet(Packet(1, CommandCode.LOAD_TRAJECTORY, bytes(16)))

    assert (refusal.value.value, refusal.value.limit) == (16, 15)


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        ("", "header AA"),
        ("ab 01 00 01", "header AA, not with ab"),
        ("aa 01 00", "too few"),
        ("aa 01 13 01", "says 1 data bytes, the frame has 0"),
        ("aa 01 13 01 15 00", "says 1 data bytes, the frame has 2"),
        ("aa 01 21 07 ff 21", "checksum 21, computed 28"),
    ],
)
def test_a_damaged_frame_is_refused_with_the_reason(frame, reason):
    with pytest.raises(BadReply, match=reason):
        decode_packet(bytes.fromhex(frame))


def test_a_module_finds_packets_between_nulls_and_noise():
    stream = bytes(16) + READ_POSITION + b"\x55\x00" + bytes.fromhex("aa 01 00 01")

    received = feed(PacketReader(), stream)

    assert received == [
        ReceivedPacket(Packet(1, CommandCode.READ_STATUS, b"\x01"), checksum_ok=True),
        ReceivedPacket(Packet(1, CommandCode.RESET_POSITION), checksum_ok=True),
    ]


def test_a_module_hears_of_a_wrong_checksum_and_stays_in_step():
    stream = bytes.fromhex("aa 01 21 07 ff 21") + READ_POSITION

    received = feed(PacketReader(), stream)

    assert [packet.checksum_ok for packet in received] == [False, True]


def test_header_bytes_inside_a_packet_are_data():
    packet = Packet(0xAA, CommandCode.LOAD_TRAJECTORY, b"\xaa" * 5)

    received = feed(PacketReader(), encode_packet(packet))

    assert received == [ReceivedPacket(packet, checksum_ok=True)]


@pytest.mark.parametrize("sent", [b"\xaa", b"\xaa\x01", b"\xaa\x01\xf4", b"\xaa\x01\xf4\xff\xff"])
def test_sixteen_nulls_complete_any_half_received_packet(sent):
    reader = PacketReader()
    feed(reader, sent)

    feed(reader, bytes(16))

    assert not reader.in_packet
    assert feed(reader, READ_POSITION) == [ReceivedPacket(decode_packet(READ_POSITION), checksum_ok=True)]


def test_a_reader_can_be_told_to_forget():
    reader = PacketReader()
    feed(reader, READ_POSITION[:3])
    assert reader.in_packet

    reader.reset()

    assert len(feed(reader, READ_POSITION)) == 1


def test_every_nibble_is_a_command():
    assert [CommandCode(value) for value in range(16)] == list(CommandCode)
