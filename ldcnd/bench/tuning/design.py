"""Propose gains for a plant: a wanted bandwidth with margins, checked on the sampled loop and on a move.

The loop is the one that the drive closes: position sampled once per servo tick, the output held until the next one, the
plant's dead time added. `kp` and `kd` put the crossover where it is wanted with the phase that is wanted; `ki` acts a
decade below; `il` lets it hold friction and load and no more. The proposal must then pass a move on plants at the edges
of the interval of this one: where one overshoots, rings or trips, the bandwidth is lowered.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from ldcnd.bench.tuning.identify import Identified
from ldcnd.bench.tuning.plant import FULL_PWM, Plant
from ldcnd.bench.tuning.response import Figures, Response, TrapezoidMove, figures, simulate
from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.profiles import Profile

MOST_GAIN = 0x7FFF
MOST_OUTPUT = 250
"""Output limit; "usually, PWM value greater than 250 is not recommended" (LS-182AP manual)."""
PHASE_MARGINS_DEG = (60.0, 45.0, 35.0, 30.0)
"""Phase margins tried for the estimated plant, degrees."""
LEAST_PHASE_DEG = 20.0
"""Least phase margin on each plant of the interval, degrees."""
MOST_LEAD_DEG = 78.0
"""More phase than this is made of nearly nothing but the derivative, and holds no position."""
GAIN_MARGIN_DB = 6.0
INTEGRAL_SHARES = (0.03, 0.25, 0.7)
"""The integral acts below this share of the crossover; a slow one leaves the end of a move to friction."""
BANDWIDTHS_HZ = tuple(4.0 * 1.35**n for n in range(12))
"""Tried where none is wanted: 4 to 109 Hz."""
STIFF_PHASE_DEG = 35.0
STIFF_RESERVE_S = 0.0015
"""Extra dead time that the phase margin must bear, seconds, beyond the estimate from soft traces."""
LEAST_SPREAD = 0.05
"""An acceleration is taken to be known no better than to this share: loads change."""
LEAST_ERROR_LIMIT = 50
"""Counts added to three times the predicted following error for EL."""
SAME_S = 0.001
"""Largest difference of settling times that count as equal, seconds: then the slower loop wins."""
INTEGRAL_RESERVE = 2.0
"""Limit of the integral, as a multiple of friction and load."""
MOST_KICK_PWM = 32.0
"""Most output that one count of encoder noise may add through `kd`, PWM steps."""
MOST_OVERSHOOT = 0.08
"""Largest overshoot of the predicted move, on every plant at the edge of the interval; a measured one gets 0.15."""
MOST_TICK_SHARE = 0.05
"""A servo tick is no longer than this share of the crossover's period."""
PREDICTED_S = 0.6
WINDOW_COUNTS = 4.0
WINDOW_SHARE = 0.005
"""A move has arrived within this share of its distance, or `WINDOW_COUNTS`."""


@dataclass(frozen=True, slots=True)
class Margins:
    """Stability margins of a loop.

    Attributes:
        crossover_hz: where its gain is 1.
        phase_deg: distance to -180 degrees there.
        gain_db: distance to 1 where its phase is -180 degrees; infinite where it never is.
    """

    crossover_hz: float
    phase_deg: float
    gain_db: float


@dataclass(frozen=True, slots=True)
class Proposal:
    """Gains, with the predicted move.

    Attributes:
        gains: the registers.
        margins: of the loop with them.
        predicted: the move on the estimated plant.
        figures: of that.
    """

    gains: Gains
    margins: Margins
    predicted: Response
    figures: Figures


def margins(profile: Profile, plant: Plant, gains: Gains) -> Margins:
    """Return the margins of the sampled loop; friction, backlash and limits are no part of it.

    Raises:
        ValueOutOfRange: the loop has no crossover below half the servo rate.
    """
    tick_s = profile.servo_cycle_s * (gains.sr if profile.divisor_slows_profile else 1)
    omega = np.geomspace(math.tau * 0.01, math.pi / tick_s, 4000)
    z = np.exp(1j * omega * tick_s)
    span = 1 if profile.divisor_slows_profile else gains.sr
    control = (gains.kp + gains.kd * (1 - z**-span) + gains.ki / 256 / (1 - 1 / z)) / 256
    d = max(plant.damping_per_s, 1e-3)
    decay = math.exp(-d * tick_s)
    # zero-order hold of acceleration / (s (s + d))
    held = plant.acceleration / d**2 * (
        ((d * tick_s - 1 + decay) * z + (1 - decay - d * tick_s * decay)) / ((z - 1) * (z - decay))
    )  # fmt: skip
    loop = control * held * np.exp(-1j * omega * plant.delay_s)
    size, phase = np.abs(loop), np.unwrap(np.angle(loop))
    phase -= math.tau * round((float(phase[0]) + math.pi) / math.tau)
    crossing = np.flatnonzero((size[:-1] >= 1.0) & (size[1:] < 1.0))
    if not len(crossing):
        raise ValueOutOfRange("the loop has no crossover", value=gains.kp)
    at = int(crossing[-1])
    turning = np.flatnonzero((phase[:-1] > -math.pi) & (phase[1:] <= -math.pi) & (omega[1:] > omega[at]))
    gain_db = -20 * math.log10(float(size[turning[0]])) if len(turning) else math.inf
    return Margins(float(omega[at]) / math.tau, math.degrees(math.pi + float(phase[at])), gain_db)


def gains_for(
    profile: Profile, plant: Plant, bandwidth_hz: float, phase_margin_deg: float, integral_share: float
) -> Gains:
    """Return the registers that put the crossover at this bandwidth.

    Args:
        profile: the dialect.
        plant: of the loop.
        bandwidth_hz: the crossover.
        phase_margin_deg: the phase that is left there.
        integral_share: the integral acts below this share of the crossover.

    Raises:
        ValueOutOfRange: a register would be exceeded, or no derivative gives that much phase there.
    """
    divisors = range(1, max(int(MOST_TICK_SHARE / (bandwidth_hz * profile.servo_cycle_s)), 1) + 1)
    for divisor in divisors if profile.divisor_slows_profile else (1,):
        tick_s = divisor * profile.servo_cycle_s
        kp, kd, ki = _pid(plant, math.tau * bandwidth_hz, tick_s, phase_margin_deg, integral_share)
        if kd <= MOST_KICK_PWM * 256:
            break  # a slower tick makes the derivative less sensitive to single counts
    if not 1 <= kp <= MOST_GAIN or kd > MOST_KICK_PWM * 256 or ki > MOST_GAIN:
        raise ValueOutOfRange(
            f"{bandwidth_hz:g} Hz needs kp {kp:.0f}, kd {kd:.0f}, ki {ki:.0f}", value=bandwidth_hz, limit=MOST_GAIN
        )
    held_pwm = INTEGRAL_RESERVE * (plant.friction_pwm + abs(plant.load_pwm)) + 2
    integral = max(round(ki), 1)
    return Gains(
        kp=round(kp),
        kd=round(kd),
        ki=integral,
        il=min(math.ceil(256 * held_pwm / integral), MOST_GAIN),
        ol=MOST_OUTPUT,
        cl=0,
        el=profile.most_error_limit,
        sr=divisor,
    )


def _pid(
    plant: Plant, omega: float, tick_s: float, phase_margin_deg: float, integral_share: float
) -> tuple[float, float, float]:
    """Return kp, kd and ki with the crossover at omega, rad/s, and this phase margin."""
    lag = math.pi / 2 + math.atan2(omega, plant.damping_per_s) + omega * (plant.delay_s + tick_s / 2)
    lead = max(math.radians(phase_margin_deg) - math.pi + lag + math.atan(integral_share), 0.0)
    across, along = math.sin(omega * tick_s), 1 - math.cos(omega * tick_s)
    if lead > math.radians(MOST_LEAD_DEG) or across - math.tan(lead) * along <= 0:
        raise ValueOutOfRange(f"no derivative gain gives {phase_margin_deg:g} degrees there", value=omega / math.tau)
    ratio = math.tan(lead) / (across - math.tan(lead) * along)
    strength = plant.acceleration / (omega * math.hypot(omega, plant.damping_per_s))
    kp = 256 / (strength * math.hypot(1 + ratio * along, ratio * across))
    return kp, kp * ratio, 256 * kp * integral_share * omega * tick_s


def propose(profile: Profile, known: Identified, move: TrapezoidMove, bandwidth_hz: float | None = None) -> Proposal:
    """Return the gains with which the move settles soonest on the worst of the plants that this one may be.

    Args:
        profile: the dialect.
        known: the plant with its intervals.
        move: what the gains must do well.
        bandwidth_hz: crossover of the loop; chosen when left out.

    Raises:
        ValueOutOfRange: no gains have the margins at the bandwidth that is wanted, or at any.
    """
    ways = [(margin, share) for margin in PHASE_MARGINS_DEG for share in INTEGRAL_SHARES]
    best: tuple[float, Proposal] | None = None
    for wanted in BANDWIDTHS_HZ if bandwidth_hz is None else (bandwidth_hz,):
        for margin, share in ways:
            best = _better(profile, known, move, (wanted, margin, share), best)
    if best is None:
        raise ValueOutOfRange(
            f"no gains have a phase margin of {LEAST_PHASE_DEG:g} degrees and a gain margin of {GAIN_MARGIN_DB:g} dB"
            + (f" at {bandwidth_hz:g} Hz" if bandwidth_hz is not None else ""),
            value=bandwidth_hz,
            remedy="ask for less bandwidth" if bandwidth_hz is not None else "look for dead time and backlash",
        )
    return best[1]


def stiff_gains(profile: Profile, known: Identified) -> Gains:
    """Return the stiffest gains with wide margins, for traces that tell of the dead time; they need no good plant.

    Raises:
        ValueOutOfRange: there are none.
    """
    for wanted in reversed(BANDWIDTHS_HZ):
        try:
            gains = gains_for(profile, known.plant, wanted, PHASE_MARGINS_DEG[0], INTEGRAL_SHARES[0])
            late = replace(known.plant, delay_s=known.plant.delay_s + STIFF_RESERVE_S)
            there = margins(profile, late, gains)
        except ValueOutOfRange:
            continue
        if there.phase_deg >= STIFF_PHASE_DEG and there.gain_db >= GAIN_MARGIN_DB:
            return gains
    raise ValueOutOfRange("no gains have wide margins", remedy="look for dead time and backlash")


def _better(
    profile: Profile,
    known: Identified,
    move: TrapezoidMove,
    way: tuple[float, float, float],
    best: tuple[float, Proposal] | None,
) -> tuple[float, Proposal] | None:
    """Return the better one of the best so far and the gains for this bandwidth, phase margin and integral."""
    plant = known.plant
    try:
        gains = gains_for(profile, plant, *way)
        there = margins(profile, plant, gains)
        edges = _edges(known)
        if not _is_safe(there) or not all(_is_safe(margins(profile, edge, gains)) for edge in edges):
            return best
    except ValueOutOfRange:
        return best
    lasts_s = duration_s(move)
    predicted = simulate(profile, plant, gains, move, lasts_s)
    outcome = figures_of(predicted, move)
    limit = 3 * outcome.following_error_counts + LEAST_ERROR_LIMIT
    gains = replace(gains, el=min(math.ceil(limit), profile.most_error_limit))
    worst = 0.0
    for edge in (plant, *edges):
        run = predicted if edge is plant else simulate(profile, edge, gains, move, lasts_s)
        shown = figures_of(run, move)
        worst = max(worst, shown.settling_s)
        good = shown.settled and not run.tripped and shown.overshoot <= MOST_OVERSHOOT
        if not good or (best is not None and worst >= best[0] - SAME_S):
            return best
    return worst, Proposal(gains, there, predicted, outcome)


def _is_safe(there: Margins) -> bool:
    return there.phase_deg >= LEAST_PHASE_DEG and there.gain_db >= GAIN_MARGIN_DB


def _edges(known: Identified) -> tuple[Plant, ...]:
    """Return plants at the edge of the interval and a little beyond: strong, late and loose; weak; smooth."""
    plant, spread = known.plant, known.interval
    change = max(spread.acceleration, LEAST_SPREAD * plant.acceleration)
    loose = plant.backlash_counts + spread.backlash_counts
    late = plant.delay_s + spread.delay_s
    return (
        replace(plant, acceleration=plant.acceleration + change, delay_s=late, backlash_counts=loose),
        replace(plant, acceleration=max(plant.acceleration - change, plant.acceleration / 2), delay_s=late),
        replace(plant, damping_per_s=plant.damping_per_s * 0.8, friction_pwm=plant.friction_pwm * 0.7),
    )


def duration_s(move: TrapezoidMove) -> float:
    """Return the time for a move and its settling, seconds."""
    way, rate = abs(move.distance_counts), move.acceleration_counts_per_s2
    peak = min(move.speed_counts_per_s, math.sqrt(way * rate))
    return way / peak + peak / rate + PREDICTED_S


def figures_of(run: Response, move: TrapezoidMove) -> Figures:
    """Return the figures of a simulated move."""
    window = max(WINDOW_COUNTS, WINDOW_SHARE * abs(move.distance_counts))
    return figures(run.times_s, run.positions, run.commanded, window)


def within_authority(plant: Plant, move: TrapezoidMove) -> TrapezoidMove:
    """Return a move of the same distance that needs no more than half of the output."""
    spare = MOST_OUTPUT / 2 - plant.friction_pwm - abs(plant.load_pwm)
    if spare <= 0:
        raise ValueOutOfRange(
            f"friction and load take {FULL_PWM - spare:.0f} of {FULL_PWM} PWM steps", remedy="look at the machine"
        )
    speed = min(move.speed_counts_per_s, spare / 2 * plant.acceleration / max(plant.damping_per_s, 1e-3))
    return replace(
        move,
        speed_counts_per_s=speed,
        acceleration_counts_per_s2=min(move.acceleration_counts_per_s2, spare / 2 * plant.acceleration),
    )
