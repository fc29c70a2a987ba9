"""Where a put to a motor record sends its motor: to a place, or on by a distance."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class GoalPosition:
    """A position, in axis units."""

    position: float

    def behind(self, _target: float) -> float:
        """Return the position that is meant, wherever the axis was sent before."""
        return self.position


@dataclass(frozen=True, slots=True)
class Distance:
    """A way from where the axis was sent before, in axis units, signed: no step is lost, however quick they are."""

    by: float

    def behind(self, target: float) -> float:
        """Return the position that is meant when the axis was sent to a target before."""
        return target + self.by
