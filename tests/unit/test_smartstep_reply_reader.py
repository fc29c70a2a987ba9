import pytest

from ldcnd.drivers.smartstep.reply_reader import ReplyReader, piece_bytes

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
