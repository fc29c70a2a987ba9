"""Find a plant in traces of its moves: a linear regression to begin with, then the drive's own law against the trace.

The regression integrates the equation of motion twice, so it needs no derivative of a coarse trace: what the position
did is a sum of what the output, the speed, friction and a load have added. The output itself is in no trace; it follows
from the law, the command and the position. The fit then runs the law on a plant for each record and changes the plant
until positions agree (Levenberg-Marquardt). Intervals come from its Jacobian and what is left of the differences.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldcnd.bench.tuning.excitation import MoveRecord
from ldcnd.bench.tuning.plant import LEAST_DAMPING_PER_S, Plant
from ldcnd.bench.tuning.response import Floats, TrapezoidMove, simulate
from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.drives.ldcn.profiles import Profile

CONFIDENCE_SIGMAS = 1.96
"""Half the width of an interval of 95 %, in standard deviations."""
MOST_LATE_S = 0.06
"""Longest time between the begin of a move and its first visible count, seconds."""
LATE_STEP_S = 0.002
FEWEST_SAMPLES = 12
ITERATIONS = 12
MOST_CYCLES = 40.0
"""Longest dead time that the fit considers, servo cycles."""
MOST_STEP = (1.0, 1.5, 20.0, 20.0, 3.0, 20.0)
"""Largest change of each value of a plant in one step of the fit."""
GOOD_COUNTS = 1.0
GOOD_SHARE = 0.001
"""A fit that leaves no more than this share of the distance, or `GOOD_COUNTS`, is not begun again elsewhere."""
STARTS = ((1.0, 1.0, 1.0), (0.6, 1.0, 0.5), (1.6, 1.0, 1.0), (1.0, 4.0, 0.3))
"""Factors of acceleration, damping and friction where fits begin."""
BEGIN_SHARE = 0.05
"""The regression begins where the speed is this share of the highest."""
LOSSES = (1, 2)
PLANT_COLUMNS = 4
"""Columns of the regression: acceleration, damping, friction, load."""
MOST_CORRELATION = 0.95
PER_SAMPLE_COUNTS = 0.3
"""Standard deviation of a position that is a whole number of counts."""


@dataclass(frozen=True, slots=True)
class Identified:
    """A plant, and how well it is known.

    Attributes:
        plant: the best estimate.
        interval: half the width of the 95 % interval of each value, in its unit.
        left_counts: standard deviation of the residuals.
    """

    plant: Plant
    interval: Plant
    left_counts: float


def identify(profile: Profile, records: Sequence[MoveRecord], near: Plant | None = None) -> Identified:
    """Return the plant under which the drive's law makes these records.

    Args:
        profile: the dialect.
        records: at least one in each direction, each with enough output to accelerate visibly; stiffer gains tell more
            of the dead time, softer ones of the rest.
        near: start of the fit, from earlier records; without it the regression over the records.

    Raises:
        ValueOutOfRange: a record shows too little motion, or none of them fits any plant.
    """
    for record in records:
        moved = max(record.positions) - min(record.positions)
        if len(record.times_s) < FEWEST_SAMPLES or moved < FEWEST_SAMPLES:
            raise ValueOutOfRange(
                f"a trace of {len(record.times_s)} samples over {moved} counts tells too little of an axis",
                value=moved,
                limit=FEWEST_SAMPLES,
                remedy="move further, or with more gain",
            )
    if near is None:
        plant, begun = _regression(profile, records)
    else:
        plant, begun = near, [begin_s(profile, near, record) for record in records]
    return _PlantFit(profile, records).solve(plant, begun)


def begin_s(profile: Profile, plant: Plant, record: MoveRecord) -> float:
    """Return when a move must have begun for this plant to follow it so."""
    span_s = record.times_s[-1] - record.times_s[0]
    run = simulate(profile, plant, record.gains, record.move, span_s, record.start)

    def left(begun_s: float) -> float:
        at = np.interp(np.asarray(record.times_s) - begun_s, run.times_s, run.positions)
        return float(np.sum((at - record.positions) ** 2))

    return min(_offsets(record), key=left)


# -- the regression ------------------------------------------------------------------------------------------------


def _regression(profile: Profile, records: Sequence[MoveRecord]) -> tuple[Plant, list[float]]:
    """Return a first estimate, and when each move began on the clock of its record."""
    lates = [_offsets(record) for record in records]
    best: tuple[float, list[float], Floats] | None = None
    chosen = [options[len(options) // 3] for options in lates]
    for _ in range(2):  # each record's own offset in turn, with the others as they are
        for index, options in enumerate(lates):
            for offset in options:
                trial = [*chosen[:index], offset, *chosen[index + 1 :]]
                rows = [_rows(profile, record, begun) for record, begun in zip(records, trial, strict=True)]
                solution, left = _solved(rows)
                if solution[0] > 0 and (best is None or left < best[0]):
                    best = left, trial, solution
            if best:
                chosen = best[1]
    if best is None:
        raise ValueOutOfRange("no plant accelerates as these traces do", remedy="check motor and encoder direction")
    acceleration, damping, friction, load = best[2]
    plant = Plant(
        float(acceleration),
        max(float(damping), 1.0),
        float(friction / acceleration),
        float(load / acceleration),
    )
    return plant, best[1]


def _solved(rows: Sequence[tuple[Floats, Floats, Floats]]) -> tuple[Floats, float]:
    """Return acceleration, damping, friction and load of least squares, and what is left of them.

    The speed with which each record begins is found, too: a derivative of its first counts would be wrong by more than
    friction does. Damping and friction below 0 explain noise, so they are left out then.
    """
    values = np.concatenate([value for _, value, _ in rows])
    begins = np.zeros((len(values), len(rows)))
    first = 0
    for index, (_, value, elapsed) in enumerate(rows):
        begins[first : first + len(value), index] = elapsed
        first += len(value)
    matrix = np.column_stack([np.vstack([columns for columns, _, _ in rows]), begins])
    kept = list(range(matrix.shape[1]))
    while True:
        solution = np.zeros(matrix.shape[1])
        solution[kept] = np.linalg.lstsq(matrix[:, kept], values, rcond=None)[0]
        below = [index for index in LOSSES if solution[index] < 0]
        if not below:
            return solution[:PLANT_COLUMNS], float(np.sum((matrix @ solution - values) ** 2))
        kept.remove(below[0])


def _offsets(record: MoveRecord) -> list[float]:
    """Return when a move can have begun: before its first count, and not long before."""
    first = next(n for n, at in enumerate(record.positions) if abs(at - record.positions[0]) > 1)
    seen_s = record.times_s[first]
    return [seen_s - n * LATE_STEP_S for n in range(int(MOST_LATE_S / LATE_STEP_S))]


def _rows(profile: Profile, record: MoveRecord, begun_s: float) -> tuple[Floats, Floats, Floats]:
    """Return what acceleration, damping, friction and load add to the position until each instant, it, and these.

    They are of the way from the first visible motion to the farthest place: there the speed has one sign.
    """
    cycle_s, gains, move = profile.servo_cycle_s, record.gains, record.move
    times = np.arange(begun_s, record.times_s[-1], cycle_s)
    position = np.interp(times, record.times_s, record.positions)
    error = _command(times - begun_s, move) - position
    span = gains.sr
    slope = error - np.concatenate([np.full(span, error[0]), error])[: len(error)]
    bound = gains.il * 256.0
    total = np.clip(np.cumsum(error) / (span if profile.divisor_slows_profile else 1), -bound, bound)
    output = np.clip((gains.kp * error + gains.kd * slope + gains.ki * total / 256) / 256, -gains.ol, gains.ol)
    output = np.where(np.abs(output) < 1.0, 0.0, np.trunc(output))
    smooth = np.convolve(np.pad(position, 4, mode="edge"), np.full(9, 1 / 9), mode="valid")
    velocity = np.gradient(smooth, cycle_s)
    top = float(np.max(np.abs(velocity)))
    begin = int(np.argmax(np.abs(velocity) > BEGIN_SHARE * top))
    force = float(np.sign(move.distance_counts))
    part = slice(begin, max(int(np.argmax(position * force)), begin + FEWEST_SAMPLES))

    def twice(what: Floats) -> Floats:
        return np.asarray(np.cumsum(np.cumsum(what)) * cycle_s**2, dtype=np.float64)

    way = position[part] - position[part][0]
    ones = np.ones_like(way)
    columns = (twice(output[part]), -np.cumsum(way) * cycle_s, -force * twice(ones), twice(ones))
    return np.column_stack(columns), way, times[part] - times[part][0]


def _command(times: Floats, move: TrapezoidMove) -> Floats:
    """Return the commanded positions of a trapezoid, 0 before it."""
    way, top, rate = abs(move.distance_counts), move.speed_counts_per_s, move.acceleration_counts_per_s2
    peak = min(top, math.sqrt(way * rate))
    ramp_s = peak / rate
    slew_s = (way - peak * ramp_s) / peak
    t = np.clip(times, 0.0, 2 * ramp_s + slew_s)
    up = 0.5 * rate * np.minimum(t, ramp_s) ** 2
    across = peak * np.clip(t - ramp_s, 0.0, slew_s)
    down_s = np.clip(t - ramp_s - slew_s, 0.0, ramp_s)
    return np.asarray(np.sign(move.distance_counts) * (up + across + peak * down_s - 0.5 * rate * down_s**2))


# -- the fit -------------------------------------------------------------------------------------------------------


class _PlantFit:
    """Levenberg-Marquardt over the values of a plant and the begin of each record.

    Values: logarithms of acceleration and damping, friction, load, delay in servo cycles, backlash, then the begins.
    The law works in whole numbers, so derivatives are differences over steps that change some of them.
    """

    steps = (0.03, 0.1, 0.2, 0.2, 0.5, 1.0)

    def __init__(self, profile: Profile, records: Sequence[MoveRecord]) -> None:
        self._profile = profile
        self._records = records
        self._cycle_s = profile.servo_cycle_s
        begins = [_offsets(record) for record in records]
        self._lowest = np.array([-5.0, -7.0, 0.0, -255.0, 0.0, 0.0, *(min(each) for each in begins)])
        self._highest = np.array([25.0, 12.0, 255.0, 255.0, MOST_CYCLES, math.inf, *(max(each) for each in begins)])

    def solve(self, plant: Plant, begun: Sequence[float]) -> Identified:
        """Return the best plant near this one; where traces fit badly there, other starts are tried, too."""
        travel = max(abs(record.move.distance_counts) for record in self._records)
        enough = max(GOOD_COUNTS, GOOD_SHARE * travel) ** 2 * sum(len(record.times_s) for record in self._records)
        best: tuple[float, Floats] | None = None
        for acceleration, damping, friction in STARTS:
            near = replace(
                plant,
                acceleration=plant.acceleration * acceleration,
                damping_per_s=plant.damping_per_s * damping,
                friction_pwm=plant.friction_pwm * friction,
            )
            values, cost = self._descend(self._bounded(self._values(near, begun)))
            if best is None or cost < best[0]:
                best = cost, values
            if best[0] < enough:
                break
        assert best is not None  # noqa: S101 - there are starts
        return self._with_intervals(best[1])

    def _values(self, plant: Plant, begun: Sequence[float]) -> Floats:
        logarithms = math.log(plant.acceleration), math.log(max(plant.damping_per_s, LEAST_DAMPING_PER_S))
        rest = plant.friction_pwm, plant.load_pwm, plant.delay_s / self._cycle_s, plant.backlash_counts
        return np.array([*logarithms, *rest, *begun], dtype=np.float64)

    def _plant(self, values: Floats) -> Plant:
        return Plant(
            math.exp(values[0]),
            math.exp(values[1]),
            float(values[2]),
            float(values[3]),
            float(values[4]) * self._cycle_s,
            float(values[5]),
        )

    def _each(self, values: Floats, what: Callable[[MoveRecord, Floats, Floats, float], Floats]) -> list[Floats]:
        plant = self._plant(values)
        out = []
        for record, begun in zip(self._records, values[len(self.steps) :], strict=True):
            duration_s = record.times_s[-1] - float(begun) + self._cycle_s
            run = simulate(self._profile, plant, record.gains, record.move, duration_s, record.start)
            out.append(what(record, run.times_s, run.positions, float(begun)))
        return out

    def _differences(self, values: Floats) -> Floats:
        def of(record: MoveRecord, times: Floats, positions: Floats, begun: float) -> Floats:
            at = np.asarray(record.times_s) - begun
            return np.asarray(np.interp(at, times, positions, left=positions[0]) - record.positions)

        return np.concatenate(self._each(values, of))

    def _jacobian(self, values: Floats, here: Floats) -> Floats:
        columns = []
        for index, step in enumerate(self.steps):
            above, below = values.copy(), values.copy()
            above[index] += step
            below[index] -= step
            above, below = self._bounded(above), self._bounded(below)
            columns.append((self._differences(above) - self._differences(below)) / (above[index] - below[index]))
        first = 0
        for record in self._records:  # a later begin shifts a record, nothing else
            size = len(record.times_s)
            column = np.zeros_like(here)
            at = np.asarray(record.positions) + here[first : first + size]
            column[first : first + size] = -np.gradient(at, np.asarray(record.times_s))
            columns.append(column)
            first += size
        return np.column_stack(columns)

    def _descend(self, values: Floats) -> tuple[Floats, float]:
        here = self._differences(values)
        cost, caution = float(here @ here), 1e-2
        for _ in range(ITERATIONS):
            jacobian = self._jacobian(values, here)
            normal, slope = jacobian.T @ jacobian, jacobian.T @ here
            scale = np.diag(np.maximum(np.diag(normal), 1e-9))
            gained = 0.0
            for _ in range(5):
                step = np.linalg.solve(normal + caution * scale, -slope)
                step[: len(MOST_STEP)] = np.clip(step[: len(MOST_STEP)], np.negative(MOST_STEP), MOST_STEP)
                trial = self._bounded(values + step)
                there = self._differences(trial)
                if float(there @ there) < cost:
                    gained = 1.0 - float(there @ there) / cost
                    values, here, cost = trial, there, float(there @ there)
                    caution = max(caution / 5, 1e-6)
                    break
                caution *= 5
            if gained < 1e-3:  # noqa: PLR2004 - a thousandth less changes nothing that matters
                break
        return values, cost

    def _bounded(self, values: Floats) -> Floats:
        return np.asarray(np.clip(values, self._lowest, self._highest))

    def _with_intervals(self, values: Floats) -> Identified:
        here = self._differences(values)
        jacobian = self._jacobian(values, here)
        variance = max(float(here @ here) / max(len(here) - len(values), 1), PER_SAMPLE_COUNTS**2)
        follows = float(here[1:] @ here[:-1]) / max(float(here @ here), 1e-9)
        follows = min(max(follows, 0.0), MOST_CORRELATION)  # what is left of one sample tells of the next one
        variance *= (1 + follows) / (1 - follows)
        spread = CONFIDENCE_SIGMAS * np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)) * variance)
        plant = self._plant(values)
        interval = Plant(
            plant.acceleration * float(spread[0]),
            plant.damping_per_s * float(spread[1]),
            float(spread[2]),
            float(spread[3]),
            max(float(spread[4]), 1.0) * self._cycle_s,  # when a move began is not known better
            max(float(spread[5]), 1.0),
        )
        return Identified(plant, interval, math.sqrt(float(here @ here) / len(here)))
