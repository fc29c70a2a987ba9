import pytest

from ldcnd.drivers.smartstep.parameters import PN100, PN304
from ldcnd.drivers.smartstep.simulated_memory import EEPROM_LIFE, SimulatedMemory


def test_ram_is_lost_and_eeprom_kept_at_power_on():
    memory = SimulatedMemory({PN100: 40}, eeprom_changes_ram=False)
    memory.write(PN100.ram_address, 60)
    memory.write(PN304.eeprom_address, 1000)

    assert (memory.active(PN100), memory.stored(PN100)) == (60, 40)
    memory.power_on()

    assert (memory.active(PN100), memory.active(PN304)) == (40, 1000)


@pytest.mark.parametrize(("at_once", "active"), [(False, 40), (True, 60)])
def test_eeprom_write_changes_ram_where_the_variant_says_so(at_once, active):
    memory = SimulatedMemory({PN100: 40}, eeprom_changes_ram=at_once)

    memory.write(PN100.eeprom_address, 60)

    assert memory.stored(PN100) == 60
    assert memory.active(PN100) == active


def test_value_out_of_range_is_refused_and_costs_no_write():
    memory = SimulatedMemory({PN100: 40}, eeprom_changes_ram=False)

    assert not memory.write(PN100.eeprom_address, 2001)
    assert memory.stored(PN100) == 40
    assert memory.writes[PN100.number] == 0


def test_eeprom_wears_out_after_its_life():
    memory = SimulatedMemory({PN100: 40}, eeprom_changes_ram=False)
    for _ in range(EEPROM_LIFE):
        memory.write(PN100.eeprom_address, 60)

    memory.write(PN100.eeprom_address, 70)

    assert memory.writes[PN100.number] == EEPROM_LIFE + 1
    assert memory.stored(PN100) == 60


@pytest.mark.parametrize("address", [0x0003, 0x1003, 0x0FFF, 0x2000])
def test_there_is_nothing_at_unlisted_addresses(address):
    memory = SimulatedMemory({}, eeprom_changes_ram=False)

    assert memory.read(address) is None
    assert not memory.holds(address)
