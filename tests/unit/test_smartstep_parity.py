import pytest

from ldcnd.drivers.smartstep.parity import DAMAGED, add_parity, strip_parity


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
