"""Watch an axis at work: learn what its motions take while it is healthy, and say when they take something else.

Each motion that `EffortMeter` weighs gives up to three figures. The first motions of an axis teach what is usual: a
value that may depend on the speed, and how far single motions are from it. Later ones are judged by the mean of the
last few, and of the last many: a large change is found soon, a small one in time. Motions unlike those that taught are
not judged.

A mean is outside when it is six of its standard errors from what was learnt, and by enough to matter. Of normally
distributed ones one in 5e8 would be. They are not quite; the tests count.

An axis that does not move makes no motion to be judged. So an output that should have moved it is an alarm at once.
"""

from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ldcnd.bench.tuning.effort import LEAST_COUNTS, Effort, EffortMeter, SeenPosition
from ldcnd.bench.tuning.plant import Plant
from ldcnd.contract.samples import FigureRange
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.profiles import Profile

LEARNT_MOTIONS = 100
"""So many motions teach, of each figure."""
WINDOWS = (20, 200)
"""Means are taken over so many motions."""
LATEST_MOTIONS = 5
STANDARD_ERRORS = 6.0
NEIGHBOURS = 2.0
"""Variance of a mean, relative to independent motions: neighbours correlate by up to one half, because a figure of
friction shares a motion with the next one."""
OUTLIER_SIGMAS = 4.0
"""A single motion counts as no farther away than this."""
LIKE = 1.3
"""A motion is like those that taught when its top speed and way are within their range, widened by this factor."""
LEAST_FRICTION_PWM = 0.2
LEAST_FRICTION_SHARE = 0.2
LEAST_INERTIA = 0.1
LEAST_MISFIT_PWM = 0.05
"""Changes below these do not matter: PWM steps, a share of the identified friction, of the identified inertia, and of
what the model leaves, PWM steps."""
FALLEN_SHARE = 0.5
"""An alarm ends when the mean is within this share of its limit."""
STALLED_SHARE = 0.5
STALLED_FACTOR = 3.0
"""Least output of an axis at rest that is an alarm: this share of the output limit, and this multiple of the identified
friction and load."""
MOST_PLACES = 8
MAD_TO_SIGMA = 1.4826
SPEEDS_DIFFER = 1.1
"""A dependence on the speed is learnt when the fastest motion is faster than the slowest by this factor."""


class FigureName(StrEnum):
    """What a motion shows."""

    FRICTION = "friction"
    """Coulomb friction, PWM steps; from two motions that go opposite ways."""
    INERTIA = "inertia"
    """Motor and load, as a multiple of the identified plant's."""
    MISFIT = "misfit"
    """What the model cannot explain, PWM steps: the load does not follow the motor, or not evenly."""

    OUTPUT_AT_REST = "output_at_rest"
    """Output that does not move the axis, PWM steps; judged at once, from the model."""


OF_MOTIONS = (FigureName.FRICTION, FigureName.INERTIA, FigureName.MISFIT)
UNITS = {FigureName.FRICTION: "PWM steps", FigureName.INERTIA: "of the model's", FigureName.MISFIT: "PWM steps"}


@dataclass(frozen=True, slots=True)
class MotionFigure:
    """One figure of one motion.

    Attributes:
        value: of it.
        speed_counts_per_s: the top speed of the motion.
    """

    value: float
    speed_counts_per_s: float


@dataclass(frozen=True, slots=True)
class Learnt:
    """What is usual for a figure.

    Attributes:
        value: at standstill, as far as it depends on the speed.
        per_speed: change of it with the top speed of a motion, s/count.
        sigma: standard deviation of single motions.
    """

    value: float
    per_speed: float
    sigma: float

    def at(self, speed_counts_per_s: float) -> float:
        """Return the usual value for a motion of this top speed."""
        return self.value + self.per_speed * speed_counts_per_s


class FigureAlarm(FigureRange):
    """A figure has left what was learnt, or is back."""

    figure: FigureName
    """What has left its range."""
    over: bool = False
    """It is back."""
    latest: float
    """Median of the last five."""
    motions: int
    """Number of motions in the mean."""
    sigma: float
    """Standard deviation of single motions while the axis taught."""
    places: tuple[int, ...] = ()
    """Where the axis stood with an output that it cannot need, counts; no two close together."""

    @property
    def is_outside(self) -> bool:
        """Whether the mean is beyond a limit."""
        return self.value > self.high or (self.low is not None and self.value < self.low)


class LearnedFigures(BaseModel):
    """What has been learnt of an axis, for as long as its plant and its gains are the same; it grows."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, validate_assignment=True)

    teaching: dict[FigureName, list[MotionFigure]] = Field(default_factory=dict)
    """Figures of the motions that teach, until there are enough."""
    learnt: dict[FigureName, Learnt] = Field(default_factory=dict)
    """What followed from them."""
    speeds: tuple[float, float] = (0.0, 0.0)
    """Lowest and highest top speed of these motions, counts/s; 0, 0 before the first."""
    ways: tuple[float, float] = (0.0, 0.0)
    """Shortest and longest way likewise, counts."""


class Shadow:
    """Judges an axis by its published positions; it never stops anything.

    Args:
        profile: the dialect; its drive must report the position error.
        plant: as identified.
        gains: in force.
        memory: from before, or a new one; it grows.

    Attributes:
        memory: what has been learnt.
        motions: so many were judged or have taught.
        unlike: so many were not, because nothing like them had taught.
        standing: alarms that are not over.
        trend: the mean of each figure over the shorter window, with its limits.
    """

    def __init__(self, profile: Profile, plant: Plant, gains: Gains, memory: LearnedFigures | None = None) -> None:
        self.memory = memory or LearnedFigures()
        self.motions = 0
        self.unlike = 0
        self.standing: dict[FigureName, FigureAlarm] = {}
        self.trend: dict[FigureName, FigureAlarm] = {}
        self._meter = EffortMeter(profile, plant, gains)
        self._friction_pwm = plant.friction_pwm
        self._needed_pwm = plant.friction_pwm + abs(plant.load_pwm)
        self._stalls_pwm = max(STALLED_SHARE * gains.ol, STALLED_FACTOR * self._needed_pwm)
        self._since_stall = 0
        self._before: Effort | None = None
        self._off = {name: deque[float](maxlen=max(WINDOWS)) for name in OF_MOTIONS}
        self._latest = {name: deque[float](maxlen=LATEST_MOTIONS) for name in OF_MOTIONS}
        self._usual = {name: deque[float](maxlen=max(WINDOWS)) for name in OF_MOTIONS}

    @property
    def is_learning(self) -> bool:
        """Whether any figure still has too few motions to be judged."""
        return len(self.memory.learnt) < len(OF_MOTIONS)

    def take(self, seen: SeenPosition) -> tuple[FigureAlarm, ...]:
        """Take the next position with the loop closed; return what began or ended with it."""
        effort = self._meter.take(seen)
        stalled = self._stalled(seen)
        return stalled if effort is None else (*stalled, *self._judged(effort))

    def restart(self) -> None:
        """The loop was opened, or positions are missing."""
        self._meter.restart()
        self._before = None

    def _stalled(self, seen: SeenPosition) -> tuple[FigureAlarm, ...]:
        """Return an alarm for an output that should have moved the axis, at a place where none was before."""
        name, pwm = FigureName.OUTPUT_AT_REST, self._meter.resting_pwm
        if pwm is None or pwm < self._stalls_pwm:
            return ()
        self._since_stall = 0
        standing = self.standing.get(name)
        places = standing.places if standing else ()
        if len(places) == MOST_PLACES or any(abs(seen.counts - place) < LEAST_COUNTS for place in places):
            return ()
        alarm = FigureAlarm(
            figure=name,
            value=pwm,
            latest=pwm,
            usual=self._needed_pwm,
            low=None,
            high=self._stalls_pwm,
            unit="PWM steps",
            motions=1,
            sigma=0.0,
            places=(*places, seen.counts),
        )
        self.standing[name] = self.trend[name] = alarm
        return (alarm,)

    def _moved(self) -> tuple[FigureAlarm, ...]:
        """Return the end of such an alarm after enough motions without one."""
        self._since_stall += 1
        if FigureName.OUTPUT_AT_REST not in self.standing or self._since_stall < WINDOWS[0]:
            return ()
        del self.trend[FigureName.OUTPUT_AT_REST]
        alarm = self.standing.pop(FigureName.OUTPUT_AT_REST)
        return (alarm.model_copy(update={"over": True}),)

    def _judged(self, effort: Effort) -> tuple[FigureAlarm, ...]:
        shown = {FigureName.INERTIA: effort.inertia, FigureName.MISFIT: effort.left_pwm}
        before, self._before = self._before, effort
        if before is not None and before.way_counts * effort.way_counts < 0:
            forward, reverse = (effort, before) if effort.way_counts > 0 else (before, effort)
            shown[FigureName.FRICTION] = (forward.against_pwm - reverse.against_pwm) / 2
        memory, way = self.memory, abs(effort.way_counts)
        if not self.is_learning and not (
            _is_like(effort.top_counts_per_s, memory.speeds) and _is_like(way, memory.ways)
        ):
            self.unlike += 1
            self._before = None
            return ()
        self.motions += 1
        if self.is_learning:
            memory.speeds = _widened(memory.speeds, effort.top_counts_per_s)
            memory.ways = _widened(memory.ways, way)
        alarms = [self._take(name, MotionFigure(value, effort.top_counts_per_s)) for name, value in shown.items()]
        return (*self._moved(), *(alarm for alarm in alarms if alarm))

    def _take(self, name: FigureName, shown: MotionFigure) -> FigureAlarm | None:
        learnt = self.memory.learnt.get(name)
        if learnt is None:
            teaching = self.memory.teaching.setdefault(name, [])
            teaching.append(shown)
            if len(teaching) >= LEARNT_MOTIONS:
                self.memory.learnt[name] = _learnt(self.memory.teaching.pop(name))
            return None
        usual = learnt.at(shown.speed_counts_per_s)
        most = OUTLIER_SIGMAS * learnt.sigma + self._least(name)
        self._off[name].append(min(max(shown.value - usual, -most), most))
        self._usual[name].append(usual)
        self._latest[name].append(shown.value)
        found = [self._mean(name, learnt, window) for window in WINDOWS if len(self._off[name]) >= window]
        if not found:
            return None
        self.trend[name] = found[0]
        standing = self.standing.get(name)
        outside = [alarm for alarm in found if alarm.is_outside]
        if standing is None and outside:
            self.standing[name] = outside[0]
            return outside[0]
        short = found[0]
        half = (short.high - short.usual) * FALLEN_SHARE
        if standing is not None and not outside and abs(short.value - short.usual) <= half:
            del self.standing[name]
            return short.model_copy(update={"over": True})
        return None

    def _least(self, name: FigureName) -> float:
        """Return the least change that matters."""
        match name:
            case FigureName.FRICTION:
                return max(LEAST_FRICTION_PWM, LEAST_FRICTION_SHARE * self._friction_pwm)
            case FigureName.INERTIA:
                return LEAST_INERTIA
            case _:
                return LEAST_MISFIT_PWM

    def _mean(self, name: FigureName, learnt: Learnt, window: int) -> FigureAlarm:
        """Return the mean of the last motions with its limits."""
        off, usual = (float(np.mean(list(each)[-window:])) for each in (self._off[name], self._usual[name]))
        # what was learnt has an error of its own
        error = learnt.sigma * float(np.sqrt(NEIGHBOURS * (1 / window + 1 / LEARNT_MOTIONS)))
        limit = max(STANDARD_ERRORS * error, self._least(name))
        low = usual - limit if name is not FigureName.MISFIT else None
        return FigureAlarm(
            figure=name,
            value=usual + off,
            latest=float(np.median(self._latest[name])),
            usual=usual,
            low=low,
            high=usual + limit,
            unit=UNITS[name],
            motions=window,
            sigma=learnt.sigma,
        )


def _is_like(value: float, taught: tuple[float, float]) -> bool:
    return taught[0] / LIKE <= value <= taught[1] * LIKE


def _widened(taught: tuple[float, float], value: float) -> tuple[float, float]:
    return (min(taught[0] or value, value), max(taught[1], value))


def _learnt(teaching: list[MotionFigure]) -> Learnt:
    """Return what is usual: a line over the speed, without what is far from it."""
    speeds = np.array([shown.speed_counts_per_s for shown in teaching])
    values = np.array([shown.value for shown in teaching])
    matrix = np.column_stack([np.ones_like(speeds), speeds])
    if np.max(speeds) < SPEEDS_DIFFER * np.min(speeds):
        matrix[:, 1] = 0.0
    keep = np.ones(len(values), dtype=bool)
    solution, sigma = np.zeros(2), 0.0
    for _ in range(3):
        solution = np.linalg.lstsq(matrix[keep], values[keep], rcond=None)[0]
        off = values - matrix @ solution
        sigma = MAD_TO_SIGMA * float(np.median(np.abs(off)))
        keep = np.abs(off) <= max(OUTLIER_SIGMAS * sigma, 1e-12)
    # a distribution with two peaks has a larger deviation than its median tells
    sigma = max(sigma, float(np.std(off[keep])))
    return Learnt(float(solution[0]), float(solution[1]), sigma)
