"""How the bench judges ratios of rounds that took turns."""

from random import Random

import pytest

from tests.bench.report import paired

SEED = 26
OPEN = "not judged: the rounds leave it open, more of them would tell (--rounds)"


@pytest.mark.parametrize("rounds", [6, 9, 23, 45])
def test_the_interval_holds_the_true_median_in_95_of_100_runs(rounds: int) -> None:
    """Whatever the distribution: here most rounds agree, and one in five was disturbed."""
    dice = Random(SEED)
    runs, held = 2000, 0
    for _ in range(runs):
        ratios = [dice.lognormvariate(0.0, 1.0 if dice.random() < 0.2 else 0.05) for _ in range(rounds)]
        row = paired("ratio", ratios)
        assert row.between
        held += row.between[0] <= 1.0 <= row.between[1]
    assert 0.945 <= held / runs <= 0.985, f"seed {SEED}"


@pytest.mark.parametrize(
    ("target", "at_most", "verdict"),
    [
        (3.0, True, "met"),
        (1.0, True, "MISSED"),
        (2.0, True, OPEN),
        (1.0, False, "met"),
        (3.0, False, "MISSED"),
        (2.0, False, OPEN),
    ],
)
def test_a_ratio_is_judged_when_its_whole_interval_is_on_one_side(
    target: float, verdict: str, *, at_most: bool
) -> None:
    ratios = [1.8, 1.9, 1.95, 2.05, 2.1, 2.2]
    assert paired("ratio", ratios, target, at_most=at_most).verdict == verdict
