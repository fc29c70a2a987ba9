"""How many system calls a poll takes on a port: what a processor pays for that no Python code shows."""

import asyncio
from pathlib import Path

import pytest

from ldcnd.config.rig import RigConfig
from tests.support.counted import counted_system_calls
from tests.support.process import simulated_terminal
from tests.support.rig import running_rig

pytestmark = pytest.mark.real_time

DRIVES = 8
COUNTED_S = 1.0
MOST = {"posix.write": 1.01, "posix.sched_yield": 1.01, "posix.read": 1.1, "fcntl.ioctl": 0.05, "epoll.poll": 1.6}
"""Of each, for a poll: the request, one yield behind it, as this port is a pseudo-terminal, one read, and one wait, but
for what timers wake for."""


def busy_rig(port: Path) -> RigConfig:
    rates = {"position": 500.0, "velocity": 500.0, "adc": 500.0, "state": 500.0}
    axes = [
        {"name": f"a{n}", "address": n, "model": "ls-182ap", "velocity": 1, "acceleration": 1, "rates": rates}
        for n in range(1, DRIVES + 1)
    ]
    bus = {"name": "line0", "port": str(port), "baud": 115_200, "overload": "skip", "stop_probe_hz": 0, "axis": axes}
    return RigConfig.model_validate({"rig": "sim", "bus": [bus]})


async def test_a_poll_takes_so_many_system_calls_and_no_more(tmp_path: Path):
    port = tmp_path / "line0"
    async with simulated_terminal(port, *["ls182ap"] * DRIVES), running_rig(busy_rig(port)) as rig:
        statistics = rig.daemon.rig.buses[0].bus.statistics
        before = statistics.replies
        with counted_system_calls() as counted:
            await asyncio.sleep(COUNTED_S)
        polls = statistics.replies - before

    each = {name: count / polls for name, count in counted.items()}
    print(f"{polls} polls: {each}")
    assert polls > 100
    assert all(each[name] <= MOST[name] for name in each)
