"""Even parity in software: 7E1 characters as the 8N1 characters that look the same on the wire.

A 7E1 character is an 8N1 character whose top bit is the parity bit; both have ten bits. So a port that cannot do seven
bits can serve a SmartStep line, and damaged characters become visible one by one.
Source: manual 2.1 "Basic specifications".
"""

DAMAGED = 0x7F
"""Stands for a character with wrong parity: it keeps its place and can belong to no packet."""

_ENCODED = bytes((code & 0x7F) | ((code & 0x7F).bit_count() & 1) << 7 for code in range(256))
_DECODED = bytes(code & 0x7F if code.bit_count() % 2 == 0 else DAMAGED for code in range(256))


def add_parity(characters: bytes) -> bytes:
    """Return the 8N1 bytes of seven-bit characters."""
    return characters.translate(_ENCODED)


def strip_parity(data: bytes) -> bytes:
    """Return the seven-bit characters of 8N1 bytes, `DAMAGED` in the place of each with wrong parity."""
    return data.translate(_DECODED)
