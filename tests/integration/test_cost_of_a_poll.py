"""What a poll costs the daemon, counted in calls of its own functions: exact where times scatter."""

import asyncio
from itertools import pairwise

from ldcnd.bus.queue import CHOICE
from ldcnd.config.rig import RigConfig
from tests.support.counted import counted_calls
from tests.support.rig import running_rig

ITEMS = ("position", "velocity", "adc", "state")
AXES = (1, 8, 31)
HZ = 1000.0
"""More than the line carries."""
COUNTED_S = 0.4
CALLS_OF_A_CHOICE = 4
MORE_WITH_AXES = 8
"""Calls: what is done for each axis once a second falls upon the polls of that second."""


def config(*, axes: int, items: tuple[str, ...], order: str) -> RigConfig:
    rates = dict.fromkeys(ITEMS, 0.0) | {"state": 1.0} | dict.fromkeys(items, HZ)
    drives = [
        {"name": f"a{n}", "address": n, "model": "ls-182ap", "velocity": 1, "acceleration": 1, "rates": rates}
        for n in range(1, axes + 1)
    ]
    bus = {"name": "line0", "port": "sim:line0", "baud": 115_200, "overload": "skip", "order": order, "axis": drives}
    return RigConfig.model_validate(
        {"rig": "sim", "bus": [bus], "sim": [{"name": "line0", "module": [{"model": "ls182ap"}] * axes}]}
    )


counted: dict[tuple[int, tuple[str, ...], str], float] = {}
"""What was counted already: on the jumping clock it is the same each time."""


async def calls_of_a_poll(*, axes: int = 8, items: tuple[str, ...] = ITEMS, order: str = "deadline") -> float:
    """Poll a line as often as it can be, and return how many functions a poll calls on average."""
    case = (axes, items, order)
    if case in counted:
        return counted[case]
    async with running_rig(config(axes=axes, items=items, order=order)) as rig:
        statistics = rig.daemon.rig.buses[0].bus.statistics
        await asyncio.sleep(1.0)
        before = statistics.replies
        with counted_calls() as count:
            await asyncio.sleep(COUNTED_S)
        counted[case] = count.calls / (statistics.replies - before)
        return counted[case]


async def test_a_further_item_adds_an_eighth_of_the_first_at_most_whatever_else_is_read():
    calls = [await calls_of_a_poll(items=ITEMS[:count]) for count in range(1, len(ITEMS) + 1)]
    steps = [more - fewer for fewer, more in pairwise(calls)]
    print(f"calls with 1 to {len(ITEMS)} items: {[round(each, 1) for each in calls]}")

    assert all(0.0 < step < calls[0] / 8 for step in steps)


async def test_a_poll_costs_the_same_with_any_number_of_axes():
    calls = [await calls_of_a_poll(axes=axes) for axes in AXES]
    print(f"calls with {AXES} axes: {[round(each, 1) for each in calls]}")

    assert max(calls) < min(calls) + MORE_WITH_AXES


async def test_to_choose_by_phase_costs_a_call_for_each_candidate_and_no_more():
    by_deadline = [await calls_of_a_poll(axes=axes) for axes in AXES]
    by_phase = [await calls_of_a_poll(axes=axes, order="phase") for axes in AXES]
    more = [phase - deadline for phase, deadline in zip(by_phase, by_deadline, strict=True)]
    print(f"calls more with {AXES} axes: {[round(each, 1) for each in more]}")

    assert more == sorted(more)
    assert CALLS_OF_A_CHOICE < more[-1] < CALLS_OF_A_CHOICE + CHOICE
