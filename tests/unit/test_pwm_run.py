"""How fast a motor may become under a raw duty, from its readings."""

from ldcnd.contract.commands import SetPosition, SetPwm
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
