"""Response to a move: a plant under the drive's own control law, servo cycle by servo cycle, and its figures."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ldcnd.bench.tuning.plant import Plant
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.drives.ldcn.registers import FRACTION
from ldcnd.sim.ldcn.power import PicServoPower
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.ldcn.servo import ServoLoop
from ldcnd.sim.plant import MotorPlant, Shaft

Floats = NDArray[np.float64]
REST_CYCLES = 40
"""Servo cycles for which an axis is held before a move begins, so that a hanging load is held, too."""


@dataclass(frozen=True, slots=True)
class TrapezoidMove:
    """A trapezoidal move, as commanded.

    Attributes:
        distance_counts: from the command position, signed.
        speed_counts_per_s: above 0.
        acceleration_counts_per_s2: above 0.
    """

    distance_counts: int
    speed_counts_per_s: float
    acceleration_counts_per_s2: float


@dataclass(frozen=True, slots=True)
class Start:
    """State of an axis at the begin of a move.

    Attributes:
        position_counts: from the command position: minus the following error.
        slack: how far the motor has turned forward within the backlash, as a share of it: 0 after a move in reverse.
    """

    position_counts: int = 0
    slack: float = 0.0


@dataclass(frozen=True, slots=True)
class Response:
    """A move as it ran, one value per servo cycle; positions are counts from the command position at its beginning.

    Attributes:
        times_s: from its start.
        commanded: command positions.
        positions: encoder positions.
        pwm: outputs, -255 to 255.
        tripped: the following error exceeded EL, and the drive gave up.
        shaft_counts: the lowest, the highest and the last place of the shaft, also where the encoder does not show it,
            and while it coasted.
        rest_counts: the encoder's count in the end, after coasting.
    """

    times_s: Floats
    commanded: Floats
    positions: Floats
    pwm: Floats
    tripped: bool = False
    shaft_counts: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rest_counts: int = 0


def simulate(
    profile: Profile,
    plant: Plant | MotorPlant,
    gains: Gains,
    move: TrapezoidMove,
    duration_s: float,
    start: Start | None = None,
    coasting_s: float = 0.0,
) -> Response:
    """Run one move of a drive on a plant.

    Args:
        profile: the dialect.
        plant: the motor with its load.
        gains: its registers.
        move: the commanded move.
        duration_s: from the start of the move.
        start: how the axis stands before; settled on its command position when left out.
        coasting_s: for so long it then coasts with the amplifier off.
    """
    start = start or Start()
    motor = plant.motor() if isinstance(plant, Plant) else plant
    shaft = Shaft(motor, profile.servo_cycle_s)
    stage = PicServoPower()
    stage.enable(on=True)
    loop = ServoLoop(profile, shaft, stage, ModuleSettings(version=0, encoder_counts_per_s=0.0, peak_current_a=0.0))
    loop.set_gains(gains)
    loop.close()
    loop.trajectory.position -= start.position_counts * FRACTION
    shaft.slack_counts = start.slack * motor.backlash_counts
    origin = loop.trajectory.position // FRACTION
    loop.run(REST_CYCLES)
    tick_s = profile.servo_cycle_s * (gains.sr if profile.divisor_slows_profile else 1)
    speed = max(round(move.speed_counts_per_s * tick_s * FRACTION), 1)
    acceleration = max(round(move.acceleration_counts_per_s2 * tick_s**2 * FRACTION), 1)
    loop.trajectory.go_to(origin + move.distance_counts, speed, acceleration)
    cycles = round(duration_s / profile.servo_cycle_s)
    positions, commanded, pwm = [0] * cycles, [0] * cycles, [0] * cycles
    unseen = list[float]()
    for cycle in range(cycles):
        loop.run(1)
        positions[cycle] = loop.position - origin
        commanded[cycle] = loop.trajectory.position // FRACTION - origin
        pwm[cycle] = loop.pwm
        if motor.encoder_disconnected:
            unseen.append(shaft.position_counts)
    tripped, places = loop.faulted, unseen or list(positions)
    loop.open()
    stage.enable(on=False)
    for _ in range(round(coasting_s / profile.servo_cycle_s)):
        loop.run(1)
        places.append(shaft.position_counts if motor.encoder_disconnected else loop.position - origin)
    return Response(
        np.asarray(np.arange(1, cycles + 1) * profile.servo_cycle_s, dtype=np.float64),
        np.array(commanded, dtype=np.float64),
        np.array(positions, dtype=np.float64),
        np.array(pwm, dtype=np.float64),
        tripped=tripped,
        shaft_counts=_range(places),
        rest_counts=loop.position - origin,
    )


def _range(places: Sequence[float]) -> tuple[float, float, float]:
    return (min(places), max(places), places[-1]) if places else (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of a move, for comparison.

    Attributes:
        overshoot: farthest beyond the goal, as a share of the distance.
        settling_s: from the end of the commanded motion until the position stays within the window.
        settled: it stays there for the last tenth of the record at least.
        following_error_counts: the largest.
        error_counts: the position error at the end.
    """

    overshoot: float
    settling_s: float
    settled: bool
    following_error_counts: float
    error_counts: float


def figures(
    times_s: Sequence[float] | Floats,
    positions: Sequence[float] | Floats,
    commanded: Sequence[float] | Floats,
    window_counts: float,
) -> Figures:
    """Return the figures of a record: simulated, or measured with the command positions of the same instants.

    Args:
        times_s: from the start of the move, rising.
        positions: counts.
        commanded: counts; the last one is the goal.
        window_counts: how near to the goal counts as arrived.
    """
    times, position, command = (np.asarray(each, dtype=np.float64) for each in (times_s, positions, commanded))
    goal, distance = command[-1], command[-1] - command[0]
    direction = 1.0 if distance >= 0 else -1.0
    beyond = max(float(np.max((position - goal) * direction)), 0.0)
    arrived = float(times[int(np.argmax(command == goal))])
    outside = np.flatnonzero(np.abs(position - goal) > window_counts)
    last = float(times[outside[-1]]) if len(outside) else 0.0
    return Figures(
        overshoot=beyond / max(float(abs(distance)), 1.0),
        settling_s=max(last - arrived, 0.0),
        settled=last <= float(times[0] + 0.9 * (times[-1] - times[0])),
        following_error_counts=float(np.max(np.abs(command - position))),
        error_counts=float(command[-1] - position[-1]),
    )
