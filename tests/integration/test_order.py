"""`order` in the configuration file decides who is asked next, and so how many polls a saturated line carries."""

import asyncio

import pytest

from ldcnd.config.rig import load_config
from tests.support.rig import running_rig

DRIVES = 8
AXIS = """
[[bus.axis]]
name = "a{address}"
address = {address}
model = "ls-182ap"
velocity = 1
acceleration = 1
rates = {{ position = 2000, velocity = 2000, adc = 2000, state = 1 }}
"""
LINE = """
rig = "sim"

[[sim]]
name = "line0"
module = [{modules}]

[[bus]]
name = "line0"
port = "sim:line0"
baud = 115200
overload = "skip"
{order}
"""


@pytest.fixture
def polls(tmp_path):
    """Count the polls of a second of a saturated line with another order in its file."""

    async def run(order: str) -> int:
        path = tmp_path / "rig.toml"
        line = LINE.format(order=order, modules=", ".join(['{ model = "ls182ap" }'] * DRIVES))
        path.write_text(line + "".join(AXIS.format(address=address) for address in range(1, DRIVES + 1)))
        async with running_rig(load_config(path)) as rig:
            await asyncio.sleep(1.0)
            statistics = rig.daemon.rig.buses[0].bus.statistics
            before = statistics.replies
            await asyncio.sleep(1.0)
            return statistics.replies - before

    return run


@pytest.mark.long
async def test_a_line_that_is_ordered_by_phase_carries_more_than_one_that_is_ordered_by_deadline(polls):
    assert await polls('order = "phase"') > 1.05 * await polls('order = "deadline"')


@pytest.mark.long
async def test_a_line_is_ordered_by_phase_unless_the_file_says_otherwise(polls):
    assert await polls("") > 1.05 * await polls('order = "deadline"')
