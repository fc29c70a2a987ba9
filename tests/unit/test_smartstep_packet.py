import pytest

from ldcnd.contract.errors import BadReply, ValueOutOfRange
from ldcnd.drives.smartstep.packet import (
    DAMAGED,
    CommandPacket,
    Function,
    ReplyPacket,
    ReplyReader,
    ResponseStatus,
    add_parity,
    decode_reply,
    piece_bytes,
    strip_parity,
)


@pytest.mark.parametrize("unit", [-1, 16])
def test_unit_numbers_end_at_15(unit):
    with pytest.raises(ValueOutOfRange):
        CommandPacket(unit, Function.REFERENCE, 0x8000)


@pytest.mark.parametrize(("address", "data"), [(0x10000, 0), (-1, 0), (0, 0x10000), (0, -1)])
def test_fields_fit_four_digits(address, data):
    with pytest.raises(ValueOutOfRange):
        CommandPacket(1, Function.SETTING, address, data)


def test_unit_15_is_written_as_f():
    assert CommandPacket(15, Function.REFERENCE, 0x8000).encode()[:3] == b"WF0"


@pytest.mark.parametrize(
    "damaged",
    [
        b"",
        b"W0001000028D7",
        b"W0001000028D7\n",
        b"X0001000028D7\r",
        b"W0001000028D8\r",
        b"W0001000028d7\r",
        b"W00010000 8D7\r",
        b"W0001000028D7\r\r",
    ],
)
def test_reply_that_breaks_a_rule_is_bad(damaged):
    with pytest.raises(BadReply):
        decode_reply(damaged)


@pytest.mark.parametrize("code", [0x3, 0x7, 0xB, 0xC, 0xF])
def test_status_outside_the_manuals_table_is_bad(code):
    packet = ReplyPacket(1, ResponseStatus.REFERENCE, 0x8000, 0).encode()
    ss = (int(packet[11:13], 16) - code) & 0xFF
    packet = b"W1%X80000000%02X\r" % (code, ss)

    with pytest.raises(BadReply, match="status"):
        decode_reply(packet)


@pytest.mark.parametrize(
    ("status", "function", "normal"),
    [
        (0x0, Function.REFERENCE, True),
        (0x1, Function.SETTING, True),
        (0x2, Function.STRING_REFERENCE, True),
        (0x4, Function.REFERENCE, False),
        (0x5, Function.SETTING, False),
        (0x6, Function.STRING_REFERENCE, False),
        (0x8, Function.REFERENCE, False),
        (0x9, Function.SETTING, False),
        (0xA, Function.STRING_REFERENCE, False),
    ],
)
def test_status_says_its_function_and_outcome(status, function, normal):
    assert ResponseStatus(status).function is function
    assert ResponseStatus(status).normal is normal


def test_alphabet_as_8n1_bytes():
    encoded = add_parity(b"W0123456789ABCDEF\r")

    assert encoded == bytes.fromhex("D7 30 B1 B2 33 B4 35 36 B7 B8 39 41 42 C3 44 C5 C6 8D")


@pytest.mark.parametrize("code", range(128))
def test_every_character_survives_and_every_single_bit_error_shows(code):
    encoded = add_parity(bytes([code]))

    damaged = b"".join(strip_parity(bytes([encoded[0] ^ 1 << bit])) for bit in range(8))

    assert strip_parity(encoded) == bytes([code])
    assert damaged == bytes([DAMAGED] * 8)


def test_packet_with_a_damaged_character_keeps_its_length():
    encoded = bytearray(add_parity(b"W0001000000FF\r"))
    encoded[5] ^= 0x80

    assert strip_parity(bytes(encoded)) == b"W0001\x7f00000FF\r"


REPLY = b"W0001000028D7\r"


def test_noise_before_a_reply_is_skipped():
    reader = ReplyReader(14)

    assert reader.feed(b"\x00\xff\r0" + REPLY) == [REPLY]
    assert reader.skipped == 4


def test_second_start_ends_what_was_no_packet():
    reader = ReplyReader(14)

    assert reader.feed(b"W00" + REPLY) == [REPLY]
    assert reader.skipped == 3


def test_reply_may_come_one_character_at_a_time():
    reader = ReplyReader(14)

    candidates = [candidate for code in REPLY for candidate in reader.feed(bytes([code]))]

    assert candidates == [REPLY]


def test_endless_packet_is_given_up():
    reader = ReplyReader(14)

    assert reader.feed(b"W" + b"0" * 30 + REPLY) == [REPLY]
    assert reader.skipped == 31


@pytest.mark.parametrize(
    ("data", "length"),
    [(b"", None), (b"W", None), (b"abc", 3), (b"abW", 2), (b"W\r", 2), (REPLY + b"W", 14), (b"W" * 2, 1)],
)
def test_piece_ends_where_its_bytes_say(data, length):
    assert piece_bytes(data, 14) == length
