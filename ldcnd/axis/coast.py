"""How a shaft slows down while its loop is open: an encoder that ceases to count looks like rest. Pure."""

from dataclasses import dataclass

from ldcnd.axis.rest import REST_COUNTS, Comparison, is_fast
from ldcnd.drives.driver import AxisReading

RUNAWAY_SHARE = 4.0
"""Factor by which a shaft swings above its speed at most, even where it sticks and breaks free."""
LEAST_COAST_S = 0.01
"""Readings that follow each other sooner tell nothing of how a shaft slows down."""
COASTS_S = 0.3
"""Time after which it is known how a shaft slows down, seconds: just switched off, it may brake at first."""
SUDDEN_SHARE = 5.0
"""How much faster than before a shaft may slow down in the end: friction grows, up to the force that sticks."""


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
    ) -> "Coast | Comparison":
        """Take a reading; return how it goes on, or that the shaft stands: as it slowed down, or all too suddenly.

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
            return Comparison.AS_TOLD
        if most is None and coasted_s < COASTS_S:
            return Comparison.AS_TOLD
        if most is None:
            slowing = (max(0.0, self.from_counts_per_s - self.speed_counts_per_s) + step) / coasted_s
            most = SUDDEN_SHARE * slowing
        slowed = most * took_s > self.speed_counts_per_s / 2
        return Comparison.AS_TOLD if slowed else Comparison.NOT_AS_TOLD

    def _observe_way(
        self, reading: AxisReading, at_s: float, true_until_s: float, most: float, way_counts: int
    ) -> "Coast | Comparison":
        """Compare its way, which is exact, and its velocity, which is coarse, with the least that they can be."""
        took_s, speed = at_s - max(self.at_s, self.until_s), self.speed_counts_per_s
        braking_s = min(took_s, speed / most)
        if 2 * (way_counts + 4 * REST_COUNTS) < braking_s * (speed - most * braking_s / 2):
            return Comparison.NOT_AS_TOLD
        longest_s = max(at_s, true_until_s) - self.at_s
        least = max(0.0, speed - most * longest_s)
        shown, step = abs(reading.velocity_counts_per_s), reading.velocity_resolution_counts_per_s
        if 2 * shown < least and is_fast(least, step):
            return Comparison.NOT_AS_TOLD
        if reading.enabled and shown > self.shown_counts_per_s + RUNAWAY_SHARE * most * longest_s + 2 * step:
            return Comparison.NOT_AS_TOLD  # its loop makes up for counts that were missed
        if way_counts <= REST_COUNTS and shown <= step:
            return Comparison.AS_TOLD
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
