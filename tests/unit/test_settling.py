"""When a motion has settled, from readings."""

from dataclasses import replace

import pytest

from ldcnd.axis.rest import SettleProgress, Settling
from tests.support.axis_bench import AT_REST

SETTLING = Settling(target_counts=1000, window_counts=10, time_s=0.05, timeout_s=1.0)


def verdicts(settling: Settling, *positions: tuple[float, int]) -> list[bool | None]:
    progress, found = SettleProgress(until_s=positions[0][0] + settling.timeout_s), []
    for at_s, counts in positions:
        progress, settled = progress.observe(settling, replace(AT_REST, position_counts=counts), at_s)
        found.append(settled)
    return found


@pytest.mark.parametrize("off", [10, -10, 0])
def test_an_axis_that_stays_within_its_window_for_the_time_has_settled(off):
    assert verdicts(SETTLING, (3.0, 1000 + off), (3.04, 1000 + off), (3.06, 1000)) == [None, None, True]


@pytest.mark.parametrize("off", [11, -11])
def test_an_axis_that_leaves_its_window_begins_anew(off):
    assert verdicts(SETTLING, (3.0, 1000), (3.04, 1000 + off), (3.06, 1000), (3.1, 1000), (3.12, 1000)) == [
        None, None, None, None, True,
    ]  # fmt: skip


def test_an_axis_that_stays_outside_has_not_settled_at_the_time_out():
    assert verdicts(SETTLING, (3.0, 900), (3.99, 985), (4.0, 985)) == [None, None, False]


@pytest.mark.parametrize(
    ("_what", "positions", "found"),
    [
        ("inside behind a pause, and it stays", [(3.0, 900), (4.2, 1000), (4.26, 1000)], [None, None, True]),
        ("inside behind a pause, and it leaves", [(3.0, 900), (4.2, 1000), (4.23, 900)], [None, None, False]),
        ("inside shortly before the time-out", [(3.0, 900), (3.98, 1000), (4.0, 1000)], [None, None, False]),
        ("outside before and behind a pause", [(3.0, 900), (4.2, 900)], [None, False]),
    ],
)
def test_the_time_out_is_of_an_axis_that_is_seen_outside(_what, positions, found):
    """A machine that stood still has not looked."""
    assert verdicts(SETTLING, *positions) == found


def test_without_a_time_the_first_reading_within_the_window_settles_it():
    assert verdicts(replace(SETTLING, time_s=0), (3.0, 989), (3.01, 990)) == [None, True]
