"""The flight recorder as a client sees it."""

import asyncio

import pytest

from ldcnd.client.events import fetch_wire_log
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.contract.rig_commands import ReadWireLog
from ldcnd.daemon.rig_commands import LONGEST_DATA_BYTES
from ldcnd.drives.line_config import RecorderConfig
from ldcnd.line.flight_recorder import WireEvent, parse_records
from tests.support.rig import SIMULATED, running_rig


async def test_the_last_second_of_a_line_is_fetched_as_it_was_recorded():
    async with running_rig() as rig:
        await asyncio.sleep(5.0)
        bus = rig.daemon.rig.buses[0].bus
        now_s = asyncio.get_running_loop().time()

        fetched = await fetch_wire_log(rig.client, bus.settings.name, seconds=1.0)

        records = parse_records(fetched.lines)
        recorded = [record for record in bus.wire_log.records() if now_s - 1.0 <= record.at_s <= now_s]
        assert len(records) > 100
        assert [(record.event, record.data) for record in records] == [(each.event, each.data) for each in recorded]
        assert [record.at_s for record in records] == pytest.approx([each.at_s for each in recorded], abs=1e-6)
        assert {WireEvent.SENT, WireEvent.RECEIVED} <= {record.event for record in records}
        assert len(fetched.lines) == fetched.next_record - fetched.first_record


@pytest.mark.long
async def test_a_long_log_comes_in_pages_without_gap_or_repetition():
    async with running_rig() as rig:
        await asyncio.sleep(60.0)
        bus = rig.daemon.rig.buses[0].bus
        name = bus.settings.name

        page = await rig.client.ask(ReadWireLog(bus=name, seconds=3600))
        fetched = await fetch_wire_log(rig.client, name, seconds=3600)

        assert page.next_record - page.first_record == len(page.lines) > 100
        assert page.end_record == page.first_record + len(bus.wire_log.records())
        assert len(fetched.lines) > 3 * len(page.lines)
        assert fetched.lines == tuple(map(str, bus.wire_log.records()))[: len(fetched.lines)]


@pytest.mark.long
async def test_a_page_that_was_overwritten_starts_at_the_oldest_record_left():
    rigs = load_config(SIMULATED)
    (bus,) = rigs.bus
    short = rigs.model_copy(update={"bus": (bus.model_copy(update={"recorder": RecorderConfig(seconds=10.0)}),)})
    async with running_rig(short) as rig:
        await asyncio.sleep(15.0)
        name = rig.daemon.rig.buses[0].bus.settings.name

        page = await rig.client.ask(ReadWireLog(bus=name, from_record=0))

        log = rig.daemon.rig.buses[0].bus.wire_log
        assert page.first_record >= log.added - len(log.records()) > 0
        assert page.lines[0] == str(log.records()[0])


async def test_of_a_long_burst_the_beginning_is_shown_and_the_rest_counted():
    async with running_rig() as rig:
        bus = rig.daemon.rig.buses[0].bus
        bus.wire_log.add(asyncio.get_running_loop().time(), WireEvent.STRAY, bytes(60_000), "noise")

        fetched = await fetch_wire_log(rig.client, bus.settings.name, seconds=1.0)

        (burst,) = [record for record in parse_records(fetched.lines) if record.event is WireEvent.STRAY]
        assert burst.data == bytes(LONGEST_DATA_BYTES)
        assert burst.note == "noise 58000 more bytes left out"


async def test_an_unknown_line_is_refused_with_those_that_exist():
    async with running_rig() as rig:
        name = rig.daemon.rig.buses[0].bus.settings.name

        with pytest.raises(ValueOutOfRange, match=name):
            await fetch_wire_log(rig.client, "nowhere", seconds=1.0)
