"""Encoder counts and axis units: the only place that converts between them."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Scale:
    """How an axis counts.

    Attributes:
        counts_per_unit: encoder counts per axis unit, more than 0; 1 when the axis works in counts.
        reverse: forward in axis units is backward in counts.
    """

    counts_per_unit: float = 1.0
    reverse: bool = False

    @property
    def signed_counts_per_unit(self) -> float:
        """Counts per unit with the sign of the direction."""
        return -self.counts_per_unit if self.reverse else self.counts_per_unit

    def to_counts(self, units: float) -> float:
        """Convert a distance, velocity or acceleration from units to counts, sign included."""
        return units * self.signed_counts_per_unit

    def to_units(self, counts: float) -> float:
        """Convert a distance, velocity or acceleration from counts to units, sign included."""
        return counts / self.signed_counts_per_unit
