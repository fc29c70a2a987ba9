"""How fast a motor may become under a raw duty, from its readings."""

from types import SimpleNamespace

import pytest

from ldcnd.axis.procedures.pwm import PwmRun
from ldcnd.contract.commands import SetPwm


def test_two_readings_that_follow_each_other_closely_make_no_acceleration_of_a_coarse_velocity():
    """Read late and then at once, as on a busy machine, a motor seemed to reach its limit at once and was stopped."""
    tracker = SimpleNamespace(read_at_s=10.0)
    run = PwmRun(SimpleNamespace(tracker=tracker), None, SetPwm(duty=0.2, duration_s=3.0))
    run.fastest(0.0)
    tracker.read_at_s = 10.001

    assert run.fastest(20.0) == (20.0, 0.0)
    tracker.read_at_s = 10.1
    assert run.fastest(50.0)[0] == pytest.approx(50.0 + 0.2 * 500.0)
