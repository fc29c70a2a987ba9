"""Durations and ways of trapezoidal profiles: pure, in any consistent units."""

import math


def profile_duration_s(distance: float, velocity: float, acceleration: float) -> float:
    """Return how long a trapezoid takes, triangular when it is short; any consistent units, all positive."""
    if distance * acceleration < velocity * velocity:
        return 2 * math.sqrt(distance / acceleration)
    return distance / velocity + velocity / acceleration


def braking_way(speed: float, deceleration: float) -> float:
    """Return how far it is from a speed to rest; any consistent units, the deceleration above 0."""
    return speed * speed / (2 * deceleration)


def rest_of_profile_s(way: float, before: float, after: float, acceleration: float) -> float:
    """Return how long a trapezoid takes that slews and goes on at another velocity; any consistent units, positive."""
    change_s = (after - before) / acceleration
    return way / after + after / (2 * acceleration) + change_s * abs(after - before) / (2 * after)


def way_within(lasts_s: float, before: float, velocity: float, acceleration: float) -> float:
    """Return the way of a trapezoid that begins at a velocity and ends at rest after a time, or as soon as it can.

    Args:
        lasts_s: that time.
        before: velocity at its beginning, from 0 upwards.
        velocity: highest one of the trapezoid, once it has slewed, above 0.
        acceleration: of the trapezoid, above 0.
    """
    held = min(velocity, max(before / 2, (acceleration * lasts_s + before) / 2))
    slew_s = abs(held - before) / acceleration
    slewing = (held + before) / 2 * slew_s
    return slewing + held * max(0.0, lasts_s - slew_s - held / acceleration) + braking_way(held, acceleration)


def duration_from_s(way: float, before: float, velocity: float, acceleration: float) -> float:
    """Return how long a trapezoid takes that begins at a velocity; any consistent units.

    Args:
        way: to its target, from 0 upwards.
        before: velocity at its beginning, negative away from the target.
        velocity: highest one of the trapezoid, above 0.
        acceleration: of the trapezoid, above 0.
    """
    after_turning = way - math.copysign(braking_way(before, acceleration), before)
    if before < 0 or after_turning < 0:  # away from the target, or too fast to stop there
        return abs(before) / acceleration + profile_duration_s(abs(after_turning), velocity, acceleration)
    # where speeding up from `before` meets slowing down to rest
    highest = math.sqrt(acceleration * way + before * before / 2)
    if highest < velocity:
        return (2 * highest - before) / acceleration
    return rest_of_profile_s(way, before, velocity, acceleration)
