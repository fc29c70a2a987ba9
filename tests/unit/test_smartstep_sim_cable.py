"""Simulated drives behind the simulated line, alone and under the real bus."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import pytest

from ldcnd.contract.errors import OutcomeUnknown, ReplyTimeout
from ldcnd.drives.smartstep.commands import FLUSH, Refusal, probe, reference, string_reference, write_eeprom, write_ram
from ldcnd.drives.smartstep.packet import DAMAGED, ResponseStatus, add_parity, strip_parity
from ldcnd.drives.smartstep.parameters import PN000, PN100, PN102
from ldcnd.drives.smartstep.profiles import Framing, TraceWordLayout, Wiring
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Resync
from ldcnd.line.settings import BusSettings
from ldcnd.sim.chain import Chain, Delivery
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.line import open_simulated_line
from ldcnd.sim.smartstep.cable import SimulatedCable, smartstep_chain
from ldcnd.sim.smartstep.simulation import SimulatedUnitConfig, simulated_units
from ldcnd.sim.smartstep.unit import SimulatedUnit
from ldcnd.sim.smartstep.variant import SimulatedVariant


def heard(cable: SimulatedCable, characters: bytes, at_s: float = 1.0) -> list[bytes]:
    cable.host_sends(characters, at_s)
    return [item.characters for item in cable.host_hears(at_s + 1.0)]


def test_only_the_addressed_unit_answers():
    cable = SimulatedCable([unit(1), unit(2)])
    exchange = reference(2, PN100.eeprom_address)

    (reply,) = heard(cable, exchange.request)

    assert exchange.decode(reply) == 42


def test_reply_begins_when_the_command_is_through():
    cable = SimulatedCable([unit(1, SimulatedVariant(response_s=0.1))])

    sent = cable.host_sends(reference(1, 0x8000).request, 1.0)
    next_start_s = cable.next_start_s()
    (reply,) = cable.host_hears(2.0)

    assert next_start_s == reply.start_s == sent.end_s + 0.1
    assert cable.next_start_s() is None


def test_host_hears_itself_only_on_two_wires_with_echo():
    request = probe(1).request

    assert len(heard(SimulatedCable([unit(1)], echo=True), request)) == 1
    assert len(heard(SimulatedCable([unit(1)], Wiring.TWO_WIRE), request)) == 1
    echoed = heard(SimulatedCable([unit(1)], Wiring.TWO_WIRE, echo=True), request)
    assert echoed[0] == request
    probe(1).decode(echoed[1])


def test_echo_without_a_drive_is_the_request_alone():
    request = probe(3).request

    assert heard(SimulatedCable([unit(1)], Wiring.TWO_WIRE, echo=True), request) == [request]


def test_two_units_of_one_number_damage_each_other():
    cable = SimulatedCable([unit(1), unit(1)])

    replies = heard(cable, reference(1, 0x8000).request)

    assert replies == [bytes([DAMAGED] * 14)] * 2


def test_unit_0_jams_the_drives_it_shares_a_pair_with_but_is_heard_itself():
    cable = SimulatedCable([unit(0), unit(1)])

    assert heard(cable, reference(1, 0x8000).request, 1.0) == [bytes([DAMAGED] * 14)]
    assert reference(0, 0x0100).decode(heard(cable, reference(0, 0x0100).request, 3.0)[0]) == 40


def test_unit_0_on_two_wires_never_hears_the_host():
    cable = SimulatedCable([unit(0)], Wiring.TWO_WIRE)

    assert heard(cable, reference(0, 0x8000).request) == []


def test_drives_on_two_wires_overhear_replies_of_others_and_stay_silent():
    cable = SimulatedCable([unit(1), unit(2)], Wiring.TWO_WIRE)

    assert len(heard(cable, reference(1, PN100.eeprom_address).request)) == 1


def test_host_that_talks_into_a_reply_on_two_wires_is_not_understood():
    cable = SimulatedCable([unit(1), unit(2)], Wiring.TWO_WIRE)
    sent = cable.host_sends(reference(1, 0x8000).request, 1.0)

    cable.host_sends(reference(2, 0x8000).request, sent.end_s + 0.012)

    assert [item.characters[1:2] for item in cable.host_hears(3.0)] == [b"1"]


def unit(number: int, variant: SimulatedVariant | None = None) -> SimulatedUnit:
    return SimulatedUnit(variant, {PN000: number << 8, PN100: 40 + number})


def received(chain: Chain, request: bytes, at_s: float = 1.0) -> list[tuple[float, bytes]]:
    chain.write(at_s, request)
    return chain.advance(at_s + 2.0)


@asynccontextmanager
async def bus_on(chain: Chain, *, echo: bool = False) -> AsyncIterator[Bus]:
    resync = Resync(flush=FLUSH, quiet_s=0.02, probe=lambda _: probe(1))
    bus = Bus(BusSettings("steps", 9600, echo=echo), lambda: open_simulated_line(chain), resync)
    for number in (1, 2):
        bus.proofs.expect(number, f"unit {number}").prove()
    with suppress(asyncio.CancelledError):
        async with asyncio.TaskGroup() as tasks:
            running = tasks.create_task(bus.run(), name="bus")
            await bus.wait_opened()
            yield bus
            running.cancel()


def test_reply_arrives_whole_when_its_last_character_has_come():
    ((at_s, data),) = received(smartstep_chain([unit(1)]), reference(1, PN100.eeprom_address).request)

    assert data == b"W1001000029C6\r"
    assert at_s == pytest.approx(1.0 + 28 * 10 / 9600 + 0.01)


def test_reply_arrives_bytewise_where_the_port_delivers_so():
    pieces = received(smartstep_chain([unit(1)], delivery=Delivery.BYTEWISE), reference(1, 0x0100).request)

    assert b"".join(data for _, data in pieces) == b"W1001000029C6\r"
    assert len(pieces) == 14


def test_soft_parity_is_seven_bits_and_even_on_the_line():
    chain = smartstep_chain([unit(1)], framing=Framing.SOFT_PARITY)
    exchange = reference(1, PN100.eeprom_address)

    ((_, data),) = received(chain, add_parity(exchange.request))

    assert exchange.decode(strip_parity(data)) == 41
    assert received(chain, exchange.request, 5.0) == []


def test_eight_bit_noise_makes_a_drive_deaf_until_a_flush():
    chain = smartstep_chain([unit(1)])
    request = reference(1, 0x8000).request

    assert received(chain, b"\xaa\x55" + request, 1.0) == []
    assert len(received(chain, FLUSH + request, 5.0)) == 1


async def test_bus_reads_and_writes():
    async with bus_on(smartstep_chain([unit(1), unit(2)])) as bus:
        assert await bus.execute(reference(2, PN100.eeprom_address)) == 42
        assert await bus.execute(write_ram(2, PN100, 60)) == 60
        assert await bus.execute(reference(2, PN100.ram_address)) == 60
        assert await bus.execute(reference(1, 0xC000)) == Refusal(1, ResponseStatus.REFERENCE_ADDRESS_ERROR, 0xC000, 0)


async def test_bus_reads_a_trace_memory_from_a_slow_drive():
    slow = unit(1, SimulatedVariant(response_s=0.2))
    slow.drive.recorder.rings[0][:2] = [0x1234, 0xABCD]
    async with bus_on(smartstep_chain([slow])) as bus:
        reply = await bus.execute(string_reference(1, 0x3000, 1000))

    assert reply.data[:4] == bytes.fromhex("1234ABCD")
    assert len(reply.data) == 1000


async def test_bus_drops_its_echo_by_count():
    chain = smartstep_chain([unit(1)], Wiring.TWO_WIRE, echo=True)
    async with bus_on(chain, echo=True) as bus:
        assert await bus.execute(write_ram(1, PN100, 60)) == 60


async def test_lost_replies_are_read_again():
    faults = FaultPlan((LineFault(FaultKind.REPLY_LOST, 0.3), LineFault(FaultKind.REPLY_BYTE_LOST, 0.1)), seed=4)
    async with bus_on(smartstep_chain([unit(1)], faults=faults)) as bus:
        values = []
        for _ in range(30):
            with suppress(ReplyTimeout):
                values.append(await bus.execute(reference(1, PN100.eeprom_address)))

    assert len(values) > 20
    assert set(values) == {41}
    assert bus.statistics.timeouts > 0


async def test_lost_reply_to_an_eeprom_write_is_never_repeated():
    faults = FaultPlan((LineFault(FaultKind.REPLY_LOST),))
    drive = unit(1)
    async with bus_on(smartstep_chain([drive], faults=faults)) as bus:
        with pytest.raises(OutcomeUnknown):
            await bus.execute(write_eeprom(1, PN100, 60))

    assert drive.drive.memory.writes[PN100.number] == 1


def test_host_that_sends_into_a_reply_on_four_wires_does_not_cut_it():
    chain = smartstep_chain([unit(1)])
    exchange = reference(1, PN100.eeprom_address)
    chain.write(1.0, exchange.request)
    chain.advance(1.03)

    chain.write(1.03, FLUSH)

    assert [data for _, data in chain.advance(2.0)] == [b"W1001000029C6\r"]


def configured(**settings) -> SimulatedUnit:
    (unit,) = simulated_units([SimulatedUnitConfig.model_validate({"number": 1, **settings})], 10.0)
    return unit


def test_a_configured_unit_has_its_parameters_switches_history_and_wear():
    unit = configured(stored={"Pn102": 55}, gain_switch=7, switches=0x21, history=[0x10, 0x51], worn=9_999)

    memory = unit.drive.memory
    assert (memory.stored(PN102), unit.drive.gain_switch, int(unit.drive.switches)) == (55, 7, 0x21)
    assert unit.drive.alarm_history[:3] == [0x10, 0x51, 0x99]
    assert [memory.write(0x0102, value) and memory.stored(PN102) for value in (56, 57)] == [56, 56]


def test_what_is_configured_happens_to_a_unit_in_its_time():
    unit = configured(
        event=[
            {"at_s": 3, "alarm": 0x10},
            {"at_s": 1, "run": True, "pulse_rate": 1000},
            {"at_s": 4, "reset": True, "pulse_rate": 0},
            {"at_s": 5, "power": False},
        ]
    )
    seen = []
    for at_s in (10.5, 12.0, 13.5, 14.5, 15.5):
        unit.transmissions(at_s)
        seen.append((unit.drive.motor.servo_on, unit.drive.alarm_code, unit._powered))

    assert seen == [
        (False, 0x99, True),
        (True, 0x99, True),
        (False, 0x10, True),
        (True, 0x99, True),
        (True, 0x99, False),
    ]


def test_a_configured_unit_behaves_as_its_variant_says():
    unit = configured(
        variant={"trace_word_layout": "lsb-io-mask", "eeprom_changes_ram": True, "alarm_output_high": False}
    )

    assert unit.variant.trace_word_layout is TraceWordLayout.LSB_IO_MASK
    assert unit.variant.eeprom_changes_ram
    assert not unit.variant.alarm_output_high


@pytest.mark.parametrize("name", ["Pn000", "Pn7FF", "speed"])
def test_only_parameters_that_there_are_can_be_stored(name):
    with pytest.raises(ValueError, match=name):
        configured(stored={name: 1})
