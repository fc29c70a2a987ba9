import pytest

from ldcnd.contract.errors import BadReply, ValueOutOfRange
from ldcnd.drives.smartstep import commands
from ldcnd.drives.smartstep.addresses import OperatingMode, TraceRegister
from ldcnd.drives.smartstep.commands import (
    ChecksumPin,
    Refusal,
    RefusalReason,
    StringReply,
    execute,
    is_self_hearing,
    probe,
    read_monitor,
    read_operating_mode,
    reference,
    set_operating_mode,
    string_reference,
    with_response_time,
    write_eeprom,
    write_ram,
    write_trace_register,
)
from ldcnd.drives.smartstep.monitors import SPEED_FEEDBACK
from ldcnd.drives.smartstep.packet import CommandPacket, Function, ReplyPacket, ResponseStatus, checksum
from ldcnd.drives.smartstep.parameters import PN100, PN304, parameter_at
from ldcnd.drives.smartstep.profiles import SMARTSTEP, CountUnit, StringChecksum
from ldcnd.line.exchange import ReplyVerdict
from ldcnd.sim.smartstep.unit import string_reply


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        (0x8, RefusalReason.ADDRESS),
        (0x4, RefusalReason.DATA),
        (0x9, RefusalReason.ADDRESS),
        (0x5, RefusalReason.DATA),
        (0xA, RefusalReason.ADDRESS),
        (0x6, RefusalReason.BYTE_COUNT),
    ],
)
def test_reason_by_the_manuals_table(status, reason):
    assert Refusal(0, ResponseStatus(status), 0x0100, 0).reason is reason


def test_address_error_of_a_setting_means_busy_while_tracing():
    refusal = Refusal(0, ResponseStatus.SETTING_ADDRESS_ERROR, 0x1100, 60)

    assert refusal.reason_in(OperatingMode.DATA_TRACE) is RefusalReason.TRACING
    assert refusal.reason_in(OperatingMode.NORMAL) is RefusalReason.ADDRESS


@pytest.mark.parametrize("address", [0x2000, 0x2001])
def test_mode_and_operation_may_be_set_while_tracing_so_their_errors_are_real(address):
    refusal = Refusal(0, ResponseStatus.SETTING_ADDRESS_ERROR, address, 0)

    assert refusal.reason_in(OperatingMode.DATA_TRACE) is RefusalReason.ADDRESS


def test_message_says_unit_address_value_and_reason():
    refusal = Refusal(3, ResponseStatus.SETTING_DATA_ERROR, 0x0100, 3000)

    assert str(refusal) == "unit 3: setting to 0BB8H 0100H: data error (e=5)"


GOOD = b"W0001000028D7\r"


def reply_of(unit: int, status: int, address: int, data: int) -> bytes:
    return ReplyPacket(unit, ResponseStatus(status), address, data).encode()


def test_reference_gives_the_word():
    exchange = reference(0, 0x0100)

    assert exchange.request == b"W0001000000FF\r"
    assert exchange.check(GOOD) is ReplyVerdict.INTACT
    assert exchange.decode(GOOD) == 40


def test_exchange_tells_the_bus_all_it_needs():
    exchange = reference(7, 0x8000)

    assert exchange.node == 7
    assert exchange.reply_bytes == 14
    assert exchange.response_s == pytest.approx(0.3)
    assert exchange.total_bytes is not None
    assert exchange.total_bytes(b"\x00\x00W70") == 2
    assert exchange.total_bytes(b"W70") is None


@pytest.mark.parametrize(
    "foreign",
    [
        b"",
        b"\x00\x7f\x7f",
        reply_of(1, 0x0, 0x0100, 40),
        reply_of(0, 0x0, 0x0101, 40),
        reply_of(0, 0x1, 0x0100, 40),
        reply_of(0, 0x9, 0x0100, 40),
        b"W0001000028D8\r",
        b"W0001000028d7\r",
        b"W00010000D7\r",
        b"W0301000028D4\r",
    ],
)
def test_what_does_not_answer_the_command_is_foreign_and_not_decoded(foreign):
    exchange = reference(0, 0x0100)

    assert exchange.check(foreign) is ReplyVerdict.FOREIGN
    with pytest.raises(BadReply):
        exchange.decode(foreign)


@pytest.mark.parametrize(("status", "address"), [(0x8, 0xC000), (0x4, 0xC000)])
def test_error_reply_becomes_a_refusal(status, address):
    exchange = reference(0, address)

    refusal = exchange.decode(reply_of(0, status, address, 0))

    assert refusal == Refusal(0, ResponseStatus(status), address, 0)


def test_setting_must_be_echoed_with_its_data():
    exchange = write_ram(0, PN100, 60)

    assert exchange.request == b"W011100003CB2\r"
    assert exchange.decode(b"W011100003CB2\r") == 60
    assert exchange.check(reply_of(0, 0x1, 0x1100, 61)) is ReplyVerdict.FOREIGN
    assert exchange.check(reply_of(0, 0x5, 0x1100, 61)) is ReplyVerdict.FOREIGN
    assert exchange.check(reply_of(0, 0x5, 0x1100, 60)) is ReplyVerdict.INTACT


def test_only_what_is_harmless_to_repeat_is_repeatable():
    assert reference(0, 0x0100).repeatable
    assert read_monitor(0, SPEED_FEEDBACK).repeatable
    assert read_operating_mode(0).repeatable
    assert write_ram(0, PN100, 60).repeatable
    assert write_trace_register(0, TraceRegister.SMPTMS, 8).repeatable
    assert probe(0).repeatable
    assert not write_eeprom(0, PN100, 60).repeatable
    assert not set_operating_mode(0, OperatingMode.NORMAL).repeatable
    assert not execute(0).repeatable


def test_eeprom_write_goes_to_the_parameters_own_address():
    assert write_eeprom(0, PN304, 1000).request == b"W01030403E80D\r"


def test_parameter_at_can_be_written_on_purpose():
    assert write_ram(0, parameter_at(0x003), 1).request[3:7] == b"1003"


def test_operating_mode_is_a_closed_list():
    assert {mode.value for mode in OperatingMode} == {0x0000, 0x2000, 0x2003, 0x2004}
    assert set_operating_mode(1, OperatingMode.DATA_TRACE).request == b"W1120002000AF\r"
    with pytest.raises(ValueError, match="8194"):
        set_operating_mode(1, 0x2002)


def test_no_public_function_sets_a_raw_address():
    public = {name for name in vars(commands) if name.startswith(("set", "write"))}

    assert public == {"set_operating_mode", "write_eeprom", "write_ram", "write_trace_register"}
    assert not {0x2000, 0x2001} & {register.value for register in TraceRegister}


def test_execute_and_poll_frames():
    assert execute(1).request == b"W1120010001CD\r"
    assert read_operating_mode(1).request == b"W1020000000D0\r"
    assert read_operating_mode(1).decode(b"W1020002000B0\r") is OperatingMode.DATA_TRACE
    assert read_operating_mode(1).decode(reply_of(1, 0, 0x2000, 0x2002)) == 0x2002


def test_monitor_has_its_sign():
    assert read_monitor(0, SPEED_FEEDBACK).decode(b"W008000FFF68B\r") == -10


def test_values_must_fit_16_bits():
    with pytest.raises(ValueOutOfRange):
        write_ram(0, PN100, 0x10000)


def test_probe_accepts_the_known_answer_only():
    exchange = probe(0)

    exchange.decode(b"W08C000000038\r")

    assert exchange.request == b"W00C000000040\r"
    with pytest.raises(BadReply):
        exchange.decode(reply_of(0, 0x4, 0xC000, 0))


def test_unsolicited_data_error_shows_a_drive_that_hears_itself():
    assert is_self_hearing(1, reply_of(1, 0x4, 0x1100, 60))
    assert not is_self_hearing(2, reply_of(1, 0x4, 0x1100, 60))
    assert not is_self_hearing(1, reply_of(1, 0x0, 0x1100, 60))
    assert not is_self_hearing(1, b"\x00")


def test_profile_may_grant_another_response_time():
    patient = with_response_time(reference(0, 0x0100), SMARTSTEP.with_unit(first_character_s=1.5))

    assert patient.response_s == pytest.approx(1.5)
    assert patient.decode(GOOD) == 40


def test_poll_for_normal_mode_looks_like_its_reply():
    command = CommandPacket(1, Function.REFERENCE, 0x2000).encode()

    assert read_operating_mode(1).decode(command) is OperatingMode.NORMAL


DATA = bytes.fromhex("000080017FFFFFFF")
COMMAND = CommandPacket(1, Function.STRING_REFERENCE, 0x3000, 8)
VARIANTS = [StringChecksum.HEADER, StringChecksum.ALL, StringChecksum.TRAILER]


@pytest.mark.parametrize("sent", VARIANTS)
@pytest.mark.parametrize("expected", [StringChecksum.AUTO, *VARIANTS])
def test_variant_is_accepted_only_where_the_profile_allows_it(sent, expected):
    exchange = string_reference(1, 0x3000, 8, SMARTSTEP.with_trace(string_checksum=expected))
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
    exchange = string_reference(1, 0x3000, 8, SMARTSTEP.with_trace(string_checksum=StringChecksum.ALL))

    assert exchange.check(bytes(packet)) is ReplyVerdict.CORRUPT


def test_good_trailer_does_not_excuse_a_bad_header():
    packet = bytearray(string_reply(COMMAND, DATA, StringChecksum.TRAILER))
    packet[12] ^= 1
    exchange = string_reference(1, 0x3000, 8, SMARTSTEP.with_trace(string_checksum=StringChecksum.TRAILER))

    assert exchange.check(bytes(packet)) is ReplyVerdict.CORRUPT


def test_missing_characters_are_corrupt_even_if_the_header_fits():
    packet = string_reply(COMMAND, DATA, StringChecksum.HEADER)

    assert string_reference(1, 0x3000, 8).check(packet[:-3] + b"\r") is ReplyVerdict.CORRUPT


def test_reply_to_another_string_is_foreign():
    packet = string_reply(CommandPacket(1, Function.STRING_REFERENCE, 0x3008, 8), DATA, StringChecksum.HEADER)

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
    profile = SMARTSTEP.with_trace(string_count_unit=unit)
    command = CommandPacket(1, Function.STRING_REFERENCE, 0x3000, count)

    exchange = string_reference(1, 0x3000, 8, profile)

    assert exchange.request == command.encode()
    assert exchange.decode(string_reply(command, DATA, StringChecksum.HEADER)).data == DATA


@pytest.mark.parametrize("status", [ResponseStatus.STRING_ADDRESS_ERROR, ResponseStatus.BYTE_COUNT_ERROR])
def test_refusal_has_14_characters_with_the_count_echoed(status):
    exchange = string_reference(1, 0x3000, 8)
    packet = ReplyPacket(1, status, 0x3000, 8).encode()

    assert exchange.total_bytes(packet) == 14
    assert exchange.decode(packet) == Refusal(1, status, 0x3000, 8)
    assert exchange.check(ReplyPacket(1, status, 0x3000, 6).encode()) is ReplyVerdict.FOREIGN


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
