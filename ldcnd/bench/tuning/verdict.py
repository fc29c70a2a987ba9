"""Figures of test moves, and whether one set of gains is better than another."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldcnd.bench.tuning.design import WINDOW_COUNTS, WINDOW_SHARE
from ldcnd.bench.tuning.excitation import BOTH_WAYS, MoveRecord
from ldcnd.bench.tuning.identify import begin_s
from ldcnd.bench.tuning.plant import Plant
from ldcnd.bench.tuning.response import Figures, Floats, figures, simulate
from ldcnd.drives.ldcn.profiles import Profile

MOST_MEASURED_OVERSHOOT = 0.15
SAME_S = 0.005
"""Settling times that differ by less are equal, seconds: two samples of a trace at 115200 baud."""


@dataclass(frozen=True, slots=True)
class Measured:
    """A test move as it was traced.

    Attributes:
        times_s: from the begin of the move, as far as the model can place it.
        commanded: command positions at these instants, counts from the one before the move.
        positions: encoder positions likewise.
        predicted: positions of the model.
        figures: of the measured positions.
    """

    times_s: Floats
    commanded: Floats
    positions: Floats
    predicted: Floats
    figures: Figures


def measured(profile: Profile, plant: Plant, record: MoveRecord) -> Measured:
    """Lay a trace beside the model's prediction of it."""
    begun_s = begin_s(profile, plant, record)
    times = np.asarray(record.times_s) - begun_s
    run = simulate(profile, plant, record.gains, record.move, float(times[-1]), record.start)
    commanded = np.interp(times, run.times_s, run.commanded, left=0.0)
    predicted = np.interp(times, run.times_s, run.positions, left=0.0)
    positions = np.asarray(record.positions, dtype=np.float64)
    window = max(WINDOW_COUNTS, WINDOW_SHARE * abs(record.move.distance_counts))
    return Measured(times, commanded, positions, predicted, figures(times, positions, commanded, window))


def worst(moves: Sequence[Measured]) -> Figures | None:
    """Return the worst of each figure of a move there and of one back; None where there are not both."""
    if len(moves) < BOTH_WAYS:
        return None
    each = [move.figures for move in moves]
    return Figures(
        overshoot=max(one.overshoot for one in each),
        settling_s=max(one.settling_s for one in each),
        settled=all(one.settled for one in each),
        following_error_counts=max(one.following_error_counts for one in each),
        error_counts=max((one.error_counts for one in each), key=abs),
    )


def objection(new: Figures | None, old: Figures | None, same_s: float = SAME_S) -> str | None:
    """Return why new gains are not better than old ones; None where they are at least as good.

    Args:
        new: figures with them; None where the drive gave up.
        old: figures with the old ones; None where the drive gave up, or they were not tried.
        same_s: settling times that differ by less are equal, seconds.
    """
    if new is None:
        return "the drive opened its loop in the test move"
    if not new.settled:
        return f"the test move did not settle: {new.error_counts:+.0f} counts are left"
    if new.overshoot > MOST_MEASURED_OVERSHOOT:
        return f"the test move overshot by {new.overshoot:.0%}, more than {MOST_MEASURED_OVERSHOOT:.0%}"
    if old is not None and old.settled and new.settling_s > old.settling_s + same_s:
        return f"it settles in {new.settling_s * 1e3:.0f} ms, with the old gains in {old.settling_s * 1e3:.0f} ms"
    return None
