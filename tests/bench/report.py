"""What the bench prints: one row for each figure, with its target where there is one."""

import math
import statistics
from collections.abc import Iterable
from dataclasses import dataclass

NORMAL_95 = 1.96
"""Standard deviations of a normal distribution to either side that hold 95 of 100."""
LEAST_ROUNDS = 6
"""Of fewer, not even the whole range holds the median in 95 of 100 runs."""


@dataclass(frozen=True, slots=True)
class Row:
    """One figure.

    Attributes:
        at_most: the target is an upper limit; otherwise a lower one.
        exact: a count, or measured on the jumping clock: the same on any machine at any hour.
        between: of a ratio of paired rounds: the interval that holds their median in 95 of 100 runs. What others do to
            the machine acts on both of a pair, so this says how well the ratio is known, whatever the machine's speed.
        doubt: why the figure says little of the daemon in this run; it is not judged then.
    """

    name: str
    value: float
    unit: str = ""
    target: float | None = None
    at_most: bool = False
    exact: bool = False
    between: tuple[float, float] | None = None
    doubt: str = ""

    @property
    def verdict(self) -> str:
        """Say whether the target is met."""
        if self.target is None:
            return ""
        if self.doubt:
            return f"not judged: {self.doubt}"
        if self.between and self.between[0] < self.target < self.between[1]:
            return "not judged: the rounds leave it open, more of them would tell (--rounds)"
        met = self.value <= self.target if self.at_most else self.value >= self.target
        return "met" if met else "MISSED"


def paired(name: str, ratios: Iterable[float], target: float | None = None, *, at_most: bool = False) -> Row:
    """Return the row of the ratios of `LEAST_ROUNDS` paired rounds or more: their median and its interval, by rank."""
    found = sorted(ratios)
    off = NORMAL_95 / 2 * math.sqrt(len(found))
    first = max(0, math.floor(len(found) / 2 - off))
    between = found[first], found[len(found) - 1 - first]
    return Row(name, statistics.median(found), "", target, at_most, between=between)


def table(rows: list[Row]) -> str:
    """Return the rows as a table of Markdown."""
    lines = ["| figure | value | target | |", "|---|---|---|---|"]
    for row in rows:
        target = "" if row.target is None else f"{'≤' if row.at_most else '≥'} {row.target:g}"
        between = f" ({_shown(row.between[0])} to {_shown(row.between[1])})" if row.between else ""
        lines.append(f"| {row.name} | {_shown(row.value)} {row.unit}{between} | {target} | {row.verdict} |")
    return "\n".join(lines)


def _shown(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.4g}"
