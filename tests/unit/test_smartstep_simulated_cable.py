from ldcnd.drivers.smartstep.commands import probe, reference
from ldcnd.drivers.smartstep.parameters import PN000, PN100
from ldcnd.drivers.smartstep.parity import DAMAGED
from ldcnd.drivers.smartstep.profiles import Wiring
from ldcnd.drivers.smartstep.simulated_cable import SimulatedCable
from ldcnd.drivers.smartstep.simulated_unit import SimulatedUnit
from ldcnd.drivers.smartstep.simulated_variant import SimulatedVariant


def unit(number: int, variant: SimulatedVariant | None = None) -> SimulatedUnit:
    return SimulatedUnit(variant, {PN000: number << 8, PN100: 40 + number})


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
