"""From a request in axis units to a motion in counts, checked against limits and quantised to the drive's registers."""

import math
from dataclasses import dataclass

from ldcnd.axis_config import AxisConfig
from ldcnd.daemon.guards import AxisView, check_acceleration, check_position, check_velocity
from ldcnd.drivers.driver import AxisDriver, Motion
from ldcnd.drivers.scaling import Scale
from ldcnd.errors import ValueOutOfRange

LARGEST_COUNT = 0x7FFFFFFF


@dataclass(frozen=True, slots=True)
class MotionPlan:
    """A motion that may be loaded as it is.

    Attributes:
        motion: in counts, as the registers hold it.
        position: target in axis units; None for a motion without one.
        velocity: in units a second, signed like the motion.
        acceleration: in units a second squared.
        duration_s: of the profile, without settling; None for a motion without an end.
    """

    motion: Motion
    position: float | None
    velocity: float
    acceleration: float
    duration_s: float | None


class MotionPlanner:
    """Plans the motions of one axis."""

    def __init__(self, config: AxisConfig, driver: AxisDriver, scale: Scale) -> None:
        self._config = config
        self._driver = driver
        self._scale = scale

    def to_position(
        self,
        view: AxisView,
        position: float,
        *,
        from_counts: int,
        origin_counts: float,
        velocity: float | None,
        acceleration: float | None,
    ) -> MotionPlan:
        """Plan a trapezoid to a position in axis units.

        Raises:
            PositionLimit, VelocityLimit, AccelerationLimit: a software limit forbids it; names the nearest value.
            ValueOutOfRange: a register cannot hold it.
        """
        speed, rate = self._checked(view, velocity, acceleration)
        if view.referenced:
            check_position(view, self._config.limits, position)
        target = round(self._scale.to_counts(position) + origin_counts)
        if abs(target) > LARGEST_COUNT or abs(target - from_counts) > LARGEST_COUNT:
            raise ValueOutOfRange(
                f"axis {view.name}: target {position:g} {view.unit} is {target} counts, beyond the drive's"
                " 32-bit counter",
                axis=view.name,
                value=position,
                limit=LARGEST_COUNT,
            )
        counts_per_unit = self._scale.counts_per_unit
        motion = self._driver.quantise(Motion(target, speed * counts_per_unit, rate * counts_per_unit))
        duration_s = profile_duration_s(
            abs(target - from_counts), motion.velocity_counts_per_s, motion.acceleration_counts_per_s2
        )
        return MotionPlan(
            motion,
            self._scale.to_units(target - origin_counts),
            motion.velocity_counts_per_s / counts_per_unit,
            motion.acceleration_counts_per_s2 / counts_per_unit,
            duration_s,
        )

    def at_velocity(self, view: AxisView, velocity: float, acceleration: float | None) -> MotionPlan:
        """Plan a motion at a constant velocity in units a second, without an end.

        Raises:
            ValueOutOfRange: the velocity is 0, or a register cannot hold it.
            VelocityLimit, AccelerationLimit: a software limit forbids it.
        """
        if velocity == 0:
            raise ValueOutOfRange(
                f"axis {view.name}: a velocity of 0 is not a motion", axis=view.name, value=0.0, remedy="send halt"
            )
        _, rate = self._checked(view, velocity, acceleration)
        motion = self._driver.quantise(
            Motion(None, self._scale.to_counts(velocity), rate * self._scale.counts_per_unit)
        )
        return MotionPlan(
            motion,
            None,
            self._scale.to_units(motion.velocity_counts_per_s),
            motion.acceleration_counts_per_s2 / self._scale.counts_per_unit,
            None,
        )

    def limit_ahead(self, velocity: float) -> float | None:
        """Return the software limit that a motion at this velocity runs towards, in axis units."""
        limits = self._config.limits
        return limits.position_max if velocity > 0 else limits.position_min

    def _checked(self, view: AxisView, velocity: float | None, acceleration: float | None) -> tuple[float, float]:
        speed = self._config.velocity if velocity is None else velocity
        rate = self._config.acceleration if acceleration is None else acceleration
        check_velocity(view, self._config.limits, speed)
        check_acceleration(view, self._config.limits, rate)
        return speed, rate


def profile_duration_s(distance: float, velocity: float, acceleration: float) -> float:
    """Return how long a trapezoid takes, triangular when it is short; any consistent units, all positive."""
    if distance * acceleration < velocity * velocity:
        return 2 * math.sqrt(distance / acceleration)
    return distance / velocity + velocity / acceleration
