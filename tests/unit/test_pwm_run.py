"""How fast a motor may become under a raw duty, from its readings."""

import asyncio
from dataclasses import replace

import pytest

from ldcnd.contract.commands import SetPosition, SetPwm
from ldcnd.line.exchange import Timing
from tests.support.axis_bench import axis_bench

OPEN = {"profile_done": False, "enabled": False, "position_counts": 0}


async def test_two_readings_that_follow_each_other_closely_make_no_acceleration_of_a_coarse_velocity():
    """Read late and then at once, as on a busy machine, a motor seemed to reach its limit at once and was stopped."""
    async with axis_bench(pwm={"duty": 0.5, "duration_s": 5.0}, limits={"position_max": 10.0}) as bench:
        await bench.send(SetPosition(position=0.0))
        await bench.send(SetPwm(duty=0.2, duration_s=2.0))
        await bench.pass_s(0.1, velocity_counts_per_s=0.0, **OPEN)
        await bench.pass_s(0.001, velocity_counts_per_s=20_000.0, **OPEN)
        assert bench.drive.calls == ["load", "start"]
        await bench.pass_s(0.1, velocity_counts_per_s=20_000.0, **OPEN)
        assert bench.drive.calls == ["load", "start", "stop"]


@pytest.mark.parametrize("late_s", [0.0, 0.5])
async def test_a_reading_of_before_a_pause_gives_a_duty_no_more_time_before_its_limit(late_s):
    """The stop that was due in the pause waited as long again as it had to spare when that reading was made."""
    async with axis_bench(pwm={"duty": 0.5, "duration_s": 5.0}, limits={"position_max": 10.0}) as bench:
        await bench.send(SetPosition(position=0.0))
        await bench.send(SetPwm(duty=0.2, duration_s=4.0))
        await asyncio.sleep(0.2)
        reading, at_s = replace(bench.drive.shown, velocity_counts_per_s=0.0, **OPEN), asyncio.get_running_loop().time()
        asyncio.get_running_loop().hold_up(late_s)
        bench.axis.readings.accept(reading, frozenset(), Timing(*(at_s,) * 4))
        await asyncio.sleep(0.001)
        assert (bench.drive.calls == ["load", "start", "stop"]) is (late_s > 0)
