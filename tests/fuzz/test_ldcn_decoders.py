"""LDCN/NMC decoders take any bytes: they return a value or raise `BadReply`, nothing else."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldcnd.contract.errors import BadReply
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.faults import Knowledge, diagnose
from ldcnd.drives.ldcn.packet import (
    HEADER,
    CommandCode,
    Packet,
    PacketReader,
    StatusItem,
    StatusPacket,
    check_status,
    decode_packet,
    decode_status,
    status_bytes,
)
from ldcnd.drives.ldcn.profiles import PROFILES, Support
from ldcnd.drives.ldcn.received import interpret, interpret_bytes
from ldcnd.line.exchange import ReplyVerdict
from tests.support.ldcn_decoding import decode_command

unsure = st.sampled_from([True, False, None])
profiles = st.sampled_from(list(PROFILES.values()))
masks = st.integers(0, 255).map(StatusItem)


@st.composite
def nearly_frames(draw):
    """Bytes that begin like a packet, often with a count and a checksum that fit."""
    body = draw(st.binary(min_size=2, max_size=20))
    if draw(st.booleans()):
        body = bytes((body[0], (len(body) - 2 & 0x0F) << 4 | body[1] & 0x0F)) + body[2:17]
    checksum = sum(body) & 0xFF if draw(st.booleans()) else draw(st.integers(0, 255))
    return bytes((HEADER,)) + body + bytes((checksum,))


streams = st.binary(max_size=24) | nearly_frames()


@given(profiles, streams)
@pytest.mark.long
def test_any_bytes_are_a_command_or_a_bad_reply(profile, data):
    for decode in (decode_command, interpret_bytes):
        with suppress(BadReply):
            assert 0 <= decode(profile, data).address <= 255
    with suppress(BadReply):
        assert decode_packet(data).data == data[3:-1]


@given(profiles, st.builds(Packet, st.integers(0, 255), st.sampled_from(CommandCode), st.binary(max_size=15)))
def test_any_packet_has_an_interpretation(profile, packet):
    interpretation = interpret(profile, packet)

    assert (interpretation.checksum_ok, interpretation.address) == (True, packet.address)
    assert "" not in interpretation.oddities


@given(profiles, masks, st.binary(max_size=20))
def test_any_bytes_are_a_status_or_a_bad_reply(profile, items, data):
    with suppress(BadReply):
        status = decode_status(profile, items, data)
        assert len(data) == status_bytes(profile, items)
        assert diagnose(profile, status, Knowledge(pic_ae=True, absolute=True)) is not None


@given(profiles, masks, st.binary(min_size=1, max_size=18), unsure, unsure)
def test_what_the_check_lets_pass_can_be_decoded(profile, items, body, pic_ae, absolute_mode):
    body = body.ljust(status_bytes(profile, items) - 1, b"\0")[: status_bytes(profile, items) - 1]
    data = body + bytes((sum(body) & 0xFF,))

    assert check_status(data) in {ReplyVerdict.INTACT, ReplyVerdict.REJECTED}
    status = decode_status(profile, items, data)
    for fault in diagnose(profile, status, Knowledge(pic_ae=pic_ae, absolute=absolute_mode)):
        assert fault.remedy


@given(st.binary(max_size=24))
def test_an_exchange_decodes_or_refuses(data):
    profile = next(profile for profile in PROFILES.values() if profile.support is Support.FULL)
    exchange = commands.read_status(Node(1, profile), StatusItem(0xFF))

    with suppress(BadReply):
        assert isinstance(exchange.decode(data), StatusPacket)


@given(st.binary(max_size=200))
def test_the_reader_takes_any_bytes_and_is_free_again_after_sixteen_nulls(data):
    reader = PacketReader()
    for byte in data:
        reader.feed(byte)

    for byte in bytes(16):
        reader.feed(byte)

    assert not reader.in_packet
