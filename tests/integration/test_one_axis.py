"""A line with one drive, asked as fast as it answers: the next request is under way before the last reply is told."""

import asyncio

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.samples import TelemetryItem
from tests.support.rig import running_rig


@pytest.mark.long
async def test_what_is_asked_seldom_is_published_though_the_next_question_is_already_another_one():
    axis = {
        "name": "x",
        "address": 1,
        "model": "ls-182ap",
        "velocity": 1.0,
        "acceleration": 1.0,
        "rates": {"position": 2000.0, "velocity": 2000.0, "adc": 20.0, "state": 1.0},
    }
    bus = {"name": "line0", "port": "sim:line0", "baud": 115_200, "overload": "skip", "axis": [axis]}
    sim = {"name": "line0", "module": [{"model": "ls182ap"}]}
    config = RigConfig.model_validate({"rig": "sim", "bus": [bus], "sim": [sim]})

    async with running_rig(config) as rig:
        await asyncio.sleep(1.0)
        before = await rig.client.last("x", TelemetryItem.ADC)
        await asyncio.sleep(5.0)
        after = await rig.client.last("x", TelemetryItem.ADC)

    assert before
    assert after
    assert abs(after.seq - before.seq - 100) <= 2
