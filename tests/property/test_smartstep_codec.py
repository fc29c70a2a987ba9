"""Round trips and chunking of the SmartStep codec."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from ldcnd.drives.smartstep.commands import reference, string_reference
from ldcnd.drives.smartstep.packet import (
    CommandPacket,
    Function,
    ReplyPacket,
    ReplyReader,
    ResponseStatus,
    add_parity,
    decode_command,
    decode_reply,
    strip_parity,
)
from ldcnd.drives.smartstep.profiles import ByteOrder, StringChecksum, TraceWordLayout
from ldcnd.drives.smartstep.trace_data import (
    TracePoint,
    decode_word,
    encode_word,
    first_point,
    join_words,
    split_words,
    unwrap,
)
from ldcnd.line.exchange import Exchange, ReplyVerdict
from ldcnd.sim.smartstep.unit import string_reply

units = st.integers(0, 15)
words = st.integers(0, 0xFFFF)
commands = st.builds(CommandPacket, units, st.sampled_from(Function), words, words)
replies = st.builds(ReplyPacket, units, st.sampled_from(ResponseStatus), words, words)
packets = replies.map(ReplyPacket.encode)
noise = st.binary(max_size=20) | st.text("W0123456789ABCDEF\r", max_size=40).map(str.encode)
streams = st.lists(packets | noise, max_size=8).map(b"".join)


def cut(data: bytes, places: list[int]) -> list[bytes]:
    edges = sorted({0, len(data), *(place % (len(data) + 1) for place in places)})
    return [data[start:end] for start, end in pairwise(edges)]


def found(exchange: Exchange, chunks: list[bytes]) -> list[bytes]:
    """Read a stream as a bus does: cut by total_bytes, skip what is foreign, keep the rest."""
    assert exchange.total_bytes is not None
    buffer, answers = b"", []
    for chunk in chunks:
        buffer += chunk
        while (total := exchange.total_bytes(buffer)) is not None and total <= len(buffer):
            piece, buffer = buffer[:total], buffer[total:]
            if exchange.check(piece) is not ReplyVerdict.FOREIGN:
                answers.append(piece)
    return answers


@given(commands)
def test_command_survives_the_wire(command):
    assert decode_command(command.encode()) == command


@given(replies)
def test_reply_survives_the_wire(reply):
    assert decode_reply(reply.encode()) == reply


@given(packets, st.integers(1, 12), st.sampled_from(b"0123456789ABCDEF"))
def test_one_changed_digit_is_always_noticed(packet, place, digit):
    damaged = packet[:place] + bytes([digit]) + packet[place + 1 :]

    assert decode_command(damaged) is None or damaged == packet


@given(streams, st.lists(st.integers(0, 10_000), max_size=10), st.integers(14, 60))
def test_any_chunking_gives_the_same_candidates(stream, places, longest):
    whole, pieces = ReplyReader(longest), ReplyReader(longest)

    at_once = whole.feed(stream)
    bit_by_bit = [candidate for chunk in cut(stream, places) for candidate in pieces.feed(chunk)]

    assert at_once == bit_by_bit
    assert whole.skipped == pieces.skipped


@given(streams, streams, st.lists(st.integers(0, 10_000), max_size=10))
def test_answer_is_found_behind_anything_in_any_chunking(before, after, places):
    exchange = reference(3, 0x8000)
    answer = ReplyPacket(3, ResponseStatus.REFERENCE, 0x8000, 1234).encode()
    stream = before + answer + after

    answers = found(exchange, cut(stream, places))

    assert answer in answers
    assert answers == found(exchange, [stream])


@given(
    st.binary(min_size=1, max_size=60).map(lambda data: data + data),
    st.sampled_from([StringChecksum.HEADER, StringChecksum.ALL, StringChecksum.TRAILER]),
    noise.filter(lambda data: b"W" not in data),
    st.lists(st.integers(0, 10_000), max_size=10),
)
def test_string_is_found_behind_noise_in_any_chunking(data, variant, before, places):
    exchange = string_reference(1, 0x3000, len(data))
    packet = string_reply(CommandPacket(1, Function.STRING_REFERENCE, 0x3000, len(data)), data, variant)

    answers = found(exchange, cut(before + packet, places))

    assert answers == [packet]
    reply = exchange.decode(packet)
    assert reply.data == data
    assert variant in reply.fits


@given(st.binary(max_size=50))
def test_soft_parity_brings_back_seven_bits(data):
    characters = bytes(code & 0x7F for code in data)

    assert strip_parity(add_parity(characters)) == characters


@given(words, st.sampled_from(TraceWordLayout))
def test_trace_word_survives_its_layout(word, layout):
    assert encode_word(decode_word(word, layout), layout) == word


@given(st.integers(-0x4000, 0x3FFF), st.booleans())
def test_trace_point_of_15_bits_survives_the_layouts_that_have_them(value, io):
    point = TracePoint(value, io)

    for layout in (TraceWordLayout.MSB_IO, TraceWordLayout.LSB_IO_SHIFT):
        assert decode_word(encode_word(point, layout), layout) == point


@given(st.lists(words), st.sampled_from(ByteOrder))
def test_words_survive_their_byte_order(values, order):
    assert split_words(join_words(values, order), order) == tuple(values)


@given(st.integers(0, 499), st.integers(0, 499))
def test_trigger_is_always_found_behind_the_pre_trigger_points(trigger_address, pre_trigger):
    points = unwrap(range(500), first_point(trigger_address, pre_trigger))

    assert points[pre_trigger] == trigger_address
    assert sorted(points) == list(range(500))
