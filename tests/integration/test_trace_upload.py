"""A SmartStep's trace memory is read as quickly as its line allows."""

import pytest

from ldcnd.config.plan import plan_rig
from ldcnd.config.rig import load_config
from ldcnd.drives.smartstep.commands import LONGEST_STRING_BYTES
from ldcnd.drives.smartstep.profiles import SMARTSTEP
from tests.bench.trace_upload import AS_A_RULE_BYTES, MEMORIES, READINGS, SHARE, limit_s, share_of_limit
from tests.support.trace_rig import MIXED


@pytest.mark.long
def test_on_an_idle_line_the_longest_strings_take_nearly_all_of_the_time():
    assert SHARE <= share_of_limit(LONGEST_STRING_BYTES) < 1.0


@pytest.mark.parametrize("string_bytes", [AS_A_RULE_BYTES, 40])
@pytest.mark.sweep(2)
def test_on_an_idle_line_nothing_but_the_silence_before_each_command_comes_between_two_strings(string_bytes):
    strings = MEMORIES * READINGS * LONGEST_STRING_BYTES // string_bytes
    took_s = limit_s(string_bytes) / share_of_limit(string_bytes)

    assert took_s <= limit_s(string_bytes) + strings * SMARTSTEP.quiet_s


@pytest.mark.long
def test_beside_polls_an_upload_has_what_they_leave():
    (left,) = [1 - bus.mean_load for bus in plan_rig(load_config(MIXED)).buses if bus.bus == "steps"]

    assert share_of_limit(AS_A_RULE_BYTES, polled=True) > left
