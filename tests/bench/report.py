"""What the bench prints: one row for each figure, with its target where there is one."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """One figure.

    Attributes:
        at_most: the target is an upper limit; otherwise a lower one.
        exact: a count, or measured on the jumping clock: the same on any machine at any hour.
        doubt: why the figure says little of the daemon in this run; it is not judged then.
    """

    name: str
    value: float
    unit: str = ""
    target: float | None = None
    at_most: bool = False
    exact: bool = False
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


def table(rows: list[Row]) -> str:
    """Return the rows as a table of Markdown."""
    lines = ["| figure | value | target | |", "|---|---|---|---|"]
    for row in rows:
        target = "" if row.target is None else f"{'≤' if row.at_most else '≥'} {row.target:g}"
        lines.append(f"| {row.name} | {_shown(row.value)} {row.unit} | {target} | {row.verdict} |")
    return "\n".join(lines)


def _shown(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.4g}"
