"""The poller of a module that is no axis."""

import pytest

from ldcnd.drives.ldcn.network import PERIOD_S, ModuleWatch


async def test_each_turn_should_be_over_by_the_next_one_and_a_late_one_shifts_none():
    watch = ModuleWatch(5)
    assert (watch.due_at_s, watch.deadline_at_s) == (0.0, PERIOD_S)

    watch.next_exchange(2.4 * PERIOD_S)

    assert watch.due_at_s == pytest.approx(3 * PERIOD_S)
    assert watch.deadline_at_s == pytest.approx(4 * PERIOD_S)
