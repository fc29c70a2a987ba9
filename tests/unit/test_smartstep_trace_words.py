import pytest

from ldcnd.drivers.smartstep.profiles import ByteOrder, TraceWordLayout
from ldcnd.drivers.smartstep.trace_words import (
    TracePoint,
    decode_word,
    encode_word,
    is_beyond_full_scale,
    join_words,
    split_words,
)
from ldcnd.errors import BadReply

MSB, SHIFT, MASK, RAW = TraceWordLayout


@pytest.mark.parametrize(
    ("layout", "word", "value", "io"),
    [
        (MSB, 0x0000, 0, False),
        (MSB, 0x8001, 1, True),
        (MSB, 0x7FFF, -1, False),
        (MSB, 0xFFFF, -1, True),
        (MSB, 0x3A98, 15000, False),
        (MSB, 0xBA98, 15000, True),
        (MSB, 0x4568, -15000, False),
        (MSB, 0xC568, -15000, True),
        (SHIFT, 0x0000, 0, False),
        (SHIFT, 0x8001, -16384, True),
        (SHIFT, 0x7FFF, 16383, True),
        (SHIFT, 0xFFFF, -1, True),
        (MASK, 0x0000, 0, False),
        (MASK, 0x8001, -32768, True),
        (MASK, 0x7FFF, 32766, True),
        (MASK, 0xFFFF, -2, True),
        (RAW, 0x8001, 0x8001, None),
    ],
)
def test_word_in_each_layout(layout, word, value, io):
    assert decode_word(word, layout) == TracePoint(value, io)
    assert encode_word(TracePoint(value, io), layout) == word


def test_byte_order_says_which_half_comes_first():
    assert split_words(b"\x80\x01\x7f\xff", ByteOrder.BIG) == (0x8001, 0x7FFF)
    assert split_words(b"\x80\x01\x7f\xff", ByteOrder.LITTLE) == (0x0180, 0xFF7F)
    assert join_words((0x8001,), ByteOrder.LITTLE) == b"\x01\x80"


def test_half_a_word_is_bad():
    with pytest.raises(BadReply):
        split_words(b"\x00\x01\x02", ByteOrder.BIG)


def test_value_beyond_full_scale_makes_the_layout_doubtful():
    assert not is_beyond_full_scale([TracePoint(15_000, None), TracePoint(-15_000, None)])
    assert is_beyond_full_scale([TracePoint(-15_001, None)])
