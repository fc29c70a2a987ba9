"""Whether an encoder counts while the profile of its motion goes on: one that stands still looks like rest. Pure.

The profile tells where the shaft is to go, the sighting where it was seen last; what lies between them is compared with
what friction, gains and the time of a reading allow.
"""

import math
from dataclasses import dataclass, replace

from ldcnd.axis.coast import RUNAWAY_SHARE, Coast
from ldcnd.axis.course import LAG_S
from ldcnd.axis.rest import REST_COUNTS, Comparison
from ldcnd.drives.driver import AxisReading

BRAKES_SHARE = 1.5
"""Most that a deceleration is taken for of what a profile has: shafts swing."""
FOLLOWS_WITHIN_S = 1.0
"""Longest time from the end of a profile until its shaft is seen to have moved, seconds."""
BREAKS_FREE_SHARE = 8.0
"""No shaft that coasts sticks while its profile goes on by as many times the part in which it must move."""
LAGS_S = 0.02
"""Shortest time over which a way is compared with its speed."""
CLOCK_SHARE = 1.1
"""Longest braking as a multiple of the computed one: a drive has a clock of its own, and rounds its profile."""
OUTRUNS_SHARE = 2.0
"""Factor by which a shaft that lags no more than friction holds one swings above the speed of its profile at most."""
PULLS_PER_S = 60.0
"""A loop pulls a shaft that breaks free over its lag within this share of a second: it swings ten times a second."""
OUTPUT_SCALE = 256
"""Of the servo filter: counts times gain for one step of PWM."""
PUSHES_S = 0.1
"""Shortest time for which a shaft must have stood that its loop pushes: it needs a moment to get going."""
SWINGS_ABOVE, SWINGS_S = 1.5, 0.5
"""A shaft swings by less than half of its speed when it was this much faster at most, and has ceased to by then."""


@dataclass(frozen=True, slots=True)
class RunningProfile:
    """What a drive makes a shaft do: one profile, or several that went over into each other.

    Attributes:
        velocity_counts_per_s: the least of them.
        acceleration_counts_per_s2: the least of them.
        braking_counts_per_s2: the most of their accelerations.
        way_counts: of the whole; infinite for one without an end.
        asked_s: when the drive was sent the motion, in loop time: the profile has not begun before.
        fastest_counts_per_s: the most of their velocities; 0 where it is one profile.
        swings_until_s: until when the shaft may be slowed down, and swing to a stand at its new speed, in loop time.
    """

    velocity_counts_per_s: float
    acceleration_counts_per_s2: float
    braking_counts_per_s2: float
    way_counts: float
    asked_s: float
    fastest_counts_per_s: float = 0.0
    swings_until_s: float = -math.inf

    @property
    def brakes_within_s(self) -> float:
        """Longest time from the beginning of its braking until its end, seconds, also by the clock of its drive."""
        fastest = max(self.fastest_counts_per_s, self.velocity_counts_per_s)
        return CLOCK_SHARE * fastest / self.acceleration_counts_per_s2 + 2 * LAG_S

    def going_on(
        self, velocity_counts_per_s: float, acceleration_counts_per_s2: float, since_s: float, *, reverses: bool
    ) -> "RunningProfile":
        """Return it for one that goes over into another one, in the other direction if it reverses."""
        slowest, fastest = sorted((self.velocity_counts_per_s, velocity_counts_per_s))
        fastest = max(fastest, self.fastest_counts_per_s)
        rate = min(self.acceleration_counts_per_s2, acceleration_counts_per_s2)
        swings_until_s = self.swings_until_s
        if reverses or fastest > SWINGS_ABOVE * slowest:
            swings_until_s = max(swings_until_s, since_s + CLOCK_SHARE * (fastest + slowest) / rate + SWINGS_S)
        braking = max(self.braking_counts_per_s2, acceleration_counts_per_s2)
        return RunningProfile(slowest, rate, braking, self.way_counts, self.asked_s, fastest, swings_until_s)

    def braked_counts_per_s(self, for_s: float) -> float:
        """Return by how much it makes a shaft slower at most in a time."""
        return BRAKES_SHARE * self.braking_counts_per_s2 * for_s

    def most_way_counts(self, for_s: float) -> float:
        """Return the most way that it goes in a time."""
        return CLOCK_SHARE * max(self.fastest_counts_per_s, self.velocity_counts_per_s) * for_s

    def least_way_counts(self, for_s: float, *, from_its_beginning: bool) -> float:
        """Return the least way that it goes in a time, from its beginning or anywhere in it."""
        ran_s, speed, rate = max(0.0, for_s), self.velocity_counts_per_s, self.acceleration_counts_per_s2
        ramp_s = speed / rate
        if from_its_beginning:
            way = rate * ran_s**2 / 2 if ran_s < ramp_s else speed * (ran_s - ramp_s / 2)
            return min(way, self.way_counts / 2)  # behind its middle it brakes
        # slowest where it begins and ends meanwhile
        return rate * ran_s**2 / 4 if ran_s < 2 * ramp_s else speed * (ran_s - ramp_s)


@dataclass(frozen=True, slots=True)
class Push:
    """How hard a loop pushes a shaft that stands behind its profile.

    "output = Kp*pos_error - ... + Ki*integral_error", and that "is the running sum of pos_error divided by 256"; the
    sum is bounded, and the duty is a 256th of the output, up to its limit (PIC-SERVO manual, 4.3).

    Attributes:
        kp: position gain.
        ki: integral gain.
        most_sum: bound of the running sum.
        half: of its output, as the filter counts, which no friction withstands; infinite where nothing tells.
        cycle_s: of the servo.
    """

    kp: int
    ki: int
    most_sum: float
    half: float
    cycle_s: float

    @property
    def held_counts(self) -> float:
        """How far from its place friction may hold a shaft: until half of its output is reached."""
        return self.half / self.kp if self.kp and math.isfinite(self.half) else 0.0

    def is_half(self, lag_counts: float, for_s: float) -> bool:
        """Tell whether half of its output has not moved a shaft that has come to lag so far in a time, in seconds."""
        # a lag that grows ever faster is a third of its end on average; the sum may begin with the other sign
        total = min(lag_counts * for_s / self.cycle_s / 3, self.most_sum) / 2
        return for_s >= PUSHES_S and self.kp * lag_counts + self.ki * total / OUTPUT_SCALE >= self.half


@dataclass(frozen=True, slots=True)
class Leeway:
    """What of an axis a shaft may be late or short by that follows its profile.

    Attributes:
        least_counts: part of a profile in which a shaft must have been seen to begin to move, and once it has, twice
            as much in which it must have been seen to go on.
        held_counts: how far behind the end of a profile friction may hold a shaft; infinite where nothing tells.
        sticks_counts: how far a profile may go on before friction lets the shaft go; infinite where what the axis meets
            may stop it.
        push: of its loop; None of a drive that does not tell its gains, and where what the axis meets may stop it.
        faults: what was not seen in time is a fault; else the axis may only move unseen, until its encoder counts.
        coasts: the shaft cannot stand at once: where it seems to, at a speed, its encoder has missed counts.
    """

    least_counts: float
    held_counts: float
    sticks_counts: float
    push: Push | None
    faults: bool
    coasts: bool

    @property
    def stalls(self) -> bool:
        """Whether what the axis meets may stop it."""
        return math.isinf(self.sticks_counts)


@dataclass(frozen=True, slots=True)
class Sighting:
    """Where a shaft was seen last to have moved to, and how fast.

    Attributes:
        since_s: since when the shaft is there, in loop time; before it was seen to move, when the drive acknowledged
            the motion, whose profile has begun by then.
        until_s: the latest instant at which it can have been there when it was first seen there, in loop time.
        low: lowest position since; before it was seen to move, since the reading before its motion.
        high: highest.
        counted: the shaft was seen to move.
        speed_counts_per_s: that it was seen to have then: it goes on for a braking distance.
        least_counts_per_s: that the positions have shown then, if it braked meanwhile.
        error_counts: following error then, or before; None where its drive does not tell.
    """

    since_s: float
    until_s: float
    low: float
    high: float
    counted: bool = False
    speed_counts_per_s: float = 0.0
    least_counts_per_s: float = 0.0
    error_counts: int | None = None

    def for_s(self, at_s: float) -> float:
        """Return for how long at least the shaft was there: a request may go later than its time stamp."""
        return at_s - max(self.since_s, self.until_s)


@dataclass(frozen=True, slots=True)
class Following:
    """Whether an encoder counts while the profile of its motion goes on: one that stands still looks like rest.

    So does a jam: in both a closed loop pushes a shaft that does not go where it was sent. What tells it is not how far
    it lags, which is the drive's to limit, but that a part of a profile has left it where it was, to a few counts.

    Attributes:
        command_id: of the motion.
        profile: of the motion.
        leeway: of the axis.
        seen: where the shaft was seen last.
        gone_counts: the least way that the profile has gone since, or goes; or has in an earlier motion of the command.
        until_s: when the shaft must have been seen to move again; infinite while the profile runs.
        given_up: it was not seen in time.
        settled: its drive has told that the shaft stands where its profile has ended, and it has not moved since.
    """

    command_id: str
    profile: RunningProfile
    leeway: Leeway
    seen: Sighting
    gone_counts: float = 0.0
    until_s: float = math.inf
    given_up: bool = False
    settled: bool = False

    @property
    def is_late(self) -> bool:
        """Whether the profile is over, and the shaft was not seen to move as it was to."""
        return self.until_s < math.inf

    @property
    def is_awaited(self) -> bool:
        """Whether the shaft is late, and may yet be seen to have moved in time: what it does is not known."""
        return self.until_s < math.inf and not self.given_up

    @property
    def is_long(self) -> bool:
        """Whether a shaft that follows it is seen to move."""
        return self.profile.way_counts >= 2 * self.leeway.least_counts

    @property
    def is_unseen(self) -> bool:
        """Whether a part of the profile has gone, or is over, in which the shaft was not seen to move."""
        return self.is_late or self.gone_counts >= 2 * self.leeway.least_counts + self._coming_counts

    def has_parted(self, at_s: float, short_counts: float | None = None) -> bool:
        """Tell whether the shaft has stood for longer than friction holds one: it jammed, or has gone on unseen.

        Args:
            at_s: of the latest reading, in loop time.
            short_counts: how far it stands from where its profile has ended; None of one that runs.
        """
        stood_s, behind = at_s - self.seen.since_s, self.gone_counts - self._coming_counts
        if short_counts is not None:  # a shaft that follows needs a moment to come there
            behind = short_counts if stood_s >= PUSHES_S else 0.0
        if math.isinf(behind):
            return False
        push, least = self.leeway.push, self.leeway.least_counts
        # it may have gone on by a few counts
        pushed = push is not None and behind >= least and push.is_half(behind - REST_COUNTS, stood_s)
        return pushed or behind >= self.leeway.sticks_counts

    def short_counts(self, reading: AxisReading, target_counts: int) -> float | None:
        """Return how far the shaft stands from where its profile has ended; None while its drive leaves that open."""
        off, error = abs(target_counts - reading.position_counts), reading.following_error_counts
        if error is not None:
            return min(off, abs(error))  # its drive may have ended it elsewhere
        return off if self.seen.error_counts is None else None

    def swings_past(self, reading: AxisReading, at_s: float, target_counts: int) -> bool:
        """Tell whether a shaft that stood behind the end of its profile goes as friction that lets go makes none go."""
        if self.leeway.stalls or at_s - self.seen.since_s < PUSHES_S:
            return False
        stood, off = target_counts - self.seen.low, target_counts - reading.position_counts
        swing = max(abs(stood), self.leeway.push.held_counts if self.leeway.push else 0.0) + self.leeway.least_counts
        most = OUTRUNS_SHARE * reading.velocity_resolution_counts_per_s + PULLS_PER_S * swing
        return (stood * off < 0 and abs(off) > swing) or abs(reading.velocity_counts_per_s) > most

    @property
    def _coming_counts(self) -> float:
        """How far a shaft that was seen to move goes before it stands, by half of its profile's braking."""
        return self.seen.speed_counts_per_s**2 / (4 * self.profile.braking_counts_per_s2)

    def outruns(self, reading: AxisReading) -> bool:
        """Tell whether a shaft is faster than its profile, and friction that lets go, make it: counts were missed."""
        fastest = max(self.profile.fastest_counts_per_s, self.profile.velocity_counts_per_s)
        most = OUTRUNS_SHARE * (fastest + reading.velocity_resolution_counts_per_s)
        return abs(reading.velocity_counts_per_s) > most + PULLS_PER_S * self.leeway.sticks_counts

    def doubted(self) -> "Following":
        """Return it for a shaft whose encoder has proved nothing: it is unseen until it has counted."""
        return replace(self, gone_counts=math.inf)

    def after(self, before: "Following | None") -> "Following":
        """Return it behind an earlier motion of its command, in which the shaft was perhaps not seen to move."""
        if before is None or before.command_id != self.command_id or before.seen.counted:
            return self
        seen = replace(self.seen, low=before.seen.low, high=before.seen.high)
        return replace(self, seen=seen, gone_counts=before.gone_counts)

    def going_on(
        self, velocity_counts_per_s: float, acceleration_counts_per_s2: float, *, reverses: bool = False
    ) -> "Following":
        """Return it for a profile that goes over into another one, in the other direction if it reverses."""
        profile = self.profile.going_on(
            velocity_counts_per_s, acceleration_counts_per_s2, self.seen.since_s, reverses=reverses
        )
        return replace(self, profile=profile)

    def let_go(self, *, at_velocity: bool) -> Coast | None:
        """Return how the shaft coasts once its loop has opened; None if it was not seen to turn.

        Args:
            at_velocity: the profile has kept its velocity, or gone up to it.
        """
        seen, coasts = self.seen, self.leeway.coasts
        braking = 0.0 if at_velocity and coasts else seen.speed_counts_per_s
        speed = max(seen.least_counts_per_s, braking)
        if not speed:
            return None
        at_counts = round(seen.low) if coasts else None
        braked = 0.0 if at_velocity else BRAKES_SHARE * self.profile.braking_counts_per_s2
        return Coast(seen.since_s, speed, seen.since_s, speed, 0.0, at_counts, seen.until_s, braked)

    def observe(
        self, reading: AxisReading, at_s: float, true_until_s: float = 0.0, *, at_velocity: bool = False
    ) -> "Following | Comparison":
        """Take a reading; return what is awaited, or whether the shaft has moved as it was to.

        Args:
            reading: what the drive shows.
            at_s: when it was requested, in loop time.
            true_until_s: the latest instant at which it can have been true.
            at_velocity: the profile keeps its velocity, or goes up to it: it ends by another command only.
        """
        seen, position = self.seen, reading.position_counts
        low, high = min(seen.low, position), max(seen.high, position)
        runs = reading.enabled and not reading.profile_done
        by_s = max(at_s, true_until_s)
        if runs and self._has_missed_counts(reading, at_s, by_s, brakes=not at_velocity):
            return Comparison.NOT_AS_TOLD
        if high - low > REST_COUNTS:
            until_s = true_until_s if self.leeway.coasts else 0.0
            return self._seen_to_move(reading, at_s, by_s, until_s, runs=runs, brakes=not at_velocity)
        if not reading.enabled:  # nothing pushes a shaft any more that has never moved; another may stop at once
            moved = seen.counted or self._gone_counts(reading, at_s, runs=runs) < self.leeway.least_counts
            return Comparison.AS_TOLD if moved else Comparison.NOT_AS_TOLD
        return self._stands(reading, at_s, replace(seen, low=low, high=high), runs=runs)

    def _stands(self, reading: AxisReading, at_s: float, seen: Sighting, *, runs: bool) -> "Following | Comparison":
        """Judge a shaft under voltage that stands where it was seen last: it sticks, is held, or turns unseen."""
        error, least = reading.following_error_counts, self.leeway.least_counts
        gone = self._gone_counts(reading, at_s, runs=runs)
        until_s, given_up, behind = math.inf, False, False
        if runs:
            lag = self._lag_counts(reading, at_s)
            free = self.leeway.coasts and max(self._went_counts(at_s), lag) >= BREAKS_FREE_SHARE * least
            sticks_s = 0.0 if free else FOLLOWS_WITHIN_S
            if self.leeway.faults and self.is_unseen and at_s - seen.since_s >= sticks_s:
                return Comparison.NOT_AS_TOLD
        elif not self._was_seen_just_now(at_s):
            until_s = min(self.until_s, at_s + FOLLOWS_WITHIN_S)
            # a drive tells it in each second reading
            untold = error is None and seen.error_counts is not None and not self.settled
            # the loop of a shaft that is to stand where its profile has ended pulls it there, or it sticks
            told = self.leeway.coasts and self.leeway.held_counts < math.inf
            behind = told and (untold or abs(error or 0) > self.leeway.held_counts)
            short = gone < least * (2 if seen.counted else 1)
            if short and not behind:
                return Comparison.AS_TOLD
            given_up = at_s >= until_s and not (short and untold)
            if given_up and self.leeway.faults:
                return Comparison.NOT_AS_TOLD
            if given_up is self.given_up and self.is_late:
                return self
        if seen.error_counts is None:
            seen = replace(seen, error_counts=error)
        settled = self.settled and not behind
        return Following(self.command_id, self.profile, self.leeway, seen, gone, until_s, given_up, settled)

    def _was_seen_just_now(self, at_s: float) -> bool:
        """Tell whether the shaft was seen to move so shortly before that standing here is no news.

        At its speed it would have gone on by less than twice what a loop at rest hunts in either direction.
        """
        went = (at_s - self.seen.since_s) * self.seen.speed_counts_per_s
        return 0 < went < 4 * REST_COUNTS

    def _gone_counts(self, reading: AxisReading, at_s: float, *, runs: bool) -> float:
        """Return the least way that the profile has gone while the shaft stood: by its time, and by its drive."""
        return max(self.gone_counts, self._went_counts(at_s) if runs else 0.0, self._lag_counts(reading, at_s))

    def _went_counts(self, at_s: float) -> float:
        """Return the least way of a profile that runs since the shaft is where it is."""
        seen = self.seen
        return self.profile.least_way_counts(at_s - seen.since_s, from_its_beginning=not seen.counted)

    def _lag_counts(self, reading: AxisReading, at_s: float) -> float:
        """Return by how much the shaft lags more than when it was seen there first; 0 where its drive does not tell."""
        first, error = self.seen.error_counts, reading.following_error_counts
        if first is None or error is None:
            return 0.0
        # an error that one reading shows may be false: no profile leaves a shaft farther behind than it goes itself
        return min(abs(error) - abs(first), self.profile.most_way_counts(at_s - self.seen.since_s))

    def _has_missed_counts(self, reading: AxisReading, at_s: float, by_s: float, *, brakes: bool) -> bool:
        """Tell whether the encoder of a shaft that cannot stand at once has ceased to count, if only for a while."""
        position = reading.position_counts
        if self._runs_away(reading, by_s):
            return True
        if at_s < self.profile.swings_until_s or not (self.leeway.coasts and self.seen.counted):
            return False
        if max(self.seen.high, position) - min(self.seen.low, position) > REST_COUNTS:
            return self._lags(position, at_s, by_s, brakes=brakes)
        return self._stands_at_once(at_s, by_s, brakes=brakes)

    def _runs_away(self, reading: AxisReading, by_s: float) -> bool:
        """Tell whether a shaft is too fast for its profiles: its loop makes up for counts that were missed."""
        profile = self.profile
        fastest = profile.velocity_counts_per_s
        if not self.seen.counted:
            fastest = min(fastest, profile.acceleration_counts_per_s2 * (by_s - profile.asked_s))
        fastest = max(profile.fastest_counts_per_s, fastest)
        most = RUNAWAY_SHARE * (fastest + reading.velocity_resolution_counts_per_s)
        return self.leeway.coasts and abs(reading.velocity_counts_per_s) > most

    def _stands_at_once(self, at_s: float, by_s: float, *, brakes: bool) -> bool:
        """Tell whether a shaft that cannot has come to stand: its profile has left it behind since it was seen here."""
        stood_s, least = self.seen.for_s(at_s), self._least_counts_per_s(by_s, brakes=brakes)
        if not brakes:  # on average, and half of what the profile gets faster
            least += self.profile.acceleration_counts_per_s2 * stood_s / 4
        return min(least, self.profile.velocity_counts_per_s) * stood_s >= 2 * self.leeway.least_counts

    def _lags(self, position: int, at_s: float, by_s: float, *, brakes: bool) -> bool:
        """Tell whether a shaft that cannot slow down at once has gone less than half of its least way since."""
        took_s = self.seen.for_s(at_s)
        if took_s < LAGS_S:
            return False
        least = min(self._least_counts_per_s(by_s, brakes=brakes), self.profile.velocity_counts_per_s) * took_s
        return 2 * (abs(position - self.seen.low) + 2 * self.leeway.least_counts) < least

    def _seen_to_move(
        self, reading: AxisReading, at_s: float, by_s: float, until_s: float, *, runs: bool, brakes: bool
    ) -> "Following":
        before, position = self.seen, reading.position_counts
        braked = self.profile.braked_counts_per_s(by_s - before.since_s)
        speed = max(0.0, abs(reading.velocity_counts_per_s) - reading.velocity_resolution_counts_per_s)
        if runs:  # it may have ceased to count since
            speed = max(speed, before.speed_counts_per_s - braked)
        error, least = reading.following_error_counts, 0.0
        if self.leeway.coasts and before.counted:
            # positions are exact, where the velocity of a status packet is coarse; a new origin makes them jump
            shown = abs(position - before.low) / (at_s - before.since_s) if at_s > before.since_s else 0.0
            most = abs(reading.velocity_counts_per_s) + reading.velocity_resolution_counts_per_s
            least = max(min(shown, most), before.least_counts_per_s) - (braked if brakes else 0.0)
            # it may be on its way to another profile
            least = min(max(0.0, least), self.profile.velocity_counts_per_s)
        error = before.error_counts if error is None else error
        seen = Sighting(
            at_s,
            until_s,
            position,
            position,
            counted=True,
            speed_counts_per_s=speed,
            least_counts_per_s=least,
            error_counts=error,
        )
        # half of what it needs to brake
        return Following(
            self.command_id, self.profile, self.leeway, seen, speed**2 / (4 * self.profile.braking_counts_per_s2)
        )

    def _least_counts_per_s(self, by_s: float, *, brakes: bool) -> float:
        """Return how fast the shaft is at least, seen there at a speed, unless it has ceased to count."""
        braked = self.profile.braked_counts_per_s(by_s - self.seen.since_s) if brakes else 0.0
        return self.seen.least_counts_per_s - braked
