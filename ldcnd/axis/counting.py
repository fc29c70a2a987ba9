"""Whether the encoder of a shaft counts, in a motion and while it coasts: one that is dead looks like rest. Pure."""

import math
from dataclasses import dataclass, replace

from ldcnd.axis.course import LAG_S
from ldcnd.axis.rest import REST_COUNTS, is_fast
from ldcnd.drives.driver import AxisReading

BRAKES_SHARE = 1.5
"""Most that a deceleration is taken for of what a profile has: shafts swing."""
FOLLOWS_WITHIN_S = 1.0
"""Longest time from the end of a profile until its shaft is seen to have moved, seconds."""
BEHIND_SHARE = 1.5
"""Most by which friction holds a shaft behind the end of its profile, as a multiple of its settle window."""
BREAKS_FREE_SHARE = 8.0
"""No shaft that coasts sticks while its profile goes on by as many times the part in which it must move."""
LAGS_S = 0.02
"""Shortest time over which a way is compared with its speed."""
CLOCK_SHARE = 1.1
"""Longest braking as a multiple of the computed one: a drive has a clock of its own, and rounds its profile."""
SWINGS_ABOVE, SWINGS_S = 1.5, 0.5
"""A shaft swings by less than half of its speed when it was this much faster at most, and has ceased to by then."""
RUNAWAY_SHARE = 4.0
"""Factor by which a shaft swings above its speed at most, even where it sticks and breaks free."""
LEAST_COAST_S = 0.01
"""Readings that follow each other sooner tell nothing of how a shaft slows down."""
COASTS_S = 0.3
"""Time after which it is known how a shaft slows down, seconds: just switched off, it may brake at first."""
SUDDEN_SHARE = 5.0
"""How much faster than before a shaft may slow down in the end: friction grows, up to the force that sticks."""


@dataclass(frozen=True, slots=True)
class Following:
    """Whether an encoder counts while the profile of its motion goes on: one that stands still looks like rest.

    So does a jam: in both a closed loop pushes a shaft that does not go where it was sent. What tells it is not how far
    it lags, which is the drive's to limit, but that a part of a profile has left it where it was, to a few counts.

    Attributes:
        command_id: of the motion.
        velocity_counts_per_s: of the profile.
        acceleration_counts_per_s2: of the profile; the least of those that went over into each other.
        braking_counts_per_s2: the most of those.
        way_counts: of the whole profile; infinite for one without an end.
        least_counts: part of a profile in which a shaft must have been seen to begin to move, and once it has, twice
            as much in which it must have been seen to go on.
        window_counts: how far from its place a shaft may be that has settled.
        since_s: since when the shaft is where it is, in loop time; before it was seen to move, when the drive had the
            motion: its profile runs from then on, if not before.
        asked_s: when the drive was sent the motion: its profile has not begun before.
        low: lowest position since; before it was seen to move, since the reading before its motion.
        high: highest.
        counted: the shaft was seen to move.
        speed_counts_per_s: that it was seen to have when it was first seen there: it goes on for a braking distance.
        error_counts: following error when it was first seen there, or before; None where its drive does not tell.
        gone_counts: the least way that the profile has gone since, or goes; or has in an earlier motion of the command.
        until_s: when the shaft must have been seen to move again; infinite while the profile runs.
        given_up: it was not seen in time.
        faults: it is a fault then; else the axis may only move unseen, until its encoder counts again.
        coasts: the shaft cannot stand at once: where it seems to, at a speed, its encoder has missed counts.
        least_counts_per_s: that the positions have shown when it was first seen there, if it braked meanwhile.
        fastest_counts_per_s: of the profiles that went over into this one; 0 without one.
        there_until_s: the latest instant at which it can have been where it was first seen, in loop time.
        swings_until_s: until when it may be slowed down, and swing to a stand at its new speed, in loop time.
        held_counts: how far behind its end friction may hold a shaft.
        settled: its drive has told that the shaft stands where its profile has ended, and it has not moved since.
    """

    command_id: str
    velocity_counts_per_s: float
    acceleration_counts_per_s2: float
    braking_counts_per_s2: float
    way_counts: float
    least_counts: float
    window_counts: float
    since_s: float
    asked_s: float
    low: float
    high: float
    counted: bool = False
    speed_counts_per_s: float = 0.0
    error_counts: int | None = None
    gone_counts: float = 0.0
    until_s: float = math.inf
    given_up: bool = False
    faults: bool = True
    coasts: bool = False
    least_counts_per_s: float = 0.0
    fastest_counts_per_s: float = 0.0
    there_until_s: float = 0.0
    swings_until_s: float = -math.inf
    held_counts: float = math.inf
    settled: bool = False

    @property
    def is_missed(self) -> bool:
        """Whether a part of the profile is over in which the shaft was to move, and was not seen to."""
        return self.until_s < math.inf

    @property
    def is_long(self) -> bool:
        """Whether a shaft that follows it is seen to move."""
        return self.way_counts >= 2 * self.least_counts

    @property
    def is_unseen(self) -> bool:
        """Whether a part of the profile has gone, or is over, in which the shaft was not seen to move."""
        coming = self.speed_counts_per_s**2 / (4 * self.braking_counts_per_s2)
        return self.is_missed or self.gone_counts >= 2 * self.least_counts + coming

    @property
    def brakes_within_s(self) -> float:
        """Longest time from the beginning of its braking until its end, seconds, also by the clock of its drive."""
        fastest = max(self.fastest_counts_per_s, self.velocity_counts_per_s)
        return CLOCK_SHARE * fastest / self.acceleration_counts_per_s2 + 2 * LAG_S

    def after(self, before: "Following | None") -> "Following":
        """Return it behind an earlier motion of its command, in which the shaft was perhaps not seen to move."""
        if before is None or before.command_id != self.command_id or before.counted:
            return self
        return replace(self, gone_counts=before.gone_counts, low=before.low, high=before.high)

    def going_on(
        self, velocity_counts_per_s: float, acceleration_counts_per_s2: float, *, reverses: bool = False
    ) -> "Following":
        """Return it for a profile that goes over into another one, in the other direction if it reverses."""
        slowest, fastest = sorted((self.velocity_counts_per_s, velocity_counts_per_s))
        fastest = max(fastest, self.fastest_counts_per_s)
        rate = min(self.acceleration_counts_per_s2, acceleration_counts_per_s2)
        swings_s = self.since_s + CLOCK_SHARE * (fastest + slowest) / rate + SWINGS_S
        return replace(
            self,
            velocity_counts_per_s=slowest,
            acceleration_counts_per_s2=rate,
            braking_counts_per_s2=max(self.braking_counts_per_s2, acceleration_counts_per_s2),
            fastest_counts_per_s=fastest,
            swings_until_s=max(
                self.swings_until_s, swings_s if reverses or fastest > SWINGS_ABOVE * slowest else -math.inf
            ),
        )

    def let_go(self, *, at_velocity: bool) -> "Coast | None":
        """Return how the shaft coasts once its loop has opened; None if it was not seen to turn.

        Args:
            at_velocity: the profile has kept its velocity, or gone up to it.
        """
        braking = 0.0 if at_velocity and self.coasts else self.speed_counts_per_s
        speed = max(self.least_counts_per_s, braking)
        if not speed:
            return None
        at_counts = round(self.low) if self.coasts else None
        braked = 0.0 if at_velocity else BRAKES_SHARE * self.braking_counts_per_s2
        return Coast(self.since_s, speed, self.since_s, speed, 0.0, at_counts, self.there_until_s, braked)

    def observe(
        self, reading: AxisReading, at_s: float, true_until_s: float = 0.0, *, at_velocity: bool = False
    ) -> "Following | bool":
        """Take a reading; return what is awaited, True while the shaft has moved as it was to, or False: it has not.

        Args:
            reading: what the drive shows.
            at_s: when it was requested, in loop time.
            true_until_s: the latest instant at which it can have been true.
            at_velocity: the profile keeps its velocity, or goes up to it: it ends by another command only.
        """
        position, error = reading.position_counts, reading.following_error_counts
        low, high = min(self.low, position), max(self.high, position)
        runs = reading.enabled and not reading.profile_done
        by_s = max(at_s, true_until_s)
        if runs and self._has_missed_counts(reading, at_s, by_s, brakes=not at_velocity):
            return False
        if high - low > REST_COUNTS:
            seen = self._seen_to_move(reading, at_s, by_s, runs=runs, brakes=not at_velocity)
            return replace(seen, there_until_s=true_until_s) if self.coasts else seen
        gone = max(self.gone_counts, self._gone_counts(at_s) if runs else 0.0)
        first = error if self.error_counts is None else self.error_counts
        if first is not None and error is not None:
            gone = max(gone, abs(error) - abs(first))
        until_s, given_up, behind = math.inf, False, False
        if not reading.enabled:  # nothing pushes a shaft any more that has never moved; another may stop at once
            return self.counted or gone < self.least_counts
        soon = 0 < (at_s - self.since_s) * self.speed_counts_per_s < 4 * REST_COUNTS  # it had no time to go on
        if runs:
            lag = 0 if first is None or error is None else abs(error) - abs(first)
            free = self.coasts and max(self._gone_counts(at_s), lag) >= BREAKS_FREE_SHARE * self.least_counts
            sticks_s = 0.0 if free else FOLLOWS_WITHIN_S
            if self.faults and self.is_unseen and at_s - self.since_s >= sticks_s:
                return False
        elif not soon:
            until_s = min(self.until_s, at_s + FOLLOWS_WITHIN_S)
            # a drive tells it in each second reading
            untold = error is None and self.error_counts is not None and not self.settled
            # the loop of a shaft that is to stand where its profile has ended pulls it there, or it sticks
            told = self.coasts and self.held_counts < math.inf
            behind = told and (untold or abs(error or 0) > self.held_counts)
            short = gone < self.least_counts * (2 if self.counted else 1)
            if short and not behind:
                return True
            given_up = at_s >= until_s and not (short and untold)
            if given_up and self.faults:
                return False
            if given_up is self.given_up and self.is_missed:
                return self
        return replace(
            self,
            error_counts=first,
            gone_counts=gone,
            until_s=until_s,
            given_up=given_up,
            low=low,
            high=high,
            settled=self.settled and not behind,
        )

    def _has_missed_counts(self, reading: AxisReading, at_s: float, by_s: float, *, brakes: bool) -> bool:
        """Tell whether the encoder of a shaft that cannot stand at once has ceased to count, if only for a while."""
        position = reading.position_counts
        if self._runs_away(reading, by_s):
            return True
        if at_s < self.swings_until_s:
            return False
        if max(self.high, position) - min(self.low, position) > REST_COUNTS:
            return self._lags(position, at_s, by_s, brakes=brakes)
        return self._stands_at_once(at_s, by_s, brakes=brakes)

    def _runs_away(self, reading: AxisReading, by_s: float) -> bool:
        """Tell whether a shaft is too fast for its profiles: its loop makes up for counts that were missed."""
        fastest = self.velocity_counts_per_s
        if not self.counted:
            fastest = min(fastest, self.acceleration_counts_per_s2 * (by_s - self.asked_s))
        fastest = max(self.fastest_counts_per_s, fastest)
        most = RUNAWAY_SHARE * (fastest + reading.velocity_resolution_counts_per_s)
        return self.coasts and abs(reading.velocity_counts_per_s) > most

    def _stands_at_once(self, at_s: float, by_s: float, *, brakes: bool) -> bool:
        """Tell whether a shaft that cannot has come to stand: its profile has left it behind since it was seen here."""
        if not (self.coasts and self.counted):
            return False
        stood_s, least = self._since_then_s(at_s), self._least_counts_per_s(by_s, brakes=brakes)
        if not brakes:  # on average, and half of what the profile gets faster
            least += self.acceleration_counts_per_s2 * stood_s / 4
        return min(least, self.velocity_counts_per_s) * stood_s >= 2 * self.least_counts

    def _lags(self, position: int, at_s: float, by_s: float, *, brakes: bool) -> bool:
        """Tell whether a shaft that cannot slow down at once has gone less than half of its least way since."""
        took_s = self._since_then_s(at_s)
        if not (self.coasts and self.counted) or took_s < LAGS_S:
            return False
        least = min(self._least_counts_per_s(by_s, brakes=brakes), self.velocity_counts_per_s) * took_s
        return 2 * (abs(position - self.low) + 2 * self.least_counts) < least

    def _since_then_s(self, at_s: float) -> float:
        """Return for how long at least the shaft was seen where it is: a request may go later than its time stamp."""
        return at_s - max(self.since_s, self.there_until_s)

    def _seen_to_move(self, reading: AxisReading, at_s: float, by_s: float, *, runs: bool, brakes: bool) -> "Following":
        speed = max(0.0, abs(reading.velocity_counts_per_s) - reading.velocity_resolution_counts_per_s)
        if runs:  # it may have ceased to count since
            speed = max(speed, self.speed_counts_per_s - self._braked_counts_per_s(by_s))
        error, least = reading.following_error_counts, 0.0
        if self.coasts and self.counted:
            # positions are exact, where the velocity of a status packet is coarse; a new origin makes them jump
            shown = abs(reading.position_counts - self.low) / (at_s - self.since_s) if at_s > self.since_s else 0.0
            most = abs(reading.velocity_counts_per_s) + reading.velocity_resolution_counts_per_s
            braked = self._braked_counts_per_s(by_s) if brakes else 0.0
            least = max(0.0, min(shown, most) - braked, self._least_counts_per_s(by_s, brakes=brakes))
            least = min(least, self.velocity_counts_per_s)  # it may be on its way to another profile
        return Following(
            self.command_id,
            self.velocity_counts_per_s,
            self.acceleration_counts_per_s2,
            self.braking_counts_per_s2,
            self.way_counts,
            self.least_counts,
            self.window_counts,
            at_s,
            self.asked_s,
            low=reading.position_counts,
            high=reading.position_counts,
            counted=True,
            speed_counts_per_s=speed,
            error_counts=self.error_counts if error is None else error,
            gone_counts=speed**2 / (4 * self.braking_counts_per_s2),  # half of what it needs to brake
            faults=self.faults,
            coasts=self.coasts,
            least_counts_per_s=least,
            fastest_counts_per_s=self.fastest_counts_per_s,
            swings_until_s=self.swings_until_s,
            held_counts=self.held_counts,
        )

    def _least_counts_per_s(self, by_s: float, *, brakes: bool) -> float:
        return self.least_counts_per_s - (self._braked_counts_per_s(by_s) if brakes else 0.0)

    def _braked_counts_per_s(self, by_s: float) -> float:
        """Return by how much a profile makes the shaft slower at most since it is where it is."""
        return BRAKES_SHARE * self.braking_counts_per_s2 * (by_s - self.since_s)

    def _gone_counts(self, at_s: float) -> float:
        """Return the least way of a profile that runs since the shaft is where it is."""
        ran_s, speed, rate = max(0.0, at_s - self.since_s), self.velocity_counts_per_s, self.acceleration_counts_per_s2
        ramp_s = speed / rate
        if not self.counted:  # from its beginning
            way = rate * ran_s**2 / 2 if ran_s < ramp_s else speed * (ran_s - ramp_s / 2)
            return min(way, self.way_counts / 2)  # behind its middle it brakes
        # anywhere in it: slowest where it begins and ends meanwhile
        return rate * ran_s**2 / 4 if ran_s < 2 * ramp_s else speed * (ran_s - ramp_s)


@dataclass(frozen=True, slots=True)
class Coast:
    """How a shaft slows down that cannot stand at once: an encoder that ceases to count looks like rest.

    So does a brake that closes, or a crash; which of them it was only a look at the machine tells. It is kept of every
    shaft that turns with its motor off, and in motions of one with `coast_s` and a limit of its acceleration: whatever
    opens the loop then, its speed of before is known.

    Attributes:
        since_s: since when it coasts, in loop time.
        from_counts_per_s: speed that it had then.
        at_s: when the shaft was read last.
        speed_counts_per_s: the least speed that it can have had then.
        resolution_counts_per_s: of the velocity that its drive shows.
        at_counts: where it was then; None where that is not known.
        until_s: the latest instant at which it can have been there, in loop time.
        braked_counts_per_s2: how fast its loop has slowed it down at most, which has opened since.
        shown_counts_per_s: velocity that its drive has shown then.
    """

    since_s: float
    from_counts_per_s: float
    at_s: float
    speed_counts_per_s: float
    resolution_counts_per_s: float = 0.0
    at_counts: int | None = None
    until_s: float = 0.0
    braked_counts_per_s2: float = 0.0
    shown_counts_per_s: float = 0.0

    @classmethod
    def of(cls, reading: AxisReading, at_s: float, true_until_s: float) -> "Coast | None":
        """Return it of a shaft in a motion, or that a reading shows to turn; None of another."""
        speed, step = abs(reading.velocity_counts_per_s), reading.velocity_resolution_counts_per_s
        if speed <= step and not reading.enabled:
            return None
        # under voltage it may have broken free a moment ago: the next reading tells its speed
        known = 0.0 if reading.enabled else speed
        at_counts = reading.position_counts
        return cls(at_s, known, at_s, known, step, at_counts, true_until_s, shown_counts_per_s=speed)

    @property
    def is_fast(self) -> bool:
        """Whether it is too fast to stand at once."""
        return is_fast(self.speed_counts_per_s, self.resolution_counts_per_s)

    def observe(
        self, reading: AxisReading, at_s: float, true_until_s: float, most_counts_per_s2: float | None = None
    ) -> "Coast | bool":
        """Take a reading; return how it goes on, True once the shaft stands, or False: it stands all too suddenly.

        Args:
            reading: of the shaft.
            at_s: when it was requested, in loop time.
            true_until_s: the latest instant at which it can have been true.
            most_counts_per_s2: how fast it slows down at most; None where that is not known.
        """
        if at_s - max(self.at_s, self.until_s) < LEAST_COAST_S:
            return self
        if most_counts_per_s2 is not None and self.at_counts is not None:
            way_counts = abs(reading.position_counts - self.at_counts)
            fastest = max(most_counts_per_s2, self.braked_counts_per_s2)
            return self._observe_way(reading, at_s, true_until_s, fastest, way_counts)
        took_s, speed = at_s - self.at_s, abs(reading.velocity_counts_per_s)
        step = reading.velocity_resolution_counts_per_s
        if speed > step:
            since_s, at_counts = self.since_s, reading.position_counts
            return Coast(since_s, self.from_counts_per_s, at_s, speed, step, at_counts, true_until_s)
        coasted_s, most = self.at_s - self.since_s, most_counts_per_s2
        if not is_fast(self.speed_counts_per_s, step):
            return True
        if most is None and coasted_s < COASTS_S:
            return True
        if most is None:
            slowing = (max(0.0, self.from_counts_per_s - self.speed_counts_per_s) + step) / coasted_s
            most = SUDDEN_SHARE * slowing
        return most * took_s > self.speed_counts_per_s / 2

    def _observe_way(
        self, reading: AxisReading, at_s: float, true_until_s: float, most: float, way_counts: int
    ) -> "Coast | bool":
        """Compare its way, which is exact, and its velocity, which is coarse, with the least that they can be."""
        took_s, speed = at_s - max(self.at_s, self.until_s), self.speed_counts_per_s
        braking_s = min(took_s, speed / most)
        if 2 * (way_counts + 4 * REST_COUNTS) < braking_s * (speed - most * braking_s / 2):
            return False
        longest_s = max(at_s, true_until_s) - self.at_s
        least = max(0.0, speed - most * longest_s)
        shown, step = abs(reading.velocity_counts_per_s), reading.velocity_resolution_counts_per_s
        if 2 * shown < least and is_fast(least, step):
            return False
        if reading.enabled and shown > self.shown_counts_per_s + RUNAWAY_SHARE * most * longest_s + 2 * step:
            return False  # its loop makes up for counts that were missed
        if way_counts <= REST_COUNTS and shown <= step:
            return True
        # from its mean speed; where the counter is set its positions jump
        least = max(least, min(way_counts / longest_s - most * longest_s / 2, shown + step))
        at_counts = reading.position_counts
        return Coast(
            self.since_s,
            self.from_counts_per_s,
            at_s,
            least,
            step,
            at_counts,
            true_until_s,
            shown_counts_per_s=shown,
        )
