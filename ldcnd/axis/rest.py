"""When a shaft stands, and when a motion has settled: decided from readings. Pure; time is an input."""

import math
from dataclasses import dataclass, replace
from enum import Enum, auto

from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import AxisReading

REST_S = 0.25
"""Shortest time within `REST_COUNTS` that proves rest of a shaft without a profile of this daemon, seconds."""
REST_COUNTS = 5
"""Highest less lowest position of a shaft at rest: a closed loop hunts by some counts. More than 20 counts/s never pass
for rest."""
SLOW_SHARE, SLOW_COUNTS_PER_S = 3.0, 200.0
"""Below this share of the resolution of its velocity, and this speed, a shaft may stand at once."""
MOST_REST_S = 2.0
"""A shaft that crept out of that band must stay in it for twice as long as it took, at most this."""
LEAST_WINDOW_COUNTS = 5.0
"""A closed loop hunts by some counts."""
WINDOW_OF_EL = 1 / 400
"""Settle window as a fraction of the position error limit: that is some hundred times the error at rest."""


class Comparison(Enum):
    """What readings have shown of a shaft, as soon as they have; before that a value says what is awaited."""

    AS_TOLD = auto()
    """It does, or did, what its drive was told, or what its friction makes of it."""
    NOT_AS_TOLD = auto()
    """It does not: the drive has not heard, or the encoder does not count."""


@dataclass(frozen=True, slots=True)
class RestEvidence:
    """What readings prove of the rest of a shaft.

    The velocity of a status packet has no fraction, and a drive in velocity mode says that its profile is done as soon
    as the velocity is reached: a shaft that creeps below one count per tick shows velocity 0 and a finished profile. So
    one reading proves rest only of a closed loop whose profile this daemon commanded and ends by itself, in which done
    means at rest; of any other it takes positions.

    Attributes:
        rests: whether it does; None while that is not known.
        turns: the latest reading shows a velocity.
        commanded: the drive's profile is one of this daemon's, and ends by itself.
        since_s: from when on positions have stayed together, in loop time; None while they have not.
        low: lowest of these positions, counts.
        high: highest of them.
        quiet_s: for how long they must.
        unseen_s: for how long at least with the motor off, because the shaft may turn unseen; 0 once its encoder has
            counted with the motor off, and for a motion of this daemon.
        left_turning: it turned when it was read last, or an earlier daemon has left it so.
        at_once: a motion of this daemon was ended at once, at a speed from which the shaft cannot stand at once: it
            was not seen to become slow since.
    """

    rests: bool | None = None
    turns: bool = False
    commanded: bool = False
    since_s: float | None = None
    low: int = 0
    high: int = 0
    quiet_s: float = REST_S
    unseen_s: float = 0.0
    left_turning: bool = False
    at_once: bool = False

    @property
    def is_done_at_rest(self) -> bool:
        """Whether a closed loop rests as soon as its drive says that its profile is done."""
        return self.commanded and not self.at_once

    def observe(self, reading: AxisReading, at_s: float) -> "RestEvidence":
        """Return the evidence with a reading that was requested at an instant, in loop time."""
        position = reading.position_counts
        runs = reading.enabled and not reading.profile_done and not self.at_once
        # `shows_velocity`, written out: every poll passes here
        if runs or abs(reading.velocity_counts_per_s) > reading.velocity_resolution_counts_per_s:
            if self.rests is False and self.turns and self.since_s is None and self.quiet_s == REST_S:
                return self
            if self.at_once and is_fast(abs(reading.velocity_counts_per_s), reading.velocity_resolution_counts_per_s):
                return replace(self, rests=False, turns=True, since_s=at_s, low=position, high=position)
            return RestEvidence(rests=False, turns=True, commanded=self.commanded, unseen_s=self._unseen_s(reading))
        if self.commanded and reading.enabled and not self.at_once:  # `is_done_at_rest`, written out
            return self if self.rests else replace(self, rests=True)
        if self.since_s is None:
            return replace(self, turns=False, since_s=at_s, low=position, high=position)
        low, high, held_s = min(self.low, position), max(self.high, position), at_s - self.since_s
        if high - low > REST_COUNTS:
            quiet_s = min(max(2 * held_s, REST_S), MOST_REST_S)
            return replace(
                self,
                rests=False,
                quiet_s=quiet_s,
                unseen_s=self._unseen_s(reading),
                at_once=False,
                since_s=at_s,
                low=position,
                high=position,
            )
        least_s = self.quiet_s if reading.enabled else max(self.quiet_s, self.unseen_s)
        rests = True if held_s >= least_s else self.rests
        if rests is self.rests and low == self.low and high == self.high:
            return self
        return replace(self, rests=rests, low=low, high=high)

    def let_go(self) -> "RestEvidence":
        """Return it for a shaft whose loop has opened: that it has not counted under voltage says nothing of it."""
        return replace(self, rests=None if self.rests else self.rests, since_s=None)

    def doubted(self, unseen_s: float) -> "RestEvidence":
        """Return it for a shaft whose encoder is not believed: it is at rest once it has not counted for a time."""
        return replace(self, rests=None if self.rests else self.rests, unseen_s=unseen_s)

    def _unseen_s(self, reading: AxisReading) -> float:
        # of a motor that others have set in motion nothing tells how it is to slow down: its encoder may cease in that
        return self.unseen_s if reading.enabled and not self.commanded else 0.0


NOTHING_SEEN = RestEvidence()
"""Of a drive that was out of reach, or that was not read since something was commanded."""


def is_fast(speed_counts_per_s: float, resolution_counts_per_s: float) -> bool:
    """Tell whether a shaft of such a speed is too fast to stand at once."""
    return speed_counts_per_s >= SLOW_SHARE * resolution_counts_per_s + SLOW_COUNTS_PER_S


def shows_velocity(reading: AxisReading) -> bool:
    """Tell whether a reading shows a velocity that is not within the resolution of its drive."""
    return abs(reading.velocity_counts_per_s) > reading.velocity_resolution_counts_per_s


@dataclass(frozen=True, slots=True)
class Settling:
    """When a motion to a target has settled.

    Attributes:
        target_counts: where it ends.
        window_counts: how far from there the axis may be, in either direction.
        time_s: for how long it must have stayed within the window.
        timeout_s: longest time for that, from the end of the profile.
        faults: an axis that does not settle has a fault.
        lags_counts: how far its loop may lag, where its drive does not tell how far it does; infinite if not known.
    """

    target_counts: int
    window_counts: float
    time_s: float
    timeout_s: float
    faults: bool = False
    lags_counts: float = math.inf

    def ended_elsewhere(self, reading: AxisReading) -> bool:
        """Tell whether the profile has ended elsewhere than at its target: its drive holds the axis there.

        Args:
            reading: requested after the motion took effect.
        """
        return reading.ended_beside(self.target_counts, self.lags_counts, self.window_counts)


@dataclass(frozen=True, slots=True)
class SensorEnd:
    """Where a motion ends that a value of its analog sensor ends: its drive begins to stop there, and goes on a little.

    Attributes:
        target: value of the sensor, in counts of the A/D converter.
        begun_at: its value before the motion.
        within: how far before its target it counts as reached.
    """

    target: int
    begun_at: int
    within: int

    def is_reached(self, value: int) -> bool:
        """Tell whether a value is the target or lies beyond it."""
        forward = self.target >= self.begun_at
        ahead = self.target - value if forward else value - self.target
        return ahead <= self.within


@dataclass(frozen=True, slots=True)
class SettleProgress:
    """How far an axis has settled, from the end of its profile on.

    Attributes:
        until_s: when it must have settled, in loop time. An axis that the first reading after that shows within its
            window, and no reading before, gets the time to stay there: no reading shows when it came.
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
        late = at_s >= self.until_s and (inside_since_s is None or inside_since_s < self.until_s)
        return progress, False if late else None


def window_counts(config: AxisConfig) -> float:
    """Return how far from its target an axis may be that has settled, in counts."""
    if config.settle.window is not None:
        return config.settle.window * abs(config.signed_counts_per_unit)
    return max(LEAST_WINDOW_COUNTS, WINDOW_OF_EL * config.gains.el if config.gains else 0.0)
