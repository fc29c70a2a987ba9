"""Parameters over a real bus: RAM by default, EEPROM rarely, counted, and never twice blindly."""

import asyncio
import random
from contextlib import suppress

import pytest

from ldcnd.contract.errors import (
    AddressRefused,
    BusyTracing,
    DataRefused,
    DriveFault,
    EepromBudgetSpent,
    NotSupported,
    OutcomeUnknown,
    ReplyTimeout,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.parameters import Memory, WriteParameter
from ldcnd.drives.smartstep.addresses import OperatingMode
from ldcnd.drives.smartstep.commands import set_operating_mode
from ldcnd.drives.smartstep.parameters import PN000, PN100, PN102, PN202, PN304, PN402
from ldcnd.drives.smartstep.profiles import SMARTSTEP, EepromWrite
from ldcnd.line.flight_recorder import WireEvent, WireRecord
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.smartstep_line import LosingUnit, simulated, smartstep_line


def to_ram(parameter: str, value: int) -> WriteParameter:
    return WriteParameter(parameter=parameter, value=value)


def to_eeprom(parameter: str, value: int, confirm_unit: int | None = None) -> WriteParameter:
    return WriteParameter(parameter=parameter, value=value, memory=Memory.EEPROM, confirm_unit=confirm_unit)


async def test_a_parameter_is_found_by_number_and_by_name():
    async with smartstep_line([simulated(1, stored={PN100: 77})]) as line:
        access = line.axis("u1").parameters

        assert (await access.read("pn100")).active == 77
        assert (await access.read("speed loop GAIN")).stored == 77


async def test_an_unlisted_parameter_needs_the_explicit_word():
    async with smartstep_line([simulated(1)]) as line:
        access = line.axis("u1").parameters

        with pytest.raises(ValueOutOfRange):
            await access.read("Pn7FF")
        with pytest.raises(AddressRefused):
            await access.read("Pn7FF", unlisted=True)


async def test_a_write_goes_to_ram_unless_eeprom_is_named(tmp_path):
    drive = simulated(1)
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json") as line:
        done = await line.axis("u1").parameters.write(to_ram("Pn100", 120))

    assert (done.value.active, done.value.stored, done.written) == (120, 80, True)
    assert drive.drive.memory.writes[PN100.number] == 0


async def test_an_eeprom_write_of_the_same_value_costs_nothing(tmp_path):
    drive = simulated(1)
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json") as line:
        access = line.axis("u1").parameters

        first = await access.write(to_eeprom("Pn100", 120))
        again = await access.write(to_eeprom("Pn100", 120))

    assert (first.written, again.written) == (True, False)
    assert drive.drive.memory.writes[PN100.number] == 1
    assert again.value.eeprom_writes == 1


@pytest.mark.parametrize(("changes_ram", "active"), [(False, 80), (True, 120)])
async def test_both_memories_are_read_after_an_eeprom_write(tmp_path, changes_ram, active):
    drive = simulated(1, SimulatedVariant(eeprom_changes_ram=changes_ram))
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json") as line:
        done = await line.axis("u1").parameters.write(to_eeprom("Pn100", 120))

    assert (done.value.active, done.value.stored) == (active, 120)
    assert bool(done.remarks) is not changes_ram


async def test_eeprom_is_not_written_without_a_ledger_nor_where_it_is_denied(tmp_path):
    drive = simulated(1)
    async with smartstep_line([drive]) as line:
        with pytest.raises(NotSupported, match="ledger"):
            await line.axis("u1").parameters.write(to_eeprom("Pn100", 120))
    denying = SMARTSTEP.with_unit(eeprom_write=EepromWrite.DENY)
    async with smartstep_line([simulated(1)], profile=denying, ledger=tmp_path / "ledger.json") as line:
        with pytest.raises(NotSupported, match="forbids"):
            await line.axis("u1").parameters.write(to_eeprom("Pn100", 120))

    assert drive.drive.memory.writes[PN100.number] == 0


async def test_the_budget_ends_eeprom_writes_and_not_ram_writes(tmp_path):
    drive = simulated(1)
    scarce = SMARTSTEP.with_unit(eeprom_budget=2)
    async with smartstep_line([drive], profile=scarce, ledger=tmp_path / "ledger.json") as line:
        access = line.axis("u1").parameters
        await access.write(to_eeprom("Pn100", 101))
        await access.write(to_eeprom("Pn100", 102))

        with pytest.raises(EepromBudgetSpent) as refusal:
            await access.write(to_eeprom("Pn100", 103))
        await access.write(to_ram("Pn100", 104))

    assert refusal.value.limit == 2
    assert drive.drive.memory.writes[PN100.number] == 2


async def test_a_value_that_the_drive_declines_is_a_data_error_and_is_not_counted(tmp_path):
    drive = simulated(1)
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json") as line:
        access = line.axis("u1").parameters

        with pytest.raises(DataRefused):
            await access.write(to_ram("Pn100", 3000))
        with pytest.raises(DataRefused):
            await access.write(to_eeprom("Pn100", 3000))

        assert (await access.read("Pn100")).eeprom_writes == 0


async def test_a_drive_in_data_trace_mode_is_busy_tracing():
    async with smartstep_line([simulated(1)]) as line:
        await line.bus.execute(set_operating_mode(1, OperatingMode.DATA_TRACE))

        with pytest.raises(BusyTracing, match="busy tracing"):
            await line.axis("u1").parameters.write(to_ram("Pn100", 120))


async def test_a_new_unit_number_must_be_confirmed(tmp_path):
    drive = simulated(1)
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json") as line:
        access = line.axis("u1").parameters

        with pytest.raises(WrongState, match="unit 2"):
            await access.write(to_eeprom("Pn000", 0x0200))
        with pytest.raises(WrongState, match="RAM"):
            await access.write(to_ram("Pn000", 0x0200))
        await access.write(to_eeprom("Pn000", 0x0200, confirm_unit=2))
        await access.write(to_ram("Pn000", 0x0101))

    assert drive.drive.memory.writes[PN000.number] == 1


@pytest.mark.parametrize("spelling", ["000", "Pn0", "pn000", "0", "Basic switch 1"])
async def test_no_spelling_of_pn000_goes_round_the_confirmation_of_a_new_unit_number(tmp_path, spelling):
    drive = simulated(1)
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json") as line:
        request = WriteParameter(parameter=spelling, value=0x0300, memory=Memory.EEPROM, unlisted=True)

        with pytest.raises(WrongState, match="unit 3"):
            await line.axis("u1").parameters.write(request)

    assert drive.drive.memory.stored(PN000) == 0x0100


@pytest.mark.parametrize(("unit", "word"), [(2, "u2"), (0, "alone"), (5, "answers")])
async def test_a_unit_number_that_collides_is_refused_although_confirmed(tmp_path, unit, word):
    drives = [simulated(1), simulated(2), simulated(5)]
    async with smartstep_line(drives, numbers=[1, 2], ledger=tmp_path / "ledger.json") as line:
        with pytest.raises(WrongState, match=word):
            await line.axis("u1").parameters.write(to_eeprom("Pn000", unit << 8, confirm_unit=unit))

    assert drives[0].drive.memory.stored(PN000) == 0x0100


@pytest.mark.parametrize("writes", ["this host", "another host"])
async def test_a_unit_number_that_another_drive_gets_at_its_power_on_is_taken(tmp_path, writes):
    first, second = simulated(1), simulated(2)
    async with smartstep_line([first, second], ledger=tmp_path / "ledger.json") as line:
        one, other = line.axis("u1").parameters, line.axis("u2").parameters
        await line.network.bring_up()
        if writes == "another host":
            first.drive.memory.write(PN000.eeprom_address, 0x0300)
        else:
            await one.write(to_eeprom("Pn000", 0x0300, confirm_unit=3))

        for number in (3, 1):  # it has its own number until then
            with pytest.raises(WrongState, match="that of axis u1"):
                await other.write(to_eeprom("Pn000", number << 8, confirm_unit=number))
        assert second.drive.memory.stored(PN000) == 0x0200

        await one.write(to_eeprom("Pn000", 0x0100, confirm_unit=1))
        await other.write(to_eeprom("Pn000", 0x0300, confirm_unit=3))

    assert second.drive.memory.stored(PN000) == 0x0300


async def test_no_unit_number_is_given_while_it_cannot_be_read_which_one_another_drive_gets(tmp_path):
    first, unplugged = simulated(1), True
    second = LosingUnit(2, lambda _, _packet: "request" if unplugged else None)
    second.drive.memory.write(PN000.eeprom_address, 0x0300)
    async with smartstep_line([first, second], ledger=tmp_path / "ledger.json") as line:
        access = line.axis("u1").parameters
        await line.network.bring_up()
        with pytest.raises(WrongState, match="which unit number axis u2 gets"):
            await access.write(to_eeprom("Pn000", 0x0300, confirm_unit=3))
        unplugged = False
        with pytest.raises(WrongState, match="that of axis u2"):
            await access.write(to_eeprom("Pn000", 0x0300, confirm_unit=3))
        assert first.drive.memory.stored(PN000) == 0x0100
        await access.write(to_eeprom("Pn000", 0x0400, confirm_unit=4))

    assert first.drive.memory.stored(PN000) == 0x0400


async def test_of_two_drives_that_ask_for_one_unit_number_at_once_one_gets_it(tmp_path):
    drives = [simulated(1), simulated(2)]
    async with smartstep_line(drives, ledger=tmp_path / "ledger.json") as line:
        writes = (line.axis(name).parameters.write(to_eeprom("Pn000", 0x0300, confirm_unit=3)) for name in ("u1", "u2"))
        done = await asyncio.gather(*writes, return_exceptions=True)

    assert sorted(isinstance(each, WrongState) for each in done) == [False, True]
    assert sorted(each.drive.memory.stored(PN000) == 0x0300 for each in drives) == [False, True]


async def test_the_budget_is_that_of_the_eeprom_as_a_whole(tmp_path):
    scarce = SMARTSTEP.with_unit(eeprom_budget=2)
    async with smartstep_line([simulated(1)], profile=scarce, ledger=tmp_path / "ledger.json") as line:
        access = line.axis("u1").parameters
        await access.write(to_eeprom("Pn100", 90))
        await access.write(to_eeprom("Pn102", 50))

        with pytest.raises(EepromBudgetSpent, match="2 times"):
            await access.write(to_eeprom("Pn304", 600))


async def test_a_ram_write_of_a_power_cycle_parameter_is_remarked_upon():
    async with smartstep_line([simulated(1)]) as line:
        done = await line.axis("u1").parameters.write(to_ram("Pn202", 8))

    assert "EEPROM" in done.remarks[0]


async def test_nothing_is_asked_of_a_drive_that_hears_itself():
    drive = simulated(1)
    async with smartstep_line([drive]) as line:
        line.axis("u1").words.self_hearing = True

        with pytest.raises(WrongState, match="replies"):
            await line.axis("u1").parameters.write(to_ram("Pn100", 120))

    assert drive.drive.memory.active(PN100) == 80


async def test_a_lost_reply_to_an_eeprom_write_is_settled_by_reading_back(tmp_path):
    drive = simulated(1)
    # the third reply is that of the write: both memories are read before
    faults = FaultPlan((LineFault(FaultKind.REPLY_LOST, from_s=0.10, until_s=0.13),))
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json", faults=faults) as line:
        done = await line.axis("u1").parameters.write(to_eeprom("Pn100", 120))
        timeouts = line.bus.statistics.timeouts

    assert timeouts == 1
    assert (done.value.stored, done.value.eeprom_writes) == (120, 1)
    assert drive.drive.memory.writes[PN100.number] == 1


async def test_a_lost_eeprom_write_is_sent_again_only_after_the_old_value_was_read(tmp_path):
    drive = simulated(1)
    faults = FaultPlan((LineFault(FaultKind.REQUEST_LOST, from_s=0.08, until_s=0.12),))
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json", faults=faults) as line:
        done = await line.axis("u1").parameters.write(to_eeprom("Pn100", 120))
        sent = [record.data for record in line.bus.wire_log.records() if record.data[:7] in (b"W110100", b"W100100")]

    writes = [place for place, data in enumerate(sent) if data.startswith(b"W11")]
    assert any(data.startswith(b"W10") for data in sent[writes[0] + 1 : writes[1]])
    assert (done.value.stored, done.value.eeprom_writes) == (120, 1)
    assert drive.drive.memory.writes[PN100.number] == 1


async def test_a_write_that_cannot_be_read_back_stays_counted(tmp_path):
    drive = simulated(1)
    faults = FaultPlan((LineFault(FaultKind.REPLY_LOST, from_s=0.10),))
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json", faults=faults) as line:
        with pytest.raises(OutcomeUnknown, match="read back"):
            await line.axis("u1").parameters.write(to_eeprom("Pn100", 120))

    assert drive.drive.memory.writes[PN100.number] == 1
    assert '"Pn100": 1' in (tmp_path / "ledger.json").read_text()


def five_percent(seed: int) -> FaultPlan:
    kinds = (
        FaultKind.REQUEST_LOST,
        FaultKind.REQUEST_BYTE_LOST,
        FaultKind.REQUEST_BIT_FLIPPED,
        FaultKind.REPLY_LOST,
        FaultKind.REPLY_BYTE_LOST,
        FaultKind.REPLY_BIT_FLIPPED,
        FaultKind.REPLY_DUPLICATED,
    )
    delayed = LineFault(FaultKind.REPLY_DELAYED, 0.05, longest_s=0.25)
    return FaultPlan((*(LineFault(kind, 0.05) for kind in kinds), delayed), seed=seed)


@pytest.mark.parametrize("times", [200, pytest.param(2000, marks=pytest.mark.soak)])
@pytest.mark.long
async def test_writes_and_reads_on_a_bad_line_keep_ledger_and_values_true(tmp_path, times):
    dice = random.Random(182)
    drive = simulated(1)
    memory = drive.drive.memory
    parameters = {each.label: each for each in (PN100, PN102, PN202, PN304, PN402)}
    wrong, failed = [], 0
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json", faults=five_percent(9)) as line:
        access = line.axis("u1").parameters
        for _ in range(times):
            label = dice.choice(list(parameters))
            parameter = parameters[label]
            value = dice.randrange(1, 700)
            choice = dice.random()
            try:
                if choice < 0.4:
                    told = await access.read(label)
                else:
                    write = to_eeprom if choice < 0.7 else to_ram
                    told = (await access.write(write(label, value))).value
            except (ReplyTimeout, OutcomeUnknown):
                failed += 1
                continue
            if (told.active, told.stored) != (memory.active(parameter), memory.stored(parameter)):
                wrong.append((label, told))
        ledger = {label: (await read_surely(access, label)).eeprom_writes for label in parameters}
        statistics = line.bus.statistics
        log = line.bus.wire_log.records()

    assert wrong == []
    assert unread_repetitions(log) == []
    assert ledger == {label: memory.writes[parameter.number] for label, parameter in parameters.items()}
    assert sum(memory.writes.values()) > 0.25 * times
    assert statistics.timeouts > 0.2 * times
    assert failed < 0.1 * times


def unread_repetitions(log: list[WireRecord]) -> list[WireRecord]:
    """Return the EEPROM writes that were sent with no answered reading of the same word since the write before."""
    fresh: dict[bytes, bool] = {}
    bad = []
    for record in log:
        function, address = record.data[2:3], record.data[3:7]
        if not address.startswith(b"0"):
            continue
        if record.event is WireEvent.RECEIVED and function == b"0":
            fresh[address] = True
        elif record.event is WireEvent.SENT and function == b"1":
            if not fresh.get(address, True):
                bad.append(record)
            fresh[address] = False
    assert len(fresh) >= 5
    return bad


async def read_surely(access, label):
    for _ in range(20):
        with suppress(ReplyTimeout):
            return await access.read(label)
    raise AssertionError("the line lets nothing through")


async def test_an_eeprom_that_lags_behind_ram_is_written(tmp_path):
    drive = simulated(1)
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json") as line:
        access = line.axis("u1").parameters
        await access.write(to_ram("Pn100", 120))
        done = await access.write(to_eeprom("Pn100", 120))

    assert (done.written, done.value.stored) == (True, 120)
    assert drive.drive.memory.writes[PN100.number] == 1


async def test_a_write_that_left_a_third_value_is_counted_and_not_sent_again(tmp_path):
    drive = simulated(1)
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json") as line:
        access = line.axis("u1").parameters
        asked, ask = [], access._words.ask

        async def worn_out(exchange):
            reply = await ask(exchange)
            if not exchange.request.startswith(b"W11"):
                return reply
            asked.append(exchange)
            drive.drive.memory._eeprom[PN100.number] = 99
            raise OutcomeUnknown("no reply")

        access._words.ask = worn_out
        with pytest.raises(DriveFault, match="reads 99"):
            await access.write(to_eeprom("Pn100", 120))

    assert len(asked) == 1
    assert '"Pn100": 1' in (tmp_path / "ledger.json").read_text()
