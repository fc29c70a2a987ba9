import pytest

from ldcnd.drives.smartstep.addresses import OperatingMode, TraceRegister
from ldcnd.drives.smartstep.commands import (
    Refusal,
    RefusalReason,
    execute,
    is_self_hearing,
    read_operating_mode,
    reference,
    set_operating_mode,
    string_reference,
    write_eeprom,
    write_ram,
    write_trace_register,
)
from ldcnd.drives.smartstep.monitors import Counter, CounterReading
from ldcnd.drives.smartstep.packet import DAMAGED, ResponseStatus, decode_command, decode_reply
from ldcnd.drives.smartstep.parameters import PN000, PN100, PN202
from ldcnd.drives.smartstep.profiles import SMARTSTEP, ByteOrder, CountUnit, StringChecksum
from ldcnd.drives.smartstep.trace_data import split_words
from ldcnd.line.exchange import Exchange
from ldcnd.sim.smartstep.unit import CHARACTER_S, SimulatedUnit
from ldcnd.sim.smartstep.variant import SimulatedVariant

READ_PN100 = b"W0001000000FF\r"


def unit_with(variant: SimulatedVariant | None = None, number: int = 0) -> SimulatedUnit:
    return SimulatedUnit(variant, {PN000: number << 8, PN100: 40})


def ask(unit: SimulatedUnit, exchange: Exchange, at_s: float = 1.0):
    """Run an exchange to its end and decode the reply."""
    unit.receive(exchange.request, at_s)
    (sent,) = unit.transmissions(at_s + exchange.response_s)
    unit.transmissions(sent.end_s)
    return exchange.decode(sent.characters)


@pytest.mark.parametrize("response_s", [0.0, 0.01, 0.2])
def test_reply_begins_after_the_response_time_and_takes_ten_bits_a_character(response_s):
    unit = unit_with(SimulatedVariant(response_s=response_s))

    unit.receive(READ_PN100, 1.0)
    (sent,) = unit.transmissions(2.0)

    assert sent.start_s == pytest.approx(1.0 + response_s)
    assert sent.end_s - sent.start_s == pytest.approx(14 * 10 / 9600)


def test_reply_is_not_sent_before_its_time():
    unit = unit_with(SimulatedVariant(response_s=0.1))
    unit.receive(READ_PN100, 1.0)

    assert unit.transmissions(1.05) == []
    assert unit.next_start_s == pytest.approx(1.1)
    assert len(unit.transmissions(1.1)) == 1
    assert unit.transmissions(9.0) == []


def test_command_may_arrive_one_character_at_a_time():
    unit = unit_with()

    for place, code in enumerate(READ_PN100):
        unit.receive(bytes([code]), 1.0 + place * CHARACTER_S)

    assert unit.transmissions(2.0)[0].characters == b"W0001000028D7\r"


@pytest.mark.parametrize(
    "silent",
    [
        READ_PN100[:-2] + bytes([DAMAGED]) + b"\r",
        b"W00010000000FF\r",
        b"\x00" + READ_PN100,
        b"W0001000000ff\r",
        b"W000100G000FF\r",
        b"W0401000028D3\r",
        b"W1001000000EF\r",
        READ_PN100[:-1],
    ],
)
def test_unit_is_silent_where_the_manual_says_so(silent):
    unit = unit_with()

    unit.receive(silent, 1.0)

    assert unit.transmissions(2.0) == []


def test_foreign_bytes_without_cr_spoil_the_next_command_until_a_flush():
    unit = unit_with()
    unit.receive(b"\xaa\x01\x02", 1.0)
    unit.receive(READ_PN100, 1.1)
    assert unit.transmissions(2.0) == []

    unit.receive(b"\xaa\x01\x02" * 100, 3.0)
    unit.receive(b"\r", 3.1)
    unit.receive(READ_PN100, 3.2)

    assert len(unit.transmissions(4.0)) == 1


def test_command_during_a_reply_is_lost():
    unit = unit_with()
    unit.receive(READ_PN100, 1.0)
    unit.receive(READ_PN100, 1.02)

    assert len(unit.transmissions(2.0)) == 1


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        (b"W00C000000040\r", b"W08C000000038\r"),
        (b"W01C00003E854\r", b"W09C00003E84C\r"),
        (b"W0001000028D7\r", b"W0401000028D3\r"),
        (b"W0101000BB83B\r", b"W0501000BB837\r"),
    ],
)
def test_errors_are_answered_as_the_manual_shows(command, reply):
    unit = unit_with()

    unit.receive(command, 1.0)

    assert unit.transmissions(2.0)[0].characters == reply


def test_setting_while_tracing_is_refused_as_busy():
    unit = unit_with()
    ask(unit, set_operating_mode(0, OperatingMode.DATA_TRACE), 1.0)

    refusal = ask(unit, write_ram(0, PN100, 60), 2.0)

    assert isinstance(refusal, Refusal)
    assert refusal.reason_in(OperatingMode.DATA_TRACE) is RefusalReason.TRACING
    assert ask(unit, reference(0, PN100.ram_address), 3.0) == 40


def test_eeprom_and_ram_are_two_values():
    unit = unit_with()

    ask(unit, write_eeprom(0, PN100, 60), 1.0)

    assert ask(unit, reference(0, PN100.eeprom_address), 2.0) == 60
    assert ask(unit, reference(0, PN100.ram_address), 3.0) == 40
    assert unit.drive.memory.writes[PN100.number] == 1


def test_unit_without_power_is_silent_and_starts_afresh():
    unit = unit_with()
    ask(unit, write_eeprom(0, PN202, 8), 1.0)
    unit.receive(READ_PN100, 2.0)
    unit.power_off(2.001)
    assert unit.transmissions(2.5) == []
    unit.receive(READ_PN100, 2.6)
    assert unit.transmissions(2.9) == []

    unit.power_on(3.0)

    assert unit.drive.motor.gear == pytest.approx(8.0)
    assert ask(unit, reference(0, PN100.eeprom_address), 4.0) == 40


@pytest.mark.parametrize("variant", [StringChecksum.HEADER, StringChecksum.ALL, StringChecksum.TRAILER])
@pytest.mark.parametrize("order", ByteOrder)
@pytest.mark.parametrize("count_unit", CountUnit)
def test_trace_is_read_from_every_variant_of_drive(variant, order, count_unit):
    unit = unit_with(SimulatedVariant(string_checksum=variant, trace_byte_order=order, string_count_unit=count_unit))
    unit.drive.recorder.rings[1][100:104] = [0x0001, 0x8001, 0x7FFF, 0xFFFE]
    profile = SMARTSTEP.with_trace(string_count_unit=count_unit)

    reply = ask(unit, string_reference(0, 0x38C8, 8, profile))

    assert reply.fits == {variant}
    assert split_words(reply.data, order) == (0x0001, 0x8001, 0x7FFF, 0xFFFE)


def test_addresses_of_the_trace_hold_bytes():
    unit = unit_with()
    unit.drive.recorder.rings[0][:2] = [0x1234, 0x5678]

    both = ask(unit, string_reference(0, 0x3000, 4), 1.0)
    second = ask(unit, string_reference(0, 0x3002, 2), 2.0)

    assert both.data == bytes.fromhex("12345678")
    assert second.data == bytes.fromhex("5678")


@pytest.mark.parametrize(
    ("variant", "address", "byte_count", "status"),
    [
        (SimulatedVariant(), 0xC000, 2, ResponseStatus.STRING_ADDRESS_ERROR),
        (SimulatedVariant(), 0x33E8, 2, ResponseStatus.STRING_ADDRESS_ERROR),
        (SimulatedVariant(), 0x33E6, 4, ResponseStatus.STRING_ADDRESS_ERROR),
        (
            SimulatedVariant(overrun_status=ResponseStatus.BYTE_COUNT_ERROR),
            0x33E6,
            4,
            ResponseStatus.BYTE_COUNT_ERROR,
        ),
        (SimulatedVariant(longest_string_bytes=64), 0x3000, 66, ResponseStatus.BYTE_COUNT_ERROR),
        (SimulatedVariant(), 0x800C, 4, ResponseStatus.STRING_ADDRESS_ERROR),
    ],
)
def test_strings_are_refused_with_14_characters(variant, address, byte_count, status):
    refusal = ask(unit_with(variant), string_reference(0, address, byte_count))

    assert refusal == Refusal(0, status, address, byte_count)


def test_variant_reads_both_counter_halves_at_one_instant():
    unit = unit_with(SimulatedVariant(counter_strings=True))
    unit.drive.motor.command_units = 0x1234_5678

    reply = ask(unit, string_reference(0, 0x800C, 4))

    assert split_words(reply.data, ByteOrder.BIG) == (0x5678, 0x1234)


def test_counter_is_read_rightly_while_the_motor_turns():
    unit = unit_with()
    unit.drive.set_run(0.0, on=True)
    unit.drive.set_pulse_rate(100_000.0, 0.0)
    at_s = 0.0
    for _ in range(40):
        reading = CounterReading(Counter.FEEDBACK)
        unit.drive.advance(at_s)
        low = unit.drive.feedback_counter
        while reading.wanted:
            at_s += 0.05
            reading.take(ask(unit, reference(0, reading.wanted.address), at_s), at_s)
        high = unit.drive.feedback_counter

        assert reading.value is not None
        assert low <= reading.value.raw <= high


def test_trembling_at_rest_over_a_boundary_is_read_rightly():
    unit = unit_with()
    unit.drive.set_run(0.0, on=True)
    unit.drive.motor.position = 65536
    unit.drive.motor.tremble = -1
    at_s = 0.0
    for _ in range(60):
        reading = CounterReading(Counter.FEEDBACK)
        while reading.wanted:
            at_s += 0.0397
            reading.take(ask(unit, reference(0, reading.wanted.address), at_s), at_s)

        assert reading.value is not None
        assert reading.value.raw in (65535, 65536)


def test_self_hearing_drive_answers_its_own_non_zero_word_once():
    unit = unit_with(SimulatedVariant(hears_itself=True))

    unit.receive(READ_PN100, 1.0)
    sent = unit.transmissions(5.0)

    assert [item.characters[:3] for item in sent] == [b"W00", b"W04"]
    assert is_self_hearing(0, sent[1].characters)


def test_self_hearing_drive_repeats_a_setting_without_end():
    unit = unit_with(SimulatedVariant(hears_itself=True))

    unit.receive(write_eeprom(0, PN100, 60).request, 1.0)
    sent = unit.transmissions(11.0)

    assert len(sent) > 300
    assert unit.drive.memory.writes[PN100.number] > 300


def test_only_unit_0_keeps_its_transmitter_on():
    assert unit_with(number=0).always_transmits
    assert not unit_with(number=1).always_transmits


def test_whole_trace_runs_over_the_line():
    unit = unit_with()
    unit.drive.set_run(0.0, on=True)
    unit.drive.set_pulse_rate(100_000.0, 0.0)
    ask(unit, write_trace_register(0, TraceRegister.SMPTMS, 40), 0.5)
    ask(unit, set_operating_mode(0, OperatingMode.DATA_TRACE), 1.0)
    ask(unit, execute(0), 2.0)

    assert ask(unit, read_operating_mode(0), 6.0) is OperatingMode.DATA_TRACE
    assert ask(unit, read_operating_mode(0), 7.5) is OperatingMode.NORMAL
    words = split_words(ask(unit, string_reference(0, 0x3000, 1000), 8.0).data, ByteOrder.BIG)
    assert words == tuple(unit.drive.recorder.rings[0])
    assert any(words)


def test_normal_reply_of_a_setting_is_itself_a_command():
    command = write_ram(0, PN100, 60).request

    assert decode_reply(command).status is ResponseStatus.SETTING
    assert decode_command(command) is not None
