"""An axis that a hand jogs ends, whatever dies: real processes, real signals."""

import pytest

from tests.support.jog_deaths import DRIVES, KINDS, bound_s, deaths, table

pytestmark = [pytest.mark.real_time, pytest.mark.timeout(300)]

SEED = 22


@pytest.mark.soak
async def test_a_jog_ends_when_the_program_or_the_daemon_is_killed(tmp_path):
    async with deaths(tmp_path, SEED, host_s=3.0) as rig:
        for kind, axis in (("program, SIGKILL", "l"), ("daemon, SIGKILL", "s")):
            late_s = await rig.run(kind, axis)
            print(f"{kind}, {axis}: {late_s:.3f} s")
            assert late_s <= bound_s(kind, axis) + rig.host_s


@pytest.mark.soak
@pytest.mark.timeout(5400)
async def test_a_jog_ends_within_its_bound_after_every_death(tmp_path):
    async with deaths(tmp_path, SEED, host_s=1.0) as rig:
        late: list[tuple[int, str, str, float]] = []
        for at in range(500):
            kind, axis = list(KINDS)[at % len(KINDS)], list(DRIVES)[at // len(KINDS) % len(DRIVES)]
            late_s = await rig.run(kind, axis)
            if late_s > bound_s(kind, axis) + rig.host_s:
                late.append((at, kind, axis, late_s))
        print(f"seed {SEED}\n{table(rig.late_s)}")
        assert not late
