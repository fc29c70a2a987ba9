"""What the bench prints: one row for each figure, with its target where there is one."""

import statistics
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """One figure.

    Attributes:
        at_most: the target is an upper limit; otherwise a lower one.
        exact: a count, or measured on the jumping clock: the same on any machine at any hour.
        spread: of a ratio of paired rounds: the width of the middle half of the rounds, as a share of the value. What
            others do to the machine acts on both of a pair, so this judges the ratio, and not the machine's speed.
        doubt: why the figure says little of the daemon in this run; it is not judged then.
    """

    name: str
    value: float
    unit: str = ""
    target: float | None = None
    at_most: bool = False
    exact: bool = False
    spread: float | None = None
    doubt: str = ""

    @property
    def verdict(self) -> str:
        """Say whether the target is met."""
        if self.target is None:
            return ""
        if self.doubt:
            return f"not judged: {self.doubt}"
        met = self.value <= self.target if self.at_most else self.value >= self.target
        return "met" if met else "MISSED"


def paired(name: str, ratios: Iterable[float], target: float | None = None, *, at_most: bool = False) -> Row:
    """Return the row of the ratios of paired rounds, of which there are at least two."""
    found = list(ratios)
    low, middle, high = statistics.quantiles(found, n=4, method="inclusive")
    return Row(name, middle, "", target, at_most, spread=(high - low) / middle)


def table(rows: list[Row]) -> str:
    """Return the rows as a table of Markdown."""
    lines = ["| figure | value | target | |", "|---|---|---|---|"]
    for row in rows:
        target = "" if row.target is None else f"{'≤' if row.at_most else '≥'} {row.target:g}"
        spread = "" if row.spread is None else f" ({row.spread:.0%})"
        lines.append(f"| {row.name} | {_shown(row.value)} {row.unit}{spread} | {target} | {row.verdict} |")
    return "\n".join(lines)


def _shown(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.4g}"
