import pytest

from ldcnd.drivers.smartstep.packet import Command, Function, Reply, ResponseStatus, checksum
from ldcnd.drivers.smartstep.profiles import CountUnit, SmartStepProfile, StringChecksum
from ldcnd.drivers.smartstep.refusals import Refusal
from ldcnd.drivers.smartstep.simulated_unit import string_reply
from ldcnd.drivers.smartstep.strings import ChecksumPin, StringReply, string_reference
from ldcnd.errors import BadReply, ValueOutOfRange
from ldcnd.exchange import ReplyVerdict

DATA = bytes.fromhex("000080017FFFFFFF")
COMMAND = Command(1, Function.STRING_REFERENCE, 0x3000, 8)
VARIANTS = [StringChecksum.HEADER, StringChecksum.ALL, StringChecksum.TRAILER]


@pytest.mark.parametrize("sent", VARIANTS)
@pytest.mark.parametrize("expected", [StringChecksum.AUTO, *VARIANTS])
def test_variant_is_accepted_only_where_the_profile_allows_it(sent, expected):
    exchange = string_reference(1, 0x3000, 8, SmartStepProfile(string_checksum=expected))
    packet = string_reply(COMMAND, DATA, sent)

    if expected in (sent, StringChecksum.AUTO):
        assert exchange.check(packet) is ReplyVerdict.INTACT
        assert exchange.decode(packet) == StringReply(DATA, frozenset({sent}))
    else:
        with pytest.raises(BadReply):
            exchange.decode(packet)


def test_all_zero_data_fit_both_variants_without_trailer():
    packet = string_reply(COMMAND, bytes(8), StringChecksum.HEADER)

    reply = string_reference(1, 0x3000, 8).decode(packet)

    assert reply == StringReply(bytes(8), frozenset({StringChecksum.HEADER, StringChecksum.ALL}))


def test_damaged_data_under_a_checksum_are_corrupt():
    packet = bytearray(string_reply(COMMAND, DATA, StringChecksum.ALL))
    packet[20] = ord("5")
    exchange = string_reference(1, 0x3000, 8, SmartStepProfile(string_checksum=StringChecksum.ALL))

    assert exchange.check(bytes(packet)) is ReplyVerdict.CORRUPT


def test_good_trailer_does_not_excuse_a_bad_header():
    packet = bytearray(string_reply(COMMAND, DATA, StringChecksum.TRAILER))
    packet[12] ^= 1
    exchange = string_reference(1, 0x3000, 8, SmartStepProfile(string_checksum=StringChecksum.TRAILER))

    assert exchange.check(bytes(packet)) is ReplyVerdict.CORRUPT


def test_missing_characters_are_corrupt_even_if_the_header_fits():
    packet = string_reply(COMMAND, DATA, StringChecksum.HEADER)

    assert string_reference(1, 0x3000, 8).check(packet[:-3] + b"\r") is ReplyVerdict.CORRUPT


def test_reply_to_another_string_is_foreign():
    packet = string_reply(Command(1, Function.STRING_REFERENCE, 0x3008, 8), DATA, StringChecksum.HEADER)

    assert string_reference(1, 0x3000, 8).check(packet) is ReplyVerdict.FOREIGN


@pytest.mark.parametrize(
    ("digits", "unit"), [(8 * 4, "words"), (8, "chars")], ids=["words of memory", "characters of the reply"]
)
def test_other_count_unit_is_named(digits, unit):
    body = b"0" * digits
    header = COMMAND.encode()[1:11]
    packet = b"W%b%02X%b\r" % (header, checksum(header), body)
    exchange = string_reference(1, 0x3000, 8)

    assert exchange.check(packet) is ReplyVerdict.INTACT
    with pytest.raises(BadReply, match=f"count unit seems to be {unit}"):
        exchange.decode(packet)


@pytest.mark.parametrize(("unit", "count"), [(CountUnit.BYTES, 8), (CountUnit.WORDS, 4), (CountUnit.CHARS, 16)])
def test_count_is_given_in_the_unit_of_the_profile(unit, count):
    profile = SmartStepProfile(string_count_unit=unit)
    command = Command(1, Function.STRING_REFERENCE, 0x3000, count)

    exchange = string_reference(1, 0x3000, 8, profile)

    assert exchange.request == command.encode()
    assert exchange.decode(string_reply(command, DATA, StringChecksum.HEADER)).data == DATA


@pytest.mark.parametrize("status", [ResponseStatus.STRING_ADDRESS_ERROR, ResponseStatus.BYTE_COUNT_ERROR])
def test_refusal_has_14_characters_with_the_count_echoed(status):
    exchange = string_reference(1, 0x3000, 8)
    packet = Reply(1, status, 0x3000, 8).encode()

    assert exchange.total_bytes(packet) == 14
    assert exchange.decode(packet) == Refusal(1, status, 0x3000, 8)
    assert exchange.check(Reply(1, status, 0x3000, 6).encode()) is ReplyVerdict.FOREIGN


def test_reply_ends_at_its_cr():
    exchange = string_reference(1, 0x3000, 8)
    packet = string_reply(COMMAND, DATA, StringChecksum.TRAILER)

    assert exchange.total_bytes(packet[:-1]) is None
    assert exchange.total_bytes(packet) == len(packet) == 32
    assert exchange.reply_bytes == 32


@pytest.mark.parametrize(("address", "byte_count"), [(0x3000, 3), (0x3000, 0), (0x3000, 1002), (0x3001, 2)])
def test_odd_and_impossible_strings_are_refused_before_they_are_sent(address, byte_count):
    with pytest.raises(ValueOutOfRange):
        string_reference(1, address, byte_count)


def test_three_replies_without_choice_pin_the_variant():
    pin = ChecksumPin()
    clear = StringReply(DATA, frozenset({StringChecksum.ALL}))
    unclear = StringReply(bytes(8), frozenset({StringChecksum.HEADER, StringChecksum.ALL}))

    for reply in (clear, unclear, clear):
        pin.take(reply)
        assert pin.pinned is StringChecksum.AUTO
    pin.take(clear)

    assert pin.pinned is StringChecksum.ALL


def test_disagreeing_replies_start_the_count_again():
    pin = ChecksumPin()

    for variant in (StringChecksum.ALL, StringChecksum.ALL, StringChecksum.HEADER, StringChecksum.HEADER):
        pin.take(StringReply(DATA, frozenset({variant})))

    assert pin.pinned is StringChecksum.AUTO
