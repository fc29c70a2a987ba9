"""Machines at work as an observer sees them, and what goes wrong with them."""

import math
import random
from collections.abc import Iterator
from dataclasses import replace

from ldcnd.bench.tuning.design import stiff_gains, within_authority
from ldcnd.bench.tuning.effort import SeenPosition
from ldcnd.bench.tuning.identify import Identified
from ldcnd.bench.tuning.plant import Plant
from ldcnd.bench.tuning.response import TrapezoidMove
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.drives.ldcn.registers import FRACTION
from ldcnd.sim.ldcn.power import PicServoPower
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.ldcn.servo import ServoLoop
from ldcnd.sim.plant import MotorPlant, Shaft
from tests.support.simulated_plants import DrawnPlant

MOTOR_SHARE = 0.4
"""Of the inertia; the rest is the load behind the coupling."""
TIMING_S = 0.0003
"""Largest error of the instant of a sample, seconds."""
PAUSE_S = 0.25
"""At rest after each motion, seconds."""


class SlippingShaft(Shaft):
    """A motor with its encoder, and a load behind a coupling that transmits so much torque and no more.

    Args:
        plant: motor and load together.
        step_s: a servo cycle.
        torque_nm: at most.
    """

    def __init__(self, plant: MotorPlant, step_s: float, torque_nm: float) -> None:
        super().__init__(plant.model_copy(update={"inertia_kg_m2": plant.inertia_kg_m2 * MOTOR_SHARE}), step_s)
        counts_per_step = step_s / (math.tau / plant.counts_per_rev)
        # the change of the relative speed by full torque in one step, counts a step
        self._most = torque_nm * step_s * counts_per_step / plant.inertia_kg_m2
        self._load_counts = 0.0

    def step(self, duty: float | None) -> None:
        """Let one step pass."""
        super().step(duty)
        wanted = (self.velocity_counts - self._load_counts) * MOTOR_SHARE * (1 - MOTOR_SHARE)
        passed = min(max(wanted, -self._most), self._most)
        self.velocity_counts -= passed / MOTOR_SHARE
        self._load_counts += passed / (1 - MOTOR_SHARE)


class AxisAtWork:
    """A tuned machine that moves there and back, by distances and with velocities that are drawn.

    Args:
        profile: the dialect.
        drawn: the machine.
        sample_s: between two published positions, seconds.
        knowledge: largest error of the identified values, as a share.

    Attributes:
        profile: the dialect.
        plant: as identified.
        gains: in force.
    """

    def __init__(self, profile: Profile, drawn: DrawnPlant, sample_s: float = 0.01, knowledge: float = 0.05) -> None:
        self._dice = dice = random.Random(drawn.number)
        self.profile, self._motor = profile, drawn.motor
        self._sample_s = sample_s
        true = Plant.of(drawn.motor)
        self.plant = replace(
            true,
            acceleration=true.acceleration * (1 + dice.uniform(-knowledge, knowledge)),
            damping_per_s=true.damping_per_s * (1 + 2 * dice.uniform(-knowledge, knowledge)),
        )
        self.gains = stiff_gains(profile, Identified(true, Plant(0, 0), 0.0))
        turn = drawn.motor.counts_per_rev
        self.move = within_authority(true, TrapezoidMove(2 * turn, 6.0 * turn, 60.0 * turn))
        self._shaft = Shaft(drawn.motor, profile.servo_cycle_s)
        stage = PicServoPower()
        stage.enable(on=True)
        settings = ModuleSettings(version=0, encoder_counts_per_s=0.0, peak_current_a=0.0)
        self._loop = ServoLoop(profile, self._shaft, stage, settings)
        self._loop.set_gains(self.gains)
        self._loop.close()
        self._place, self._t_s, self._forward = 0, 0.0, True

    def becomes(self, shaft: Shaft) -> None:
        """Let another machine be in the place of this one, at rest."""
        shaft.position_counts = self._loop.shaft.position_counts
        shaft.slack_counts = self._loop.shaft.slack_counts
        self._loop.shaft = shaft

    def gets(self, **changes: float) -> None:
        """Let values of the machine be multiplied by these."""
        values = {name: getattr(self._motor, name) * factor for name, factor in changes.items()}
        self._motor = self._motor.model_copy(update=values)
        self.becomes(Shaft(self._motor, self.profile.servo_cycle_s))

    def slips(self, share: float) -> None:
        """Let the coupling transmit this share of what the load needs in a usual motion."""
        radians = math.tau / self._motor.counts_per_rev
        needed = self.move.acceleration_counts_per_s2 * radians * self._motor.inertia_kg_m2 * (1 - MOTOR_SHARE)
        self.becomes(SlippingShaft(self._motor, self.profile.servo_cycle_s, share * needed))

    def loses_phase(self) -> None:
        """Let one phase of its motor be open."""
        self._motor = self._motor.model_copy(update={"phase_lost": True})
        self.becomes(Shaft(self._motor, self.profile.servo_cycle_s))

    @property
    def tripped(self) -> bool:
        """Whether the drive has opened its loop by itself: no motion follows."""
        return self._loop.faulted

    def motion(self) -> Iterator[SeenPosition]:
        """Move once; yield what is published meanwhile, and of the rest after it."""
        dice, loop, cycle_s = self._dice, self._loop, self.profile.servo_cycle_s
        tick_s = cycle_s * (self.gains.sr if self.profile.divisor_slows_profile else 1)
        way = round(self.move.distance_counts * dice.uniform(0.4, 1.0)) * (1 if self._forward else -1)
        self._place, self._forward = way if self._forward else 0, not self._forward
        speed = self.move.speed_counts_per_s * dice.uniform(0.6, 1.0)
        acceleration = self.move.acceleration_counts_per_s2
        loop.trajectory.go_to(
            self._place,
            max(round(speed * tick_s * FRACTION), 1),
            max(round(acceleration * tick_s**2 * FRACTION), 1),
        )
        until_s, left = math.inf, dice.randrange(round(self._sample_s / cycle_s))
        while self._t_s < until_s and not self.tripped:
            loop.run(left)
            self._t_s += left * cycle_s
            if until_s == math.inf and loop.trajectory.done:
                until_s = self._t_s + PAUSE_S
            yield SeenPosition(self._t_s + dice.uniform(-TIMING_S, TIMING_S), loop.position, loop.following_error)
            left = round(self._sample_s * dice.uniform(0.95, 1.05) / cycle_s)
