"""The machine on a simulated drive's shaft: motor, load, encoder, limit switches, index pulse, potentiometer.

Time is counted in steps of one servo cycle; the drive says for how many steps which duty was on the motor. This module
is independent of protocols. The motor has no inductance: within a servo cycle its current follows the voltage at once.

A brushless motor with trapezoidal back EMF behind a drive that commutates by Hall sensors is the same as a DC motor: in
each sixth of an electrical turn current flows through two of its three phases, and the torque per ampere is constant.
With one phase open none flows where the pair has that phase: AB, AC, BA and CA of the six AB AC BC BA CA CB. So two
thirds of an electrical turn are without torque, in two spans of 120 degrees. (LS-182AP manual: Hall sensors, 60/120
degrees; PIC-SERVO SC data sheet, 3-phase outputs: the Hall inputs choose one chopped and one low half bridge.)
"""

import math
import random
from collections import deque
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from ldcnd.contract.frozen import Frozen

LIVE_SIXTH = 2
"""Of each half of an electrical turn: the pair without the phase that may be lost."""


CountRange = tuple[int, int]


def _rising(span: CountRange) -> CountRange:
    if span[0] >= span[1]:
        raise ValueError(f"the first number must be below the second, not {span[0]} and {span[1]}")
    return span


RisingRange = Annotated[CountRange, AfterValidator(_rising)]


class PlantConfig(Frozen):
    """The machine on a shaft; what is left out is a small servo motor, 3000 1/min at 24 V.

    Position gains of KP=350 KD=3000 KI=400 IL=400 and of KP=100 KD=1000 KI=50 IL=200 hold it with a damping ratio of
    about 0.7. Positions are encoder counts from where the shaft is at power-up.
    """

    counts_per_rev: int = Field(default=2000, gt=0)
    """Encoder counts of a revolution."""
    supply_v: float = Field(default=24.0, gt=0, le=100)
    """Voltage at full duty."""
    resistance_ohm: float = Field(default=1.2, gt=0)
    """Resistance of the winding, in ohms."""
    torque_nm_per_a: float = Field(default=0.0767, gt=0)
    """Torque constant, and back EMF constant in V s/rad."""
    inertia_kg_m2: float = Field(default=5.0e-5, gt=0)
    """Inertia of motor and load, in kg m2."""
    viscous_nm_s: float = Field(default=1.0e-5, ge=0)
    """Viscous friction per rad/s."""
    friction_nm: float = Field(default=0.004, ge=0)
    """Coulomb friction, also at standstill."""
    stop_margin_counts: int = Field(default=2000, ge=0)
    """Distance of the hard stops behind the limit switches."""
    index_at_counts: int = 700
    """Position at which an index pulse begins, in counts."""
    index_spacing_counts: int | None = Field(default=None, gt=0)
    """Distance from one index pulse to the next, in counts; a revolution when left out."""
    index_width_counts: int = Field(default=4, gt=0)
    """How long a pulse is; 4 is an ungated Z track. Firmware samples it once per servo cycle and may miss it."""
    pot_span_counts: RisingRange = (-105_000, 105_000)
    """The potentiometer turns from 0 to full scale over this range."""
    pot_noise: float = Field(default=0.0, ge=0, le=1)
    """Standard deviation of its reading, as a share of full scale."""
    load_nm: float = 0.0
    """Torque of a hanging load, positive when it pulls forward."""
    delay_s: float = Field(default=0.0, ge=0, le=0.1)
    """Dead time from a change of the output to the torque: the amplifier and the motor's inductance."""
    backlash_counts: float = Field(default=0.0, ge=0)
    """Lost motion between the motor and the encoder, which sits on the load."""
    motor_reversed: bool = False
    """Whether the motor's leads are swapped: a positive output turns it in reverse. Then no position loop holds."""
    phase_lost: bool = False
    """Whether it is a brushless motor behind Hall sensors with one phase open: no torque in two thirds of a turn."""
    pole_pairs: int = Field(default=4, ge=1, le=100)
    """Electrical turns in a revolution of such a motor."""
    encoder_disconnected: bool = False
    """Whether the counter stands still while the shaft turns, and the drive does not notice."""
    coupling_grip: float = Field(default=1.0, ge=0, le=1)
    """Share of the motor's way that reaches the encoder and the load; below 1 the coupling slips."""
    limits_swapped: bool = False
    """Whether each limit switch is wired to the input of the other one."""


class MotorPlant(PlantConfig):
    """A machine with its travel."""

    reverse_limit_counts: int = -100_000
    """The reverse limit switch is actuated here and below."""
    forward_limit_counts: int = 100_000
    """The forward limit switch is actuated here and above."""
    seed: int = 1
    """Seed of the potentiometer's noise."""


class Shaft:
    """The moving part of a machine.

    Attributes:
        position_counts: where the shaft is, with fraction.
        velocity_counts: counts per step.
        stalled: something holds it.
        limits_actuated: both limit switches are, whatever their places.
        reverse_stuck: the reverse limit switch stays closed (True) or open; None where it works. Likewise
            forward_stuck, index_stuck.
        current_limited: the motor would have drawn more current in the last step than the amplifier gives.
        slack_counts: how far the motor has turned forward within the backlash, 0 to all of it.
        delay_steps: largest number of steps for which the motor goes on with the previous output.
    """

    def __init__(self, plant: MotorPlant, step_s: float) -> None:
        self.position_counts = 0.0
        self.velocity_counts = 0.0
        self.stalled = False
        self.limits_actuated = False
        self.reverse_stuck: bool | None = None
        self.forward_stuck: bool | None = None
        self.index_stuck: bool | None = None
        self.current_limited = False
        self.slack_counts = 0.0
        self._step_s = step_s
        self._peak_a = 0.0
        self._dice = random.Random(plant.seed)  # noqa: S311 - reproducible on purpose
        self.become(plant)

    def become(self, plant: MotorPlant) -> None:
        """Let the machine have other constants from now on; it stays where it is and goes on as fast as it does."""
        self.plant = plant
        step_s = self._step_s
        self.delay_steps = math.ceil(plant.delay_s / step_s)
        whole = int(plant.delay_s / step_s)
        self._late_share = plant.delay_s / step_s - whole
        self._on_the_way: deque[float | None] = deque([0.0] * (whole + 1))
        self._backlash = plant.backlash_counts
        self._grip = plant.coupling_grip
        self._sixths_per_count = 6 * plant.pole_pairs / plant.counts_per_rev if plant.phase_lost else 0.0
        self._supply_v = -plant.supply_v if plant.motor_reversed else plant.supply_v
        radians_per_count = math.tau / plant.counts_per_rev
        torque, resistance, inertia = plant.torque_nm_per_a, plant.resistance_ohm, plant.inertia_kg_m2
        counts_per_step = step_s / radians_per_count
        damping_per_s = (torque * torque / resistance + plant.viscous_nm_s) / inertia
        self._driven_decay = math.exp(-damping_per_s * step_s)
        self._coasting_decay = math.exp(-plant.viscous_nm_s / inertia * step_s)
        # the velocity that full duty approaches, times the share of the way that one step covers
        full_duty = torque * self._supply_v / resistance / (inertia * damping_per_s) * counts_per_step
        self._gain = full_duty * (1.0 - self._driven_decay)
        self._friction = plant.friction_nm / inertia * step_s * counts_per_step
        self._load = plant.load_nm / inertia * step_s * counts_per_step
        self._back_emf_v = torque / counts_per_step
        self._change_per_a = torque / inertia * step_s * counts_per_step
        self._lowest = float(plant.reverse_limit_counts - plant.stop_margin_counts)
        self._highest = float(plant.forward_limit_counts + plant.stop_margin_counts)
        self.limit_current(self._peak_a)

    def limit_current(self, peak_a: float) -> None:
        """Let the amplifier give no more than this current; 0 for no limit."""
        self._peak_a = peak_a
        self._peak_v = peak_a * self.plant.resistance_ohm if peak_a else math.inf
        self._peak_change = peak_a * self._change_per_a

    def step(self, duty: float | None) -> None:
        """Let one step pass with a duty of -1 to 1 on the motor, or None with its windings open."""
        before = self.velocity_counts
        self.current_limited = False
        if self.delay_steps:
            duty = self._delayed(duty)
        if duty is None or (self._sixths_per_count and not self._conducts):
            velocity = before * self._coasting_decay
        else:
            winding_v = duty * self._supply_v - self._back_emf_v * before
            if -self._peak_v <= winding_v <= self._peak_v:
                velocity = before * self._driven_decay + duty * self._gain
            else:
                self.current_limited = True
                velocity = before * self._coasting_decay + math.copysign(self._peak_change, winding_v)
        velocity += self._load
        if velocity > self._friction:
            velocity -= self._friction
        elif velocity < -self._friction:
            velocity += self._friction
        else:
            velocity = 0.0
        if self.stalled:
            velocity = before = 0.0
        if velocity == 0.0 == before:
            self.velocity_counts = 0.0
            return
        way = 0.5 * (before + velocity) * self._grip
        position = self.position_counts + (self._transmitted(way) if self._backlash else way)
        if not self._lowest < position < self._highest:
            position = min(max(position, self._lowest), self._highest)
            velocity = 0.0
        self.position_counts = position
        self.velocity_counts = velocity

    def _delayed(self, duty: float | None) -> float | None:
        """Return the output that reaches the motor now, interpolated between two outputs by the dead time."""
        on_the_way = self._on_the_way
        on_the_way.append(duty)
        earlier = on_the_way.popleft()
        later = on_the_way[0]
        if earlier is None or later is None:
            return later
        return later + (earlier - later) * self._late_share

    def _transmitted(self, way: float) -> float:
        """Return how far the load goes when the motor goes this way."""
        slack = self.slack_counts + way
        self.slack_counts = min(max(slack, 0.0), self._backlash)
        return slack - self.slack_counts

    @property
    def _conducts(self) -> bool:
        """Whether current can flow: both phases of the pair that is on are connected."""
        sixth = math.floor(self.position_counts * self._sixths_per_count) % 3
        return sixth == LIVE_SIXTH or not self._sixths_per_count

    def current_a(self, duty: float | None) -> float:
        """Return the motor current with that duty on the motor, positive when it drives forward."""
        if duty is None or not self._conducts:
            return 0.0
        winding_v = duty * self._supply_v - self._back_emf_v * self.velocity_counts
        return min(max(winding_v, -self._peak_v), self._peak_v) / self.plant.resistance_ohm

    @property
    def on_reverse_limit(self) -> bool:
        """Whether the input of the reverse limit switch shows it actuated."""
        if self.reverse_stuck is not None:
            return self.reverse_stuck
        return self.limits_actuated or self._is_on("forward" if self.plant.limits_swapped else "reverse")

    @property
    def on_forward_limit(self) -> bool:
        """Whether the input of the forward limit switch shows it actuated."""
        if self.forward_stuck is not None:
            return self.forward_stuck
        return self.limits_actuated or self._is_on("reverse" if self.plant.limits_swapped else "forward")

    def _is_on(self, switch: Literal["reverse", "forward"]) -> bool:
        """Tell whether the shaft is on a limit switch."""
        if switch == "reverse":
            return self.position_counts <= self.plant.reverse_limit_counts
        return self.position_counts >= self.plant.forward_limit_counts

    @property
    def on_index(self) -> bool:
        """Whether the encoder's index is in its pulse."""
        if self.index_stuck is not None:
            return self.index_stuck
        plant = self.plant
        spacing = plant.index_spacing_counts or plant.counts_per_rev
        return (math.floor(self.position_counts) - plant.index_at_counts) % spacing < plant.index_width_counts

    def potentiometer(self) -> float:
        """Read the potentiometer: 0 to 1 of full scale, a new sample of its noise each time."""
        low, high = self.plant.pot_span_counts
        share = (self.position_counts - low) / (high - low)
        if self.plant.pot_noise:
            share += self._dice.gauss(0.0, self.plant.pot_noise)
        return min(max(share, 0.0), 1.0)
