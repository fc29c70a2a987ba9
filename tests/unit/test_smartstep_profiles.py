import dataclasses

import pytest

from ldcnd.drivers.smartstep.profiles import DOUBTS, SMARTSTEP, Doubt, SmartStepProfile, Standing
from ldcnd.errors import ConfigError

WITHOUT_SWITCH = {"unit_digit", "switches_rule", "untriggered_start", "alarm_history_order"}


def test_every_doubt_starts_as_an_assumption_under_its_own_key():
    assert all(doubt.standing is Standing.ASSUMED for doubt in DOUBTS)
    assert len({doubt.key for doubt in DOUBTS}) == len(DOUBTS)


def test_every_doubt_with_a_switch_is_a_field_of_the_profile():
    fields = {field.name for field in dataclasses.fields(SmartStepProfile)}

    assert {doubt.key for doubt in DOUBTS} - fields == WITHOUT_SWITCH


def standing_of(profile: SmartStepProfile, key: str) -> Doubt:
    return next(doubt for doubt in profile.doubts if doubt.key == key)


def test_bench_settles_one_doubt_and_leaves_the_others():
    profile = SMARTSTEP.settled("trace_word_layout", Standing.BENCH_VERIFIED)

    assert standing_of(profile, "trace_word_layout").standing is Standing.BENCH_VERIFIED
    assert standing_of(profile, "string_checksum").standing is Standing.ASSUMED
    assert standing_of(SMARTSTEP, "trace_word_layout").standing is Standing.ASSUMED


def test_unknown_doubt_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="string_checksum"):
        SMARTSTEP.settled("weather", Standing.CONTRADICTED)
