import pytest

from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.drives.smartstep.parameters import (
    PARAMETERS,
    PN000,
    PN10A,
    PN100,
    Confidence,
    Fact,
    Limits,
    Parameter,
    digit_of,
    find_parameter,
    parameter_at,
    unit_number,
    with_digit,
)

MANUAL = """
0000 0001 0100 0101 0102 0103 0109 010A 0110 0200 0202 0203 0204 0207 0208 0304 0401 0402 0403 0500 0505 0600
"""


def test_table_has_the_manuals_parameters_in_order():
    assert [f"{parameter.eeprom_address:04X}" for parameter in PARAMETERS] == MANUAL.split()
    assert len({parameter.name for parameter in PARAMETERS}) == 22


def test_ram_address_is_1000h_above_eeprom():
    assert (PN10A.label, PN10A.eeprom_address, PN10A.ram_address) == ("Pn10A", 0x010A, 0x110A)


def test_range_of_the_manuals_example_ends_at_2000():
    assert PN100.limits == Fact(Limits(1, 2000), Confidence.RELATED)


def test_parameters_are_found_by_label_in_any_case():
    assert find_parameter("pn10a") is PN10A
    assert find_parameter("Pn0") is find_parameter("basic SWITCH 1") is PN000
    assert find_parameter("Pn003") == Parameter(0x003, "")
    assert find_parameter("speed") is None


def test_parameter_at_stays_in_the_parameter_area():
    assert parameter_at(0x003).ram_address == 0x1003
    with pytest.raises(ValueOutOfRange):
        parameter_at(0x1000)


def test_digits_count_from_the_right():
    assert [digit_of(0x1234, digit) for digit in range(4)] == [4, 3, 2, 1]
    assert with_digit(0x1234, 2, 0xF) == 0x1F34


def test_unit_number_is_the_third_digit_from_the_right():
    assert unit_number(0x0B10) == 0xB
