"""A motor that follows a pulse train through a position loop, in closed form: any step in time is one calculation.

Units inside: encoder counts and seconds. The loop is of first order, deviation' = reference speed - gain x deviation,
which is what a stiff speed loop leaves of it.
"""

import math
from dataclasses import dataclass

_FRICTION_PERCENT = 5.0
_PERCENT_PER_COUNT_S2 = 2e-4
_JAM_PERCENT_PER_COUNT = 0.5
_COAST_S = 0.05
_TREMBLE_PERIOD_S = 0.0073


@dataclass(slots=True)
class SimulatedMotor:
    """Where the motor is and how it moves; public fields may be changed between two calls of `advance`.

    Attributes:
        pulse_rate: command units per second, signed; what the pulse generator sends.
        gear: encoder counts per command unit.
        gain: of the position loop, 1/s.
        servo_on: otherwise the motor coasts to rest and the deviation counter stays at zero.
        jammed: the shaft is held.
        load_percent: a constant torque of the load.
        tremble: the feedback jumps between its value and this much more, as on the edge of a count.
    """

    counts_per_rev: int = 8000
    pulse_rate: float = 0.0
    gear: float = 4.0
    gain: float = 40.0
    servo_on: bool = False
    jammed: bool = False
    load_percent: float = 0.0
    tremble: int = 0
    at_s: float = 0.0
    command_units: float = 0.0
    position: float = 0.0
    deviation: float = 0.0
    speed: float = 0.0
    acceleration: float = 0.0

    def advance(self, to_s: float) -> None:
        """Move on in time; an earlier time changes nothing."""
        step_s = to_s - self.at_s
        if step_s <= 0:
            return
        self.at_s = to_s
        self.command_units += self.pulse_rate * step_s
        if not self.servo_on:
            self._coast(step_s)
        elif self.jammed:
            self.deviation += self.reference_speed * step_s
            self.speed = self.acceleration = 0.0
        else:
            self._follow(step_s)

    @property
    def reference_speed(self) -> float:
        """The pulse train in counts per second."""
        return self.pulse_rate * self.gear

    @property
    def feedback(self) -> int:
        """The encoder's count, trembling included."""
        up = self.tremble if int(self.at_s / _TREMBLE_PERIOD_S) % 2 else 0
        return math.floor(self.position) + up

    @property
    def torque_percent(self) -> float:
        """Torque of rated, unlimited."""
        if not self.servo_on:
            return 0.0
        if self.jammed:
            return self.load_percent + _JAM_PERCENT_PER_COUNT * self.deviation
        friction = math.copysign(_FRICTION_PERCENT, self.speed) if abs(self.speed) > 1.0 else 0.0
        return self.load_percent + friction + _PERCENT_PER_COUNT_S2 * self.acceleration

    def rpm(self, counts_per_s: float) -> float:
        """Return counts per second as r/min."""
        return counts_per_s * 60.0 / self.counts_per_rev

    def _coast(self, step_s: float) -> None:
        fading = math.exp(-step_s / _COAST_S)
        self.position += self.speed * _COAST_S * (1.0 - fading)
        self.speed *= fading
        self.acceleration = -self.speed / _COAST_S
        self.deviation = 0.0

    def _follow(self, step_s: float) -> None:
        settled = self.reference_speed / self.gain
        before = self.deviation
        self.deviation = settled + (before - settled) * math.exp(-self.gain * step_s)
        self.position += self.reference_speed * step_s - (self.deviation - before)
        self.speed = self.gain * self.deviation
        self.acceleration = self.gain * (self.reference_speed - self.speed)
