"""Whether a shaft does what its drive was told: moves, brakes, goes to its target, is as slow as it should be. Pure.

A reply has no number: one that comes late to something older can pass for the acknowledgement of a packet that was
lost. So what a drive has acknowledged is believed once readings show it.
"""

import math
from dataclasses import dataclass, replace

from ldcnd.axis.rest import REST_COUNTS, REST_S, Comparison, Settling
from ldcnd.drives.driver import AxisReading, StopMode

LAG_S = 0.1
"""A shaft that brakes follows its profile by less than this: no loop in use is softer."""
ROOM_COUNTS = 50
"""Room for a shaft that swings when its profile has ended."""
ROOM_SHARE = 1.25
"""Most that a braking distance may be of what velocity and deceleration make it."""
UNKNOWN_BRAKING_S = 1.0
"""A shaft whose deceleration is not known is given as long at its velocity, seconds."""
AGAIN_S = 0.25
"""A motor that may be driven with its loop open is switched off again after this time while it turns, seconds."""
PACE_S = 0.2
"""A speed is measured over this time: positions are exact, and the velocity of a status packet is coarse."""
PACE_SHARE = 1.1
"""Most that it may be of what was asked for."""


@dataclass(frozen=True, slots=True)
class Braking:
    """A stop that a drive has confirmed, and that readings have not shown yet.

    It is over when the shaft is seen to rest, and was not heard by a drive whose shaft goes farther than it needs for
    braking, or whose loop is still closed after it was switched off.

    Attributes:
        mode: how.
        acknowledged_at_s: when, in loop time.
        deceleration_counts_per_s2: that the drive holds for it; None while it is not known.
        from_counts: where the first reading after it has found the shaft; None before that.
        room_counts: how far from there it may go.
        still_counts: the place by which it stands, if it does.
        still_since_s: since when, in loop time.
    """

    mode: StopMode
    acknowledged_at_s: float
    deceleration_counts_per_s2: float | None = None
    from_counts: int | None = None
    room_counts: float = math.inf
    still_counts: int = 0
    still_since_s: float = math.inf

    def observe(self, reading: AxisReading, at_s: float, *, driven_open: bool = False) -> "Braking | Comparison":
        """Take a reading; return what is still awaited, or that the stop is seen, or was not heard.

        Args:
            reading: what the drive shows.
            at_s: when it was requested, in loop time.
            driven_open: the motor may have voltage with its loop open, which no flag shows: a stop that holds closes
                the loop, and of one that switches off only a shaft at rest shows that it was heard.
        """
        # it was asked for before the drive had the stop
        if at_s < self.acknowledged_at_s:
            return self
        if driven_open and not reading.enabled:
            is_off = self.mode is StopMode.OFF
            return self._observe_open(reading.position_counts, at_s) if is_off else Comparison.NOT_AS_TOLD
        if self.mode is StopMode.OFF or not reading.enabled:
            return Comparison.NOT_AS_TOLD if reading.enabled else Comparison.AS_TOLD
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
            return Comparison.NOT_AS_TOLD
        if abs(position - self.still_counts) > REST_COUNTS:
            return replace(self, still_counts=position, still_since_s=at_s)
        return Comparison.AS_TOLD if at_s - self.still_since_s >= REST_S else self

    def _observe_open(self, position: int, at_s: float) -> "Braking | Comparison":
        if abs(position - self.still_counts) > REST_COUNTS or math.isinf(self.still_since_s):
            if at_s - self.acknowledged_at_s >= AGAIN_S:  # it turns on
                return Comparison.NOT_AS_TOLD
            return replace(self, still_counts=position, still_since_s=at_s)
        return Comparison.AS_TOLD if at_s - self.still_since_s >= REST_S else self

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
class Way:
    """Where a shaft may be that goes to a target: between it and where it was, and not far beside.

    A drive that holds another target than the one that it was told goes where nobody has sent it, without a fault of
    its own.

    Attributes:
        target_counts: the farthest end of the motion. A lower speed in mid-motion may end it sooner, and a higher one
            later lead there again, so this stays.
        stray_counts: how far beside a shaft may be: beyond the position error limit its drive would have switched it
            off if the way was its own.
        deceleration_counts_per_s2: of the profile.
        low: lowest position, counts; None before the first reading of the motion.
        high: highest.
    """

    target_counts: int
    stray_counts: float
    deceleration_counts_per_s2: float
    low: float | None = None
    high: float = 0.0

    def observe(self, reading: AxisReading) -> "Way | Comparison":
        """Take a reading of the motion; return the way with its ends, or whether the shaft is on it."""
        here, target = reading.position_counts, self.target_counts
        if self.low is not None:
            return Comparison.AS_TOLD if self.low <= here <= self.high else Comparison.NOT_AS_TOLD
        # a motion that follows another one may have to turn round
        room = self.stray_counts + room_to_rest(reading, self.deceleration_counts_per_s2)
        return replace(self, low=min(here, target) - room, high=max(here, target) + room)


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast a shaft may be from an instant on, after the motion under way was given another speed or target.

    A drive that has not heard of it goes on as before, at a speed from which a person has just turned it down.

    Attributes:
        most_counts_per_s: that it was told.
        from_s: when it has slowed down from what it had, in loop time.
        at_counts: where it was then; None before a reading shows it.
        at_s: when that was requested.
        until_s: the latest instant at which it can have been true.
    """

    most_counts_per_s: float
    from_s: float
    at_counts: int | None = None
    at_s: float = math.inf
    until_s: float = math.inf

    def observe(self, reading: AxisReading, at_s: float, true_until_s: float) -> "Pace | Comparison":
        """Take a reading; return what is still to be seen, or whether the shaft is as slow as it was told.

        Args:
            reading: what the drive shows.
            at_s: when it was requested, in loop time.
            true_until_s: the latest instant at which it can have been true.
        """
        if at_s < self.from_s:
            return self
        if self.at_counts is None:
            return replace(self, at_counts=reading.position_counts, at_s=at_s, until_s=max(at_s, true_until_s))
        # a request may have waited behind its instant, on a machine that stood still
        shortest_s, longest_s = at_s - self.until_s, max(at_s, true_until_s) - self.at_s
        if shortest_s < PACE_S:
            return self
        way = abs(reading.position_counts - self.at_counts) - ROOM_COUNTS
        if way <= PACE_SHARE * self.most_counts_per_s * shortest_s:
            return Comparison.AS_TOLD
        return Comparison.NOT_AS_TOLD if way > PACE_SHARE * self.most_counts_per_s * longest_s else self


@dataclass(frozen=True, slots=True)
class ToldAnew:
    """What is not known of a motion whose drive was told another speed on its way: it may go on as before.

    Attributes:
        doubt: why its drive may not have heard; empty where it has acknowledged it, as a late reply can seem to.
        former_counts: where the motion ends then; empty where that is the same place.
    """

    doubt: str = ""
    former_counts: tuple[int, ...] = ()

    @property
    def leaves_end_open(self) -> bool:
        """Whether the motion is known to end at one of several places only."""
        return bool(self.doubt and self.former_counts)

    def after(self, before: "ToldAnew | None", former_counts: int, target_counts: int) -> "ToldAnew":
        """Return it of a motion that has another end by it.

        Args:
            before: an earlier change of the motion, of which its drive may not have heard either.
            former_counts: where the motion was to end by that, or from its beginning.
            target_counts: where it ends if its drive has heard.
        """
        earlier = before.former_counts if before and self.doubt else ()
        ends = dict.fromkeys((*earlier, former_counts))
        return replace(self, former_counts=tuple(end for end in ends if end != target_counts))

    def has_gone_on(self, settling: Settling, reading: AxisReading) -> bool:
        """Tell whether the motion has ended as it would have without the change."""
        ends = (replace(settling, target_counts=end) for end in self.former_counts)
        return reading.profile_done and any(not end.ended_elsewhere(reading) for end in ends)


def pace_of(most_counts_per_s: float, deceleration_counts_per_s2: float, reading: AxisReading, now_s: float) -> Pace:
    """Return how fast a shaft may be that has a speed and was told another one, both in either direction."""
    speed = abs(reading.velocity_counts_per_s) + reading.velocity_resolution_counts_per_s
    slowing_s = (speed + most_counts_per_s) / deceleration_counts_per_s2
    return Pace(most_counts_per_s, now_s + ROOM_SHARE * slowing_s + LAG_S)
