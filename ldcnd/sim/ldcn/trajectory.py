"""The profile generator of a simulated servo drive: where the motor should be at each servo tick, in integers.

Positions, velocities and accelerations are 16.16 fixed-point numbers of counts and servo ticks. Each tick the velocity
changes first, by the acceleration at most, and the command position moves by it. The manuals describe the shape only
(PIC-SERVO manual, 4.4; LS-182AP manual, "Servo Control"); the order within a tick is chosen here. A trapezoidal move
keeps the velocity as high as it can still be taken down, tick by tick, before the goal, and ends on it exactly.
"""

from ldcnd.drivers.ldcn.registers import FRACTION
from ldcnd.drivers.ldcn.trajectory import ProfileMode


class ProfileGenerator:
    """The command position and how it moves.

    Attributes:
        mode: which profile runs.
        position: command position, 16.16.
        velocity: command velocity, 16.16, signed.
        acceleration: 16.16, the rate of the last started motion; stopping smoothly uses it too.
        accel_done: the initial acceleration of the trapezoidal move is over.
        slew_done: its slew part is over.
        done: the goal position, or in velocity mode the goal velocity, has been reached.
    """

    def __init__(self) -> None:
        self.mode = ProfileMode.VELOCITY
        self.position = 0
        self.velocity = 0
        self.acceleration = 0
        self.accel_done = False
        self.slew_done = False
        self.done = True
        self._goal = 0  # 16.16: a position in trapezoidal mode, a signed velocity in velocity mode
        self._top_speed = 0
        self._direction = 1

    @property
    def at_rest(self) -> bool:
        """Whether a tick would change nothing."""
        return self.done and self.velocity == 0

    @property
    def slewing(self) -> bool:
        """Whether a trapezoidal move is in the part with constant velocity."""
        return self.mode is ProfileMode.TRAPEZOIDAL and self.accel_done and not self.slew_done

    def go_to(self, counts: int, speed: int, acceleration: int) -> None:
        """Start a trapezoidal move from standstill, whatever the velocity was.

        Args:
            counts: the goal.
            speed: 16.16 counts per tick, at least 0.
            acceleration: 16.16 counts per tick squared, at least 0.
        """
        self.mode = ProfileMode.TRAPEZOIDAL
        self.velocity = 0
        self.acceleration = acceleration
        self._top_speed = speed
        self._goal = counts * FRACTION
        self._begin()

    def run_at(self, velocity: int, acceleration: int) -> None:
        """Change to a signed velocity, 16.16 counts per tick."""
        self.mode = ProfileMode.VELOCITY
        self.acceleration = acceleration
        self._goal = velocity
        self.accel_done = self.slew_done = False
        self.done = self.velocity == velocity

    def stop_smoothly(self) -> None:
        """Ramp down to standstill at the acceleration in force."""
        self.run_at(0, self.acceleration)

    def stop_abruptly(self) -> None:
        """Stand still at once."""
        self.velocity = 0
        self.run_at(0, self.acceleration)

    def jump_to(self, counts: int) -> None:
        """Stand still at a position, without any profile."""
        self.position = counts * FRACTION
        self.stop_abruptly()

    def add_offset(self, counts: int) -> None:
        """Move the goal of the running trapezoidal move.

        The manual allows that only while slewing and announces a position error otherwise: then the command position
        jumps by the offset.
        """
        slewing = self.slewing
        self._goal += counts * FRACTION
        if not slewing:
            self.position += counts * FRACTION

    def follow(self, counts: int, velocity_counts: int) -> None:
        """Take over the motor's position and velocity while the servo is off."""
        self.mode = ProfileMode.VELOCITY
        self.position = counts * FRACTION
        self.velocity = self._goal = velocity_counts * FRACTION
        self.done = True

    def renumber(self, counts: int) -> None:
        """Call the present command position by another number; a running trapezoidal move keeps its goal's number."""
        self.position = counts * FRACTION

    def shift(self, counts: int) -> None:
        """Call every position by another number, the goal included."""
        self.position += counts * FRACTION
        if self.mode is ProfileMode.TRAPEZOIDAL:
            self._goal += counts * FRACTION

    def step(self) -> None:
        """Let one servo tick pass."""
        if self.mode is ProfileMode.VELOCITY:
            if not self.done:
                self._ramp()
        elif not self.done:
            self._approach()
        self.position += self.velocity

    def _begin(self) -> None:
        self.accel_done = self.slew_done = False
        self.done = self._goal == self.position
        if self.done:
            self.accel_done = self.slew_done = True
        self._direction = 1 if self._goal > self.position else -1

    def _ramp(self) -> None:
        """Bring the velocity nearer to the goal velocity."""
        missing = self._goal - self.velocity
        if abs(missing) <= self.acceleration:
            self.velocity = self._goal
            self.done = True
        elif missing > 0:
            self.velocity += self.acceleration
        else:
            self.velocity -= self.acceleration

    def _approach(self) -> None:
        """Choose this tick's velocity: the fastest that can still be taken down before the goal."""
        direction, acceleration = self._direction, self.acceleration
        remaining = (self._goal - self.position) * direction
        speed = self.velocity * direction
        if remaining == 0 and speed <= acceleration:
            self.velocity = 0
            self.accel_done = self.slew_done = self.done = True
            return
        if 0 < remaining <= min(acceleration, self._top_speed) and speed - remaining <= acceleration:
            self.velocity = remaining * direction
            self.accel_done = self.slew_done = True
            return
        if not self.accel_done:
            faster = min(speed + acceleration, self._top_speed)
            if faster > speed and self._way(faster) <= remaining:
                self.velocity = faster * direction
                self.accel_done = faster == self._top_speed
                return
        if self._way(speed) <= remaining:
            self.accel_done = self.accel_done or speed > 0
            return
        self.accel_done = self.slew_done = True
        self.velocity = max(0, speed - acceleration) * direction
        if self.velocity == 0:
            # only after the goal was moved too near: come back to it
            self._begin()

    def _way(self, speed: int) -> int:
        """Return how far a tick at this speed and the slowing down after it go."""
        acceleration = self.acceleration
        if speed <= acceleration:
            return speed
        ticks = (speed - 1) // acceleration if acceleration else 0
        return speed * (ticks + 1) - acceleration * (ticks * (ticks + 1) // 2)
