"""Machines drawn by lot for tuning, and traces of them as a host would record them."""

import random
from collections.abc import Iterator
from dataclasses import dataclass, replace

from ldcnd.drivers.ldcn.profiles import Profile
from ldcnd.drivers.ldcn.registers import Gains
from ldcnd.sim.plant import MotorPlant
from ldcnd.tuning.ldcn.design import Proposal, figures_of, propose, stiff_gains, within_authority
from ldcnd.tuning.ldcn.identify import Identified, Record, identify
from ldcnd.tuning.ldcn.plant import ENDLESS_COUNTS, Plant
from ldcnd.tuning.ldcn.response import Figures, Move, Response, Start, simulate

REFERENCE = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, cl=0, el=4000, sr=1)
"""The gains of the examples in config/."""
FULL_LEVEL = 64
"""Largest output of an excitation, PWM steps."""
TEST_S = 1.2
SAMPLE_S = 0.0026
"""What a line at 115200 baud brings of one drive."""


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


@dataclass(frozen=True, slots=True)
class Excited:
    """What excitations have shown.

    Attributes:
        records: there and back with the level that moved it; empty where the drive gave up.
        farthest_counts: from where it stood.
    """

    records: tuple[Record, ...]
    farthest_counts: float


def excite(profile: Profile, plant: DrawnPlant, seed: int) -> Excited:
    """Move a machine there and back by a fourth of its distance, with more output each time until it follows.

    The command is a step, EL is a third more than that, and OL grows from one PWM step: a motor that runs away does so
    with little more than its friction needs.
    """
    dice = random.Random(seed)
    reach = plant.distance_counts // 4
    farthest, level = 0.0, 1.0
    while level <= FULL_LEVEL:
        kp = max(round(256 * level / reach), 1)
        gains = replace(REFERENCE, kp=kp, kd=8 * kp, ki=0, il=0, ol=max(round(level), 1), el=reach * 4 // 3)
        records: list[Record] = []
        start, slack = Start(), 0.0
        for distance in (reach, -reach):
            move = Move(distance, 100.0 * reach, 100_000.0 * reach)
            run = simulate(profile, plant.motor, gains, move, 0.6, Start(start.position_counts, slack))
            offset = 0 if distance > 0 else reach
            farthest = max(farthest, *(abs(run.positions + offset)))
            if run.tripped:
                return Excited((), farthest)
            if abs(run.positions[-1] - start.position_counts) < 0.6 * reach:
                break
            records.append(sampled(run, gains, move, Start(start.position_counts, slack), dice))
            start, slack = Start(int(run.positions[-1]) - distance), 1.0 if distance > 0 else 0.0
        if len(records) == 2:
            return Excited(tuple(records), farthest)
        level *= 1.5
    return Excited((), farthest)


def refined(profile: Profile, plant: DrawnPlant, gains: Gains, seed: int) -> tuple[tuple[Record, ...], float]:
    """Return traces of short steps with stiff gains, without integral, and the farthest place in them."""
    dice = random.Random(seed)
    reach = plant.distance_counts // 8
    stiff = replace(gains, ki=0, il=0, ol=FULL_LEVEL, el=2 * reach)
    records: list[Record] = []
    start, slack, farthest = Start(), 0.0, 0.0
    for distance in (reach, -reach):
        move = Move(distance, 100.0 * reach, 100_000.0 * reach)
        run = simulate(profile, plant.motor, stiff, move, 0.3, Start(start.position_counts, slack))
        farthest = max(farthest, *(abs(run.positions + (reach if distance < 0 else 0))))
        if run.tripped:
            break
        records.append(sampled(run, stiff, move, Start(start.position_counts, slack), dice))
        start, slack = Start(int(run.positions[-1]) - distance), 1.0 if distance > 0 else 0.0
    return tuple(records), farthest


def sampled(run: Response, gains: Gains, move: Move, start: Start, dice: random.Random) -> Record:
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
    return Record(gains, move, start, tuple(times), tuple(positions))


@dataclass(frozen=True, slots=True)
class Tuned:
    """A machine that was tuned from its traces alone, and how it then moved.

    Attributes:
        true: what it is.
        known: what its traces say.
        proposal: what was proposed for that.
        measured: the figures of the test move with it, on the machine.
        reference: those of the same move with the gains of the examples.
        tripped: the drive gave up in the test move with the proposal, and `reference_tripped` with the others.
        farthest_counts: from where the machine stood, in all excitations.
    """

    true: Plant
    known: Identified
    proposal: Proposal
    measured: Figures
    reference: Figures
    tripped: bool
    reference_tripped: bool
    farthest_counts: float

    @property
    def acceleration_error(self) -> float:
        """How far the acceleration is from the truth, as a share."""
        return abs(self.known.plant.acceleration / self.true.acceleration - 1)


def tuned(profile: Profile, plant: DrawnPlant, bandwidth_hz: float | None = None) -> Tuned:
    """Excite a machine softly, then stiffly, identify it, propose gains, and move with them."""
    soft = excite(profile, plant, seed=plant.number)
    first = identify(profile, soft.records)
    stiff, farthest = refined(profile, plant, stiff_gains(profile, first), seed=plant.number)
    known = identify(profile, (*soft.records, *stiff), first.plant)
    distance = plant.distance_counts // 2
    move = within_authority(known.plant, Move(distance, 40.0 * distance, 800.0 * distance))
    proposal = propose(profile, known, move, bandwidth_hz)
    run = simulate(profile, plant.motor, proposal.gains, move, TEST_S)
    usual = simulate(profile, plant.motor, REFERENCE, move, TEST_S)
    return Tuned(
        Plant.of(plant.motor),
        known,
        proposal,
        figures_of(run, move),
        figures_of(usual, move),
        run.tripped,
        usual.tripped,
        max(soft.farthest_counts, farthest, float(max(abs(run.positions)))),
    )
