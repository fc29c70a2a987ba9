import pytest

from ldcnd.drivers.smartstep.alarms import ALARMS, NO_ALARM, AlarmKind, alarm

CODES = [0x04, 0x10, 0x30, 0x32, 0x40, 0x51, 0x70, 0x73, 0x74, 0x7A, 0xBF, 0xC1, 0xC2, 0xC3, 0xD0, 0x91, 0x92, 0x99]


def test_table_has_the_manuals_codes():
    assert [known.code for known in ALARMS] == CODES


@pytest.mark.parametrize("known", ALARMS, ids=lambda known: f"{known.code:04X}")
def test_listed_code_is_found(known):
    assert alarm(known.code) is known


def test_0099_means_that_there_is_no_alarm():
    assert alarm(NO_ALARM).kind is AlarmKind.NONE


def test_91_and_92_are_warnings():
    assert {known.code for known in ALARMS if known.kind is AlarmKind.WARNING} == {0x91, 0x92}


def test_unlisted_code_keeps_its_number():
    unknown = alarm(0x1234)

    assert (unknown.code, unknown.kind) == (0x1234, AlarmKind.UNKNOWN)
    assert "1234" in unknown.text
