"""Commands do not starve polls, and a command that is alone waits for nothing but the exchange on the wire."""

import pytest

from ldcnd.line.schedule import COMMANDS_PER_POLL
from tests.bench.commands_and_polls import CALLERS, CROWDS, MOST_ROUNDS, MOST_WAIT, ORDERS, Load, shared

SECONDS = 1.0
"""Ten rounds of the largest crowd."""


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("drives", CROWDS)
@pytest.mark.sweep(4)
def test_commands_for_half_of_the_time_leave_every_axis_a_poll_in_two_rounds(order, drives):
    seen = shared(order, drives, Load.HALF, SECONDS)

    assert seen.commands == pytest.approx(0.5, abs=0.06)  # it varies with the instant at which the line came up
    assert 1.0 < seen.longest_rounds <= 1.01 * MOST_ROUNDS
    assert 0.5 < seen.longest_wait <= MOST_WAIT


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("drives", CROWDS)
@pytest.mark.sweep(4)
def test_commands_that_always_wait_leave_every_axis_a_poll_in_two_rounds(order, drives):
    seen = shared(order, drives, Load.FULL, SECONDS)

    assert CALLERS > COMMANDS_PER_POLL
    assert seen.commands > 0.6
    assert 1.0 < seen.longest_rounds <= 1.01 * MOST_ROUNDS
