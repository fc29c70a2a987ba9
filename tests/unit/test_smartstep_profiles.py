import pytest

from ldcnd.contract.errors import ConfigError
from ldcnd.drives.smartstep.profiles import ASSUMPTIONS, SMARTSTEP, Assumption, SmartStepProfile, Verification

WITHOUT_SWITCH = {
    "unit_digit",
    "switches_rule",
    "untriggered_start",
    "alarm_history_order",
    "alarm_91_92",
    "atomic_counter",
    "eeprom_changes_ram",
    "trace_full_scale",
}


def test_every_assumption_starts_unverified_under_its_own_key():
    assert all(assumption.verification is Verification.ASSUMED for assumption in ASSUMPTIONS)
    assert len({assumption.key for assumption in ASSUMPTIONS}) == len(ASSUMPTIONS)


def test_every_assumption_with_a_switch_is_a_field_of_the_profile():
    switched = {assumption.key for assumption in ASSUMPTIONS if hasattr(SmartStepProfile(), assumption.key)}

    assert {assumption.key for assumption in ASSUMPTIONS} - switched == WITHOUT_SWITCH


def assumption_of(profile: SmartStepProfile, key: str) -> Assumption:
    return next(assumption for assumption in profile.assumptions if assumption.key == key)


def test_verifying_one_assumption_leaves_the_others():
    profile = SMARTSTEP.verified("trace_word_layout", Verification.VERIFIED)

    assert assumption_of(profile, "trace_word_layout").verification is Verification.VERIFIED
    assert assumption_of(profile, "string_checksum").verification is Verification.ASSUMED
    assert assumption_of(SMARTSTEP, "trace_word_layout").verification is Verification.ASSUMED


def test_unknown_assumption_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="string_checksum"):
        SMARTSTEP.verified("weather", Verification.CONTRADICTED)
