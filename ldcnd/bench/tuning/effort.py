"""What a move has cost: the output that the drive's law must have given, against the motion that it has made.

Nothing is sent to the drive, and the commanded profile need not be known. The law works on the position error, which
drives report with each position; so the output between two samples follows from what is published. Over a move the
output has paid for three things: for the momentum of the motor and its load, for what goes with the speed (back EMF,
viscous friction), and for Coulomb friction. The second is known from the identified plant. The other two are fitted.

What the integral has gathered before the first sample is not published. It adds the same to every move; so does a
hanging load. Friction changes its sign with the direction, and is half of the difference of two moves that go
opposite ways.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from ldcnd.bench.tuning.plant import Plant
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.profiles import Profile

REST_S = 0.1
"""Shortest time without a change of position after which an axis is at rest, seconds."""
STOOD_SHARE = 0.7
"""Of that time, for an output that moves nothing."""
STILL_COUNTS = 1
STILL_SHARE = 0.005
"""It stays where it is as long as it moves by no more than this share of the way that it came, or `STILL_COUNTS`."""
LONGEST_S = 5.0
"""A motion is judged by no more than its first seconds."""
MOST_GAP_S = 0.1
"""Samples of a motion that are farther apart tell too little of what lies between them, seconds."""
FEWEST_SAMPLES = 12
"""While a motion lasts."""
LEAST_COUNTS = 100
"""Shorter motions are not judged: single counts would count too much."""
SLOW_SHARE = 0.1
"""Below this share of the top speed friction is not what it is in motion."""
SATURATED_SHARE = 0.1
"""A motion with the output at its limit for more than this share of its samples is not judged: what the output would
have been beyond the limit is in no equation."""
LOST_PWM = 0.5
"""The law drops fractions of a PWM step: half of one on average."""


@dataclass(frozen=True, slots=True)
class SeenPosition:
    """One published position.

    Attributes:
        t_s: when it was true, on any clock.
        counts: encoder position.
        error_counts: commanded minus actual position at the same instant.
    """

    t_s: float
    counts: int
    error_counts: float


@dataclass(frozen=True, slots=True)
class Effort:
    """What one motion has shown.

    Attributes:
        t_s: of its end.
        inertia: motor and load, as a multiple of the identified plant's.
        against_pwm: output for the way that does not depend on the speed, in PWM steps; negative in a motion in
            reverse: friction, the load, and what the integral had gathered.
        left_pwm: root of the mean square of what the fit leaves of the output's impulse, over the duration.
        top_counts_per_s: highest speed.
        way_counts: signed.
        samples: number of samples used.
    """

    t_s: float
    inertia: float
    against_pwm: float
    left_pwm: float
    top_counts_per_s: float
    way_counts: int
    samples: int


class EffortMeter:
    """Follows one axis by its published positions, and weighs each motion from rest to rest.

    Args:
        profile: the dialect; its drive must report the position error.
        plant: as identified.
        gains: in force.
    """

    def __init__(self, profile: Profile, plant: Plant, gains: Gains) -> None:
        self._plant = plant
        self._gains = gains
        cycle_s = profile.servo_cycle_s
        self._tick_s = cycle_s * gains.sr
        self._sum_s = self._tick_s if profile.divisor_slows_profile else cycle_s
        self._bound = gains.il * 256.0
        self.restart()

    def restart(self) -> None:
        """Begin anew: the loop was opened, or samples are missing; the drive's integral begins at 0 when it closes."""
        self._total = 0.0
        self._rest = deque[tuple[SeenPosition, float]]()  # the last samples at rest, with the integral sum
        self._motion: list[tuple[SeenPosition, float]] = []
        self._still = STILL_COUNTS
        self._stood: tuple[SeenPosition, float] | None = None  # since when it stands

    @property
    def resting_pwm(self) -> float | None:
        """Output that has not moved the axis for nearly `REST_S`: the least of that time, PWM steps; None in motion.

        Of the integral only what it has gathered since the axis stands: what it had before is not known.
        """
        if self._stood is None or self._rest[-1][0].t_s - self._rest[0][0].t_s < STOOD_SHARE * REST_S:
            return None
        gains, before = self._gains, self._stood[1]
        outputs = [
            (gains.kp * seen.error_counts + gains.ki * (total - before) / 256) / 256 for seen, total in self._rest
        ]
        return min(*map(abs, outputs), gains.ol)

    def take(self, seen: SeenPosition) -> Effort | None:
        """Take the next position with the loop closed; return what a motion has shown that has just ended."""
        before = self._motion[-1] if self._motion else self._rest[-1] if self._rest else None
        if before is not None:
            gap_s = seen.t_s - before[0].t_s
            if gap_s <= 0:
                return None
            if gap_s > MOST_GAP_S and (self._motion or abs(seen.counts - before[0].counts) > self._still):
                self.restart()
            else:
                mean = (before[0].error_counts + seen.error_counts) / 2
                self._total = min(max(self._total + mean * gap_s / self._sum_s, -self._bound), self._bound)
        now = seen, self._total
        rest = self._rest
        rest.append(now)
        while seen.t_s - rest[0][0].t_s > REST_S:
            rest.popleft()
        spread = max(each.counts for each, _ in rest) - min(each.counts for each, _ in rest)
        self._stood = (self._stood or rest[0]) if spread <= STILL_COUNTS else None
        if not self._motion:
            if spread > self._still:
                self._motion = list(rest)[-2:]
            return None
        self._motion.append(now)
        came = abs(seen.counts - self._motion[0][0].counts)
        for_s = seen.t_s - self._motion[0][0].t_s
        if for_s < LONGEST_S and (for_s < REST_S or spread > max(STILL_COUNTS, STILL_SHARE * came)):
            return None
        self._still = max(STILL_COUNTS, 2 * spread) if for_s < LONGEST_S else STILL_COUNTS
        motion, self._motion = self._motion, []
        return self._weighed(motion)

    def _weighed(self, motion: list[tuple[SeenPosition, float]]) -> Effort | None:
        times = np.array([seen.t_s for seen, _ in motion])
        counts = np.array([seen.counts for seen, _ in motion], dtype=np.float64)
        error = np.array([seen.error_counts for seen, _ in motion])
        total = np.array([gathered for _, gathered in motion])
        way = float(counts[-1] - counts[0])
        if len(motion) < FEWEST_SAMPLES or abs(way) < LEAST_COUNTS:
            return None
        speed = np.gradient(counts, times) * np.sign(way)
        top = float(np.max(speed))
        quick = np.flatnonzero(speed > SLOW_SHARE * top)
        part = slice(int(quick[0]), int(quick[-1]) + 1)
        if part.stop - part.start < FEWEST_SAMPLES or not (speed[part] > 0).all():
            return None
        gains, plant = self._gains, self._plant
        output = (gains.kp * error + gains.ki * total / 256) / 256
        steps = np.diff(times)
        impulse = (output[1:] + output[:-1]) / 2 * steps + gains.kd * self._tick_s * np.diff(error) / 256
        mean = impulse / steps
        if np.mean(np.abs(mean[part.start : part.stop - 1]) >= gains.ol) > SATURATED_SHARE:
            return None
        mean = np.clip(mean, -gains.ol, gains.ol)
        mean -= np.where(np.abs(mean) >= 1.0, LOST_PWM - gains.deadband, 0.0) * np.sign(mean)
        given = np.concatenate([[0.0], np.cumsum(mean * steps)])
        given = np.interp(times - plant.delay_s, times, given)  # what has reached the motor
        weight = 1.0 / plant.acceleration
        value = (given - plant.damping_per_s * weight * (counts - counts[0]))[part]
        momentum = (speed * np.sign(way) * weight)[part]
        elapsed = (times - times[part.start])[part]
        matrix = np.column_stack([momentum, elapsed, np.ones_like(elapsed)])
        solution = np.linalg.lstsq(matrix, value, rcond=None)[0]
        left = matrix @ solution - value
        return Effort(
            t_s=float(times[-1]),
            inertia=float(solution[0]),
            against_pwm=float(solution[1]),
            left_pwm=float(np.sqrt(np.mean(left**2)) / elapsed[-1]),
            top_counts_per_s=top,
            way_counts=int(way),
            samples=part.stop - part.start,
        )
