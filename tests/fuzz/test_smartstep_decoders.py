"""Any bytes become a value or `BadReply`, and nothing else."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldcnd.contract.errors import BadReply
from ldcnd.drives.smartstep.commands import (
    execute,
    is_self_hearing,
    probe,
    read_monitor,
    read_operating_mode,
    reference,
    string_reference,
    write_eeprom,
)
from ldcnd.drives.smartstep.monitors import SPEED_FEEDBACK
from ldcnd.drives.smartstep.packet import (
    CommandPacket,
    ReplyPacket,
    checksum,
    decode_command,
    decode_reply,
    piece_bytes,
)
from ldcnd.drives.smartstep.parameters import PN100
from ldcnd.drives.smartstep.profiles import SMARTSTEP, ByteOrder, StringChecksum
from ldcnd.drives.smartstep.trace_data import split_words
from ldcnd.line.exchange import Exchange, ReplyVerdict
from ldcnd.sim.smartstep.unit import SimulatedUnit

EXCHANGES: list[Exchange] = [
    reference(0, 0x0100),
    read_monitor(0, SPEED_FEEDBACK),
    read_operating_mode(0),
    write_eeprom(0, PN100, 40),
    execute(0),
    probe(0),
    *(string_reference(0, 0x3000, 4, SMARTSTEP.with_trace(string_checksum=variant)) for variant in StringChecksum),
]
digits = st.text("0123456789ABCDEF", max_size=30).map(str.encode)


@st.composite
def almost_packets(draw):
    """Right start, digits and checksum; address and unit often those of the exchanges."""
    start = draw(st.sampled_from([b"00", b"01", b"02", b"04", b"08", b"0A", b"09", b"05", b"06", b"0F", b"13"]))
    address = draw(st.sampled_from([b"0100", b"3000", b"8000", b"2000", b"2001", b"C000"]))
    data = draw(st.sampled_from([b"0000", b"0004", b"0028", b"0001"]))
    body = draw(st.sampled_from([b"", b"00", b"12345678", b"1234567800", b"12345678EC"]) | digits)
    header = start + address + data
    covered = header + body if draw(st.booleans()) and len(body) % 2 == 0 else header
    return b"W%b%02X%b\r" % (header, checksum(covered), body)


any_bytes = st.binary(max_size=60) | almost_packets() | almost_packets().map(lambda packet: packet[:-2] + b"\r")


@pytest.mark.parametrize("exchange", EXCHANGES, ids=lambda exchange: exchange.request.decode("ascii").strip())
@pytest.mark.sweep(2)
def test_exchanges_take_any_bytes(exchange):
    @given(any_bytes)
    def take(data: bytes) -> None:
        verdict = exchange.check(data)
        total = exchange.total_bytes(data)

        assert total is None or total >= 1
        if verdict is ReplyVerdict.FOREIGN:
            with pytest.raises(BadReply):
                exchange.decode(data)
        else:
            with contextlib.suppress(BadReply):
                exchange.decode(data)

    take()


@given(any_bytes)
def test_decoders_give_a_value_or_a_bad_reply(data):
    command = decode_command(data)
    assert command is None or isinstance(command, CommandPacket)
    with contextlib.suppress(BadReply):
        assert isinstance(decode_reply(data), ReplyPacket)
    with contextlib.suppress(BadReply):
        assert len(split_words(data, ByteOrder.BIG)) * 2 == len(data)
    assert is_self_hearing(0, data) in (True, False)


@given(st.binary(max_size=100), st.integers(1, 50))
def test_a_piece_is_never_empty_nor_longer_than_allowed(data, longest):
    total = piece_bytes(data, longest)

    if total is None:
        assert not data or data[:1] == b"W"
    else:
        assert 1 <= total <= len(data)
        assert data[:1] != b"W" or total <= longest


@given(st.lists(any_bytes, max_size=6))
def test_simulated_unit_survives_any_bytes(pieces):
    unit = SimulatedUnit()
    for number, piece in enumerate(pieces):
        unit.receive(piece, 1.0 + number)

    for sent in unit.transmissions(20.0):
        assert sent.characters[:2] == b"W0"
        assert sent.characters[-1:] == b"\r"
