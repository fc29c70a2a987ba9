"""Machines drawn by lot for tuning, and traces of them as a host would record them."""

import random
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

from ldcnd.bench.tuning.design import Proposal, duration_s, propose, stiff_gains, within_authority
from ldcnd.bench.tuning.excitation import Bounds, Excitation, MoveRecord, Trial, TrialOutcome, Trials
from ldcnd.bench.tuning.identify import Identified, identify
from ldcnd.bench.tuning.plant import ENDLESS_COUNTS, Plant
from ldcnd.bench.tuning.response import Figures, Response, Start, TrapezoidMove, simulate
from ldcnd.bench.tuning.verdict import measured, worst
from ldcnd.contract.errors import DriveFault
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.sim.plant import MotorPlant

REFERENCE = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, cl=0, el=4000, sr=1)
"""The gains of the examples in config/."""
SAMPLE_S = 0.0026
"""What a line at 115200 baud brings of one drive."""
COASTING_S = 1.0
"""For so long an axis is given time to come to rest with its loop open, before the next trial."""


@dataclass(frozen=True, slots=True)
class DrawnPlant:
    """A machine and how far it may be moved.

    Attributes:
        number: in its draw.
        motor: the machine.
        distance_counts: nothing may be farther away than this from where it stood.
    """

    number: int
    motor: MotorPlant
    distance_counts: int


def drawn_plants(seed: int, count: int) -> Iterator[DrawnPlant]:
    """Draw machines: inertia 1 to 30, 500 to 10000 lines, 12 to 48 V, friction, dead time, backlash, hanging load."""
    dice = random.Random(seed)
    for number in range(count):
        lines = dice.choice((500, 1000, 2000, 2500, 5000, 10_000))
        supply_v = dice.choice((12.0, 24.0, 36.0, 48.0))
        nm_per_pwm = 0.0767 * supply_v / 1.2 / 255
        friction_pwm = dice.uniform(0.5, 8.0)
        hangs = dice.random() < 0.25
        motor = MotorPlant(
            counts_per_rev=4 * lines,
            supply_v=supply_v,
            inertia_kg_m2=5e-5 * 30 ** dice.random(),
            viscous_nm_s=dice.uniform(1e-5, 2e-4),
            friction_nm=friction_pwm * nm_per_pwm,
            delay_s=dice.uniform(0.0, 0.0015),
            backlash_counts=dice.uniform(1, 2) * lines / 500 if dice.random() < 0.3 else 0.0,
            load_nm=dice.choice((-1, 1)) * dice.uniform(0.3, 0.9) * friction_pwm * nm_per_pwm if hangs else 0.0,
            reverse_limit_counts=-ENDLESS_COUNTS,
            forward_limit_counts=ENDLESS_COUNTS,
        )
        yield DrawnPlant(number, motor, 2 * lines)  # half a revolution


class SimulatedAxis:
    """Carries out trials on a machine.

    Attributes:
        farthest_counts: the farthest place of its shaft from where it stood at first.
    """

    def __init__(self, profile: Profile, plant: DrawnPlant) -> None:
        self.farthest_counts = 0.0
        self._profile = profile
        self._motor = plant.motor
        self._at = 0.0
        self._dice = random.Random(plant.number)

    def run(self, trials: Trials) -> tuple[MoveRecord, ...]:
        """Carry out all trials of a kind; return what they lead to."""
        try:
            trial = next(trials)
            while True:
                trial = trials.send(self._shown(trial))
        except StopIteration as end:
            records: tuple[MoveRecord, ...] = end.value
            return records

    def _shown(self, trial: Trial) -> TrialOutcome:
        run = simulate(self._profile, self._motor, trial.gains, trial.move, trial.lasts_s, trial.start, COASTING_S)
        lowest, highest, last = run.shaft_counts
        self.farthest_counts = max(self.farthest_counts, -self._at - lowest, self._at + highest)
        self._at += last
        record = sampled(run, trial.gains, trial.move, trial.start, self._dice)
        return TrialOutcome(record, run.tripped, run.rest_counts)


def sampled(run: Response, gains: Gains, move: TrapezoidMove, start: Start, dice: random.Random) -> MoveRecord:
    """Return a move as a host has seen it: every 2.6 ms or so, its begin not known, until it has been at rest."""
    begun_s = dice.uniform(0.005, 0.03)
    cycle_s = float(run.times_s[0])
    still = next(n for n in range(len(run.positions)) if (run.positions[n:] == run.positions[-1]).all())
    end_s = min(float(run.times_s[-1]), float(run.times_s[still]) + 0.03) + begun_s - cycle_s
    times, positions, at = [], [], 0.0
    while at < end_s:
        cycle = int((at - begun_s) / cycle_s) - 1
        times.append(at)
        positions.append(int(run.positions[max(cycle, 0)]))
        at += SAMPLE_S + dice.uniform(0.0, 0.0002)
    return MoveRecord(gains, move, start, tuple(times), tuple(positions))


@dataclass(frozen=True, slots=True)
class Tuned:
    """A machine that was tuned from its traces alone, and how it then moved.

    Attributes:
        true: what it is.
        known: what its traces say.
        proposal: what was proposed for that.
        measured: the worst figures of the test moves with it, on the machine; None where the drive gave up.
        reference: those of the same moves with the gains of the examples.
        farthest_counts: from where the machine stood, in all trials but those with the gains of the examples.
    """

    true: Plant
    known: Identified
    proposal: Proposal
    measured: Figures | None
    reference: Figures | None
    farthest_counts: float

    @property
    def acceleration_error(self) -> float:
        """How far the acceleration is from the truth, as a share."""
        return abs(self.known.plant.acceleration / self.true.acceleration - 1)


def excited(profile: Profile, plant: DrawnPlant) -> tuple[Excitation, SimulatedAxis, tuple[MoveRecord, ...]]:
    """Give pulses to a machine and move it softly."""
    excitation, axis = Excitation(profile, Bounds(plant.distance_counts)), SimulatedAxis(profile, plant)
    axis.run(excitation.pulses())
    return excitation, axis, axis.run(excitation.soft())


def tuned(profile: Profile, plant: DrawnPlant, bandwidth_hz: float | None = None) -> Tuned:
    """Excite a machine softly, then stiffly, identify it, propose gains, and move with them."""
    excitation, axis, soft = excited(profile, plant)
    first = identify(profile, soft)
    stiff = axis.run(excitation.stiff(stiff_gains(profile, first)))
    known = identify(profile, (*soft, *stiff), first.plant)
    move = within_authority(known.plant, excitation.wanted())
    proposal = propose(profile, known, move, bandwidth_hz)

    def tried(gains: Gains, on: SimulatedAxis) -> Figures | None:
        records = on.run(excitation.test(gains, move, duration_s(move)))
        return worst([measured(profile, known.plant, record) for record in records])

    outcome, farthest = tried(proposal.gains, axis), axis.farthest_counts
    reference = None
    with suppress(DriveFault):  # it runs away: `ldcnd tune` would not have tried these
        reference = tried(REFERENCE, axis)
    return Tuned(Plant.of(plant.motor), known, proposal, outcome, reference, farthest)
