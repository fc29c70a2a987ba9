"""What a put to a motor record means that moves its motor: to a place, or on by a distance, and how."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Meant:
    """What a put means, as its record was when it came: nothing that is put while it waits changes that.

    Attributes:
        number: in the order of what is put and moves.
        halts: puts before it that halt.
        sets: SET was Set: it says where the motor is.
        speeds: what the fields of velocities and accelerations had; without what is not known yet.
    """

    number: int
    halts: int
    sets: bool
    speeds: Mapping[str, float]


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
