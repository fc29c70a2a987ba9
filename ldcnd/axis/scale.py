"""The coordinates of one axis: its unit, its counts per unit, its modulo, and the count at which its position is 0."""

import math
from dataclasses import dataclass, field, replace

from ldcnd.contract.units import AxisUnits, Dimension, quantity_text
from ldcnd.drives.axis_config import AxisConfig, turn_counts
from ldcnd.drives.driver import inward

EXCESS_COUNTS = 1e-6
"""Error of the conversion of a limit to counts: a count that is so near to it is not beyond it."""


@dataclass(frozen=True, slots=True)
class AxisScale:
    """How counts of a drive and positions of its axis belong together.

    Attributes:
        units: in which people read positions, velocities and accelerations.
        counts_per_unit: negative where forward in axis units is backward in counts.
        modulo: length of one turn, in axis units; None for an axis without one.
        origin_counts: count of the drive at position 0. It means something only while the axis is referenced.
        unit: of its positions.
        turn_counts: counts of the drive in a turn; None without a modulo.
    """

    units: AxisUnits = field(compare=False)
    counts_per_unit: float = 1.0
    modulo: float | None = None
    origin_counts: float = 0.0
    unit: str = field(init=False)
    turn_counts: float | None = field(init=False)

    def __post_init__(self) -> None:
        turn = None if self.modulo is None else turn_counts(self.modulo, self.counts_per_unit)
        object.__setattr__(self, "turn_counts", turn)
        object.__setattr__(self, "unit", self.units.unit)  # not a property: each poll publishes it twice

    @classmethod
    def of(cls, config: AxisConfig) -> "AxisScale":
        """Return the scale that an axis is configured with, with its origin at count 0."""
        return cls(config.axis_units, config.signed_counts_per_unit, config.modulo)

    def text(self, value: float, dimension: Dimension) -> str:
        """Return a number in units of the axis as people read it."""
        return quantity_text(value, self.units, dimension, ".6g")

    def position(self, counts: float) -> float:
        """Return the position that a count of the drive stands for, in axis units, counted through all turns."""
        return (counts - self.origin_counts) / self.counts_per_unit

    def exact_counts(self, position: float) -> float:
        """Return where in counts of the drive a position is, which is counted through all turns; perhaps infinite."""
        return position * self.counts_per_unit + self.origin_counts

    def counts(self, position: float) -> int:
        """Return the count of the drive that is nearest to a position, which is counted through all turns."""
        return round(self.exact_counts(position))

    def counts_within(self, position: float, lowest: float | None, highest: float | None) -> int:
        """Return the count that is nearest to a position and between these, where there is one; None is open."""
        low = self.exact_counts(-math.inf if lowest is None else lowest)
        high = self.exact_counts(math.inf if highest is None else highest)
        return inward(self.counts(position), max(low, high) + EXCESS_COUNTS, min(low, high) - EXCESS_COUNTS)

    def within_turn(self, counts: float) -> tuple[float, int | None]:
        """Return the position of a count of the drive as clients see it, and how many whole turns lie below it.

        Without a modulo the turns are None. With one they are counted in counts: no rounding adds up from turn to turn.
        """
        off, modulo, turn = counts - self.origin_counts, self.modulo, self.turn_counts
        if modulo is None or turn is None:
            return off / self.counts_per_unit, None
        turns, rest = divmod(math.copysign(1.0, self.counts_per_unit) * off, turn)
        value = rest / abs(self.counts_per_unit)
        if value >= modulo:  # so rounds what lies less than a hair below a turn
            turns, value = turns + 1, 0.0
        return value, int(turns)

    def shown(self, position: float) -> float:
        """Return a position as clients see it: on an axis with a modulo from 0 up to it."""
        value = position if self.modulo is None else position % self.modulo
        return 0.0 if value == self.modulo else value  # so rounds what lies less than a hair below 0

    def shown_at(self, counts: float) -> float:
        """Return the position of a count of the drive as clients see it."""
        return self.within_turn(counts)[0]

    def with_position(self, counts: float, position: float) -> "AxisScale":
        """Return the scale by which a count of the drive has a position."""
        return replace(self, origin_counts=counts - position * self.counts_per_unit)
