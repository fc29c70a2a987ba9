"""What the audit of a drive's parameters takes for a change by another program."""

from ldcnd.contract.parameters import Memory, ParameterValue
from ldcnd.drives.smartstep.drive import ParameterAudit
from ldcnd.drives.smartstep.parameters import PARAMETERS

PLACE = 4
LABEL = PARAMETERS[PLACE].label


def known(value: int = 40) -> ParameterAudit:
    audit = ParameterAudit()
    assert not audit.read(PLACE, value)
    return audit


def held(active: int, stored: int) -> ParameterValue:
    return ParameterValue(parameter=LABEL, name="", active=active, stored=stored, eeprom_writes=None, eeprom_total=None)


def test_a_value_that_differs_is_believed_when_it_reads_the_same_again():
    audit = known()
    again = audit.read(PLACE, 60)
    before = audit.differences
    assert (again, before, audit.read(PLACE, 60)) == (True, "", False)
    assert audit.differences == f"{LABEL} is 60 and was 40"


def test_a_damaged_reading_is_no_change():
    audit = known()
    assert audit.read(PLACE, 41)
    assert not audit.read(PLACE, 40)
    assert audit.differences == ""


def test_a_change_is_said_until_it_is_undone_or_accepted():
    for value in (40, 60):
        audit = known()
        audit.read(PLACE, 60)
        audit.read(PLACE, 60)
        audit.wrote(held(value, 40), Memory.RAM)
        assert not audit.read(PLACE, value)
        assert audit.differences == ""


def test_what_was_written_to_ram_only_is_missed_after_a_reset():
    audit = known()
    audit.wrote(held(60, 40), Memory.RAM)
    audit.read(PLACE, 40)
    audit.read(PLACE, 40)
    assert audit.differences == f"{LABEL} is 40 and was 60"


def test_what_was_written_to_eeprom_is_expected_from_the_next_power_on_on():
    audit = known()
    audit.wrote(held(40, 60), Memory.EEPROM)
    assert not audit.read(PLACE, 40)
    assert not audit.read(PLACE, 60)
    assert audit.differences == ""


def test_after_a_write_whose_reply_was_lost_either_value_is_expected():
    for memory in Memory:
        for value in (40, 60):
            audit = known()
            audit.may_have_written(LABEL, 60, memory)
            assert not audit.read(PLACE, value)
            assert audit.differences == ""


def test_a_value_that_another_program_left_in_ram_is_said_though_the_one_in_eeprom_is_written_again():
    audit = known()
    audit.read(PLACE, 60)
    audit.read(PLACE, 60)
    audit.wrote(held(60, 40), Memory.EEPROM)
    assert not audit.read(PLACE, 60)
    assert audit.differences == f"{LABEL} is 60 and was 40"
