"""When a shaft stands, brakes, and when a motion has settled: decided from readings. Pure; time is an input."""

import math
from dataclasses import dataclass, replace

from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import AxisReading, StopMode

REST_S = 0.25
"""Shortest time within `REST_COUNTS` that proves rest of a shaft without a profile of this daemon, seconds."""
REST_COUNTS = 5
"""Highest less lowest position of a shaft at rest: a closed loop hunts by some counts. More than 20 counts/s never pass
for rest."""
MOST_REST_S = 2.0
"""A shaft that crept out of that band must stay in it for twice as long as it took, at most this."""
LEAST_WINDOW_COUNTS = 5.0
"""A closed loop hunts by some counts."""
LAG_S = 0.1
"""A shaft that brakes follows its profile by less than this: no loop in use is softer."""
ROOM_COUNTS = 50
"""Room for a shaft that swings when its profile has ended."""
ROOM_SHARE = 1.25
"""Most that a braking distance may be of what velocity and deceleration make it."""
UNKNOWN_BRAKING_S = 1.0
"""A shaft whose deceleration is not known is given as long at its velocity, seconds."""
WINDOW_OF_EL = 1 / 400
"""Settle window as a fraction of the position error limit: that is some hundred times the error at rest."""


@dataclass(frozen=True, slots=True)
class RestEvidence:
    """What readings prove of the rest of a shaft.

    The velocity of a status packet has no fraction, and a drive in velocity mode says that its profile is done as soon
    as the velocity is reached: a shaft that creeps below one count per tick shows velocity 0 and a finished profile. So
    one reading proves rest only of a closed loop whose profile this daemon commanded, in which done means at rest; of
    any other it takes positions.

    Attributes:
        rests: whether it does; None while that is not known.
        turns: the latest reading shows a velocity.
        commanded: the drive's profile is one of this daemon's.
        since_s: from when on positions have stayed together, in loop time; None while they have not.
        low: lowest of these positions, counts.
        high: highest of them.
        quiet_s: for how long they must.
    """

    rests: bool | None = None
    turns: bool = False
    commanded: bool = False
    since_s: float | None = None
    low: int = 0
    high: int = 0
    quiet_s: float = REST_S

    def observe(self, reading: AxisReading, at_s: float) -> "RestEvidence":
        """Return the evidence with a reading that was requested at an instant, in loop time."""
        position = reading.position_counts
        runs = reading.enabled and not reading.profile_done
        # `shows_velocity`, written out: every poll passes here
        if runs or abs(reading.velocity_counts_per_s) > reading.velocity_resolution_counts_per_s:
            if self.rests is False and self.turns and self.since_s is None and self.quiet_s == REST_S:
                return self
            return RestEvidence(rests=False, turns=True, commanded=self.commanded)
        if self.commanded and reading.enabled:
            return self if self.rests else replace(self, rests=True)
        if self.since_s is None:
            return replace(self, turns=False, since_s=at_s, low=position, high=position)
        low, high, held_s = min(self.low, position), max(self.high, position), at_s - self.since_s
        if high - low > REST_COUNTS:
            quiet_s = min(max(2 * held_s, REST_S), MOST_REST_S)
            return replace(self, rests=False, quiet_s=quiet_s, since_s=at_s, low=position, high=position)
        rests = True if held_s >= self.quiet_s else self.rests
        if rests is self.rests and low == self.low and high == self.high:
            return self
        return replace(self, rests=rests, low=low, high=high)


NOTHING_SEEN = RestEvidence()
"""Of a drive that was out of reach, or that was not read since something was commanded."""


def shows_velocity(reading: AxisReading) -> bool:
    """Tell whether a reading shows a velocity that is not within the resolution of its drive."""
    return abs(reading.velocity_counts_per_s) > reading.velocity_resolution_counts_per_s


@dataclass(frozen=True, slots=True)
class Braking:
    """A stop that a drive has confirmed, and that readings have not shown yet.

    A reply has no number: one that comes late to something older can pass for the confirmation of a stop that was lost.
    So a stop is over when the shaft is seen to rest, and was not heard by a drive whose shaft goes farther than it
    needs for braking, or whose loop is still closed after it was switched off.

    Attributes:
        mode: how.
        heard_at_s: when it was confirmed, in loop time.
        deceleration_counts_per_s2: that the drive holds for it; None while it is not known.
        from_counts: where the first reading after it has found the shaft; None before that.
        room_counts: how far from there it may go.
        still_counts: the place by which it stands, if it does.
        still_since_s: since when, in loop time.
    """

    mode: StopMode
    heard_at_s: float
    deceleration_counts_per_s2: float | None = None
    from_counts: int | None = None
    room_counts: float = math.inf
    still_counts: int = 0
    still_since_s: float = math.inf

    def observe(self, reading: AxisReading, at_s: float) -> "Braking | bool":
        """Take a reading; return what is still awaited, True once the stop is seen, or False: it was not heard.

        Args:
            reading: what the drive shows.
            at_s: when it was requested, in loop time.
        """
        if at_s < self.heard_at_s:
            return self
        if self.mode is StopMode.OFF or not reading.enabled:
            return not reading.enabled
        position = reading.position_counts
        if self.from_counts is None:
            return replace(
                self,
                from_counts=position,
                room_counts=self._room_counts(reading),
                still_counts=position,
                still_since_s=at_s,
            )
        if abs(position - self.from_counts) > self.room_counts:
            return False
        if abs(position - self.still_counts) > REST_COUNTS:
            return replace(self, still_counts=position, still_since_s=at_s)
        return True if at_s - self.still_since_s >= REST_S else self

    def _room_counts(self, reading: AxisReading) -> float:
        return room_to_rest(reading, math.inf if self.mode is StopMode.ABRUPT else self.deceleration_counts_per_s2)


def room_to_rest(reading: AxisReading, deceleration_counts_per_s2: float | None) -> float:
    """Return how far a shaft goes at most that brakes from what a reading shows, counts.

    Args:
        reading: of the shaft.
        deceleration_counts_per_s2: None while it is not known.
    """
    speed = abs(reading.velocity_counts_per_s) + reading.velocity_resolution_counts_per_s
    braking_s = speed / (2 * deceleration_counts_per_s2) if deceleration_counts_per_s2 else UNKNOWN_BRAKING_S
    return ROOM_SHARE * speed * braking_s + speed * LAG_S + ROOM_COUNTS


@dataclass(frozen=True, slots=True)
class Settling:
    """When a motion to a target has settled.

    Attributes:
        target_counts: where it ends.
        window_counts: how far from there the axis may be, in either direction.
        time_s: for how long it must have stayed within the window.
        timeout_s: longest time for that, from the end of the profile.
        faults: an axis that does not settle has a fault.
        stray_counts: how far from the way to its target a shaft may be: beyond the position error limit its drive would
            have switched it off if the way was its own.
        deceleration_counts_per_s2: of the profile.
    """

    target_counts: int
    window_counts: float
    time_s: float
    timeout_s: float
    faults: bool = False
    stray_counts: float = math.inf
    deceleration_counts_per_s2: float = math.inf


@dataclass(frozen=True, slots=True)
class Way:
    """Where a shaft may be that goes to a target: between it and where it was, and not far beside.

    A drive can hold another target than the one that it was told: a late reply passes for its acknowledgement. It then
    goes where nobody has sent it, without a fault of its own.

    Attributes:
        low: lowest position, counts.
        high: highest.
    """

    low: float
    high: float

    @staticmethod
    def to(settling: Settling, reading: AxisReading) -> "Way":
        """Return the way from the first reading of a motion on."""
        here, target = reading.position_counts, settling.target_counts
        # a motion that follows another one may have to turn round
        room = settling.stray_counts + room_to_rest(reading, settling.deceleration_counts_per_s2)
        return Way(min(here, target) - room, max(here, target) + room)

    def has(self, reading: AxisReading) -> bool:
        """Tell whether a shaft is on it."""
        return self.low <= reading.position_counts <= self.high


PACE_S = 0.2
"""A speed is measured over this time: positions are exact, and the velocity of a status packet is coarse."""
PACE_SHARE = 1.1
"""Most that it may be of what was asked for."""


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast a shaft may be from an instant on, after the motion under way was given another speed or target.

    A drive that has not heard of it goes on as before, at a speed from which a person has just turned it down.

    Attributes:
        most_counts_per_s: that it was told.
        from_s: when it has slowed down from what it had, in loop time.
        at_counts: where it was then; None before a reading shows it.
        at_s: when that was.
    """

    most_counts_per_s: float
    from_s: float
    at_counts: int | None = None
    at_s: float = math.inf

    def observe(self, reading: AxisReading, at_s: float) -> "Pace | bool":
        """Take a reading; return what is still to be seen, or whether the shaft is as slow as it was told.

        Args:
            reading: what the drive shows.
            at_s: when it was requested, in loop time.
        """
        if at_s < self.from_s:
            return self
        if self.at_counts is None:
            return replace(self, at_counts=reading.position_counts, at_s=at_s)
        took_s = at_s - self.at_s
        if took_s < PACE_S:
            return self
        way = abs(reading.position_counts - self.at_counts)
        return way <= PACE_SHARE * self.most_counts_per_s * took_s + ROOM_COUNTS


def pace_of(most_counts_per_s: float, deceleration_counts_per_s2: float, reading: AxisReading, now_s: float) -> Pace:
    """Return how fast a shaft may be that has a speed and was told another one, both in either direction."""
    speed = abs(reading.velocity_counts_per_s) + reading.velocity_resolution_counts_per_s
    slowing_s = (speed + most_counts_per_s) / deceleration_counts_per_s2
    return Pace(most_counts_per_s, now_s + ROOM_SHARE * slowing_s + LAG_S)


@dataclass(frozen=True, slots=True)
class SettleProgress:
    """How far an axis has settled, from the end of its profile on.

    Attributes:
        until_s: when it must have settled, in loop time.
        inside_since_s: since when it is within its window; None while it is not.
    """

    until_s: float
    inside_since_s: float | None = None

    def observe(self, settling: Settling, reading: AxisReading, at_s: float) -> tuple["SettleProgress", bool | None]:
        """Take a reading; return the progress, and whether the axis has settled, None while that is open."""
        inside_since_s = self.inside_since_s
        if abs(settling.target_counts - reading.position_counts) > settling.window_counts:
            inside_since_s = None
        elif inside_since_s is None:
            inside_since_s = at_s
        progress = SettleProgress(self.until_s, inside_since_s)
        if inside_since_s is not None and at_s - inside_since_s >= settling.time_s:
            return progress, True
        return progress, False if at_s >= self.until_s else None


def window_counts(config: AxisConfig) -> float:
    """Return how far from its target an axis may be that has settled, in counts."""
    if config.settle.window is not None:
        return config.settle.window * abs(config.signed_counts_per_unit)
    return max(LEAST_WINDOW_COUNTS, WINDOW_OF_EL * config.gains.el if config.gains else 0.0)
