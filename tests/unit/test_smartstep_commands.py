import pytest

from ldcnd.drivers.smartstep import commands
from ldcnd.drivers.smartstep.addresses import TraceRegister
from ldcnd.drivers.smartstep.commands import (
    execute,
    is_self_hearing,
    probe,
    read_monitor,
    read_operating_mode,
    reference,
    set_operating_mode,
    with_response_time,
    write_eeprom,
    write_ram,
    write_trace_register,
)
from ldcnd.drivers.smartstep.operating_modes import OperatingMode
from ldcnd.drivers.smartstep.packet import Command, Function, Reply, ResponseStatus
from ldcnd.drivers.smartstep.parameters import PN100, PN304, unlisted_parameter
from ldcnd.drivers.smartstep.profiles import SmartStepProfile
from ldcnd.drivers.smartstep.refusals import Refusal
from ldcnd.drivers.smartstep.status import SPEED_FEEDBACK
from ldcnd.errors import BadReply, ValueOutOfRange
from ldcnd.exchange import ReplyVerdict

GOOD = b"W0001000028D7\r"


def reply_of(unit: int, status: int, address: int, data: int) -> bytes:
    return Reply(unit, ResponseStatus(status), address, data).encode()


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
    assert write_ram(0, PN100, 60).repeatable
    assert write_trace_register(0, TraceRegister.SMPTMS, 8).repeatable
    assert probe(0).repeatable
    assert not write_eeprom(0, PN100, 60).repeatable
    assert not set_operating_mode(0, OperatingMode.NORMAL).repeatable
    assert not execute(0).repeatable


def test_eeprom_write_goes_to_the_parameters_own_address():
    assert write_eeprom(0, PN304, 1000).request == b"W01030403E80D\r"


def test_unlisted_parameter_can_be_written_on_purpose():
    assert write_ram(0, unlisted_parameter(0x003), 1).request[3:7] == b"1003"


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
    patient = with_response_time(reference(0, 0x0100), SmartStepProfile(first_character_s=1.5))

    assert patient.response_s == pytest.approx(1.5)
    assert patient.decode(GOOD) == 40


def test_poll_for_normal_mode_looks_like_its_reply():
    command = Command(1, Function.REFERENCE, 0x2000).encode()

    assert read_operating_mode(1).decode(command) is OperatingMode.NORMAL
