from dataclasses import replace

import pytest

from ldcnd.drives.cost import Cost
from ldcnd.drives.simulated_polling import PolledDrive, mean_lengths_s
from tests.support.polled_chain import BAUD, CYCLE, saturated

BYTE_S = 10 / BAUD
COST = Cost(request_s=5 * BYTE_S, wait_s=CYCLE.length_s, reply_s=9 * BYTE_S * CYCLE.stretch, overhead_s=0.000_06)


def wait_s(drives: int, rate_hz: float, seed: int = 1) -> float:
    """Return how long drives with equal rates make the line wait on average."""
    lengths_s = mean_lengths_s((PolledDrive(rate_hz, COST),) * drives, CYCLE, seed)
    return sum(lengths_s) / drives - COST.wire_s - COST.overhead_s


def test_a_drive_by_itself_is_waited_for_half_a_cycle():
    assert wait_s(1, 37.0) == pytest.approx(CYCLE.length_s / 2, rel=0.05)


@pytest.mark.parametrize("rate_hz", [10.0, 1000.0])
def test_the_more_drives_there_are_to_choose_from_the_less_they_are_waited_for(rate_hz: float):
    waits_s = [wait_s(drives, rate_hz) for drives in (1, 4, 31)]

    assert waits_s == sorted(waits_s, reverse=True)
    assert waits_s[-1] < 0.5 * waits_s[0]


@pytest.mark.parametrize("rate_hz", [10.0, 1000.0])
@pytest.mark.sweep(2)
def test_where_the_cycles_lie_matters_little(rate_hz: float):
    lengths_s = [COST.wire_s + wait_s(31, rate_hz, seed) for seed in range(4)]

    assert max(lengths_s) < 1.06 * min(lengths_s)


@pytest.mark.long
async def test_a_line_that_polls_all_the_time_is_as_quick_as_one_that_is_simulated_byte_by_byte():
    simulated = await saturated(31, 3.0, by_phase=True)
    drive = PolledDrive(2000.0, replace(COST, overhead_s=0.0))

    assert sum(mean_lengths_s((drive,) * 31, CYCLE)) / 31 == pytest.approx(1.0 / simulated.per_s, rel=0.03)


def test_a_drive_that_has_no_turn_is_reckoned_with_as_without_an_order():
    seldom = PolledDrive(0.0001, Cost(0.001, 0.002, 0.003, 0.004))
    lengths_s = mean_lengths_s((PolledDrive(10_000.0, COST), seldom), CYCLE)

    assert lengths_s[1] == seldom.cost.mean_s
