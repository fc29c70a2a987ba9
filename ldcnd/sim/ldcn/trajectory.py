"""The profile generator of a simulated servo drive: where the motor should be at each servo tick, in integers.

Positions, velocities and accelerations are 16.16 fixed-point numbers of counts and servo ticks. Each tick the velocity
changes first, by the acceleration at most, and the command position moves by it. The manuals describe the shape only
(PIC-SERVO manual, 4.4; PIC-SERVO SC data sheet, 4.4; LS-182AP manual, "Servo Control"); the order within a tick is
chosen here.

In trapezoidal mode every tick takes the highest velocity that both limits allow and from which the motor still stops on
its goal. That is the whole profile: it ends on the goal exactly, it may be given another goal or other limits at any
time, and where the goal can no longer be reached in time it overshoots, reverses and comes back.

A path walks through the points of a buffer at constant velocity each, and ends without a ramp when they are used up.
"""

from collections import deque
from collections.abc import Iterable
from math import isqrt

from ldcnd.drives.ldcn.registers import FRACTION
from ldcnd.drives.ldcn.trajectory import REVERSE, SPEED_MASK, ProfileMode, point_cycles
from ldcnd.sim.ldcn.quirks import ModuleSettings, PathOverflow

_SPEED_SHIFT = 8
"""A point's word is its speed in 1/256 count per cycle."""


class PathBuffer:
    """The points that are left, and the one under way.

    Attributes:
        running: the path has been started and neither ended nor been stopped.
        fast: the fast path option as last set.
        blocked: limit protection holds the axis while the points are used up.
        velocity: of the point under way, 16.16; 0 without one.
    """

    def __init__(self, capacity: int, quirks: ModuleSettings) -> None:
        self.running = False
        self.fast = False
        self.blocked = False
        self._capacity = capacity
        self._quirks = quirks
        self._points: deque[tuple[int, bool]] = deque()
        self.velocity = 0
        self._cycles_left = 0

    @property
    def points_left(self) -> int:
        """Status item 7, 0 to the capacity."""
        under_way = self._quirks.path_counts_point_under_way and self._cycles_left > 0
        return min(len(self._points) + under_way, self._capacity)

    @property
    def path_mode(self) -> bool:
        """Auxiliary bit 6."""
        return self.running and (bool(self._points) or not self._quirks.path_ends_with_buffer)

    def add(self, words: Iterable[int]) -> None:
        """Append points."""
        points = [(word, self.fast) for word in words]
        room = self._capacity - len(self._points)
        if len(points) > room:
            match self._quirks.path_overflow:
                case PathOverflow.DROP_EXCESS:
                    points = points[:room]
                case PathOverflow.DROP_PACKET:
                    points = []
                case PathOverflow.OVERWRITE:
                    for _ in range(len(points) - room):
                        self._points.popleft()
        self._points.extend(points)

    def start(self) -> bool:
        """Begin with the first point, or with the next one where that is a switch; tell whether a path runs."""
        if self.running:
            if self._quirks.path_restarts:
                self._cycles_left = 0
                self.running = bool(self._points)
        elif self._points or self._quirks.path_starts_empty:
            self.running = True
            self.blocked = False
            self._cycles_left = 0
        return self.running

    def block(self) -> None:
        """Hold the axis from now on."""
        self.blocked = True
        self.velocity = 0

    def end(self, *, clear: bool) -> None:
        """Stop walking through the points."""
        self.running = False
        self._cycles_left = self.velocity = 0
        if clear:
            self._points.clear()

    def step(self) -> int:
        """Let one cycle pass; return its velocity, 16.16. With the last cycle of the last point the path ends."""
        if self._cycles_left == 0 and not self._points:
            return 0  # started with an empty buffer
        if self._cycles_left == 0:
            word, fast_at_load = self._points.popleft()
            fast = fast_at_load if self._quirks.path_rate_at_load else self.fast
            self._cycles_left = point_cycles(word, fast_path=fast)
            speed = (word & SPEED_MASK) << _SPEED_SHIFT
            self.velocity = 0 if self.blocked else -speed if word & REVERSE else speed
        velocity = self.velocity
        self._cycles_left -= 1
        if self._cycles_left == 0 and not self._points:
            self.end(clear=False)
        return velocity


class ProfileGenerator:
    """The command position and how it moves.

    Attributes:
        mode: which profile runs, unless a path does.
        position: command position, 16.16.
        velocity: command velocity, 16.16, signed.
        acceleration: 16.16, the rate of the last started motion; stopping smoothly uses it too.
        accel_done: the initial acceleration of the trapezoidal move is over.
        slew_done: its slew part is over.
        accelerating: the last tick made the motion faster.
        steady: the last tick left the velocity as it was.
        done: the goal position, or in velocity mode the goal velocity, has been reached.
        path: the buffer of path points; empty for ever on devices without path mode.
    """

    def __init__(self, path: PathBuffer | None = None) -> None:
        self.mode = ProfileMode.VELOCITY
        self.position = 0
        self.velocity = 0
        self.acceleration = 0
        self.accel_done = False
        self.slew_done = False
        self.accelerating = False
        self.steady = True
        self.done = True
        self.path = path or PathBuffer(0, ModuleSettings(version=0))
        self._goal = 0  # 16.16: a position in trapezoidal mode, a signed velocity in velocity mode
        self._top_speed = 0
        self._braking_way = 0  # from top speed to standstill

    @property
    def at_rest(self) -> bool:
        """Whether a tick would change nothing."""
        return self.done and self.velocity == 0 and not self.path.running

    @property
    def slewing(self) -> bool:
        """Whether a trapezoidal move is in the part with constant velocity."""
        return self.mode is ProfileMode.TRAPEZOIDAL and self.accel_done and not self.slew_done

    def go_to(self, counts: int, speed: int, acceleration: int, *, from_velocity: bool = False) -> None:
        """Start a trapezoidal move.

        Args:
            counts: the goal.
            speed: 16.16 counts per tick, at least 0.
            acceleration: 16.16 counts per tick squared, at least 0.
            from_velocity: with the velocity that it has; without, the command velocity jumps to 0 first.
        """
        self.mode = ProfileMode.TRAPEZOIDAL
        if not from_velocity:
            self.velocity = 0
        self.acceleration = acceleration
        self._top_speed = speed
        ticks = speed // acceleration + 1 if acceleration else 0
        self._braking_way = speed * (ticks + 1)
        self._goal = counts * FRACTION
        self.done = self._goal == self.position and self.velocity == 0
        self.accel_done = self.slew_done = self.done

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

    def start_path(self) -> None:
        """Walk through the path points, if there are any; the profile that ran before is over."""
        if self.path.start():
            self.stop_abruptly()

    def add_offset(self, counts: int) -> None:
        """Move the goal of the running trapezoidal move.

        The LS-182AP manual allows that only while slewing and announces a position error otherwise: then the command
        position jumps by the offset.
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
        self.done = self.steady = True
        self.accelerating = False

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
        if self.path.running:
            self.position += self.path.step()
            return
        if self.done:
            self.steady = True
            self.accelerating = False
        else:
            before = self.velocity
            if self.mode is ProfileMode.VELOCITY:
                self._ramp()
            else:
                self._approach()
            if self.velocity == before:
                self.steady = True
                self.accelerating = False
            else:
                faster = abs(self.velocity) - abs(before)
                self.accelerating = faster > 0
                self.steady = faster == 0
        self.position += self.velocity

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
        """Choose this tick's velocity: the highest that both limits and the way to the goal allow."""
        acceleration = self.acceleration
        remaining = self._goal - self.position
        if remaining == 0 and abs(self.velocity) <= acceleration:
            self.velocity = 0
            self.accel_done = self.slew_done = self.done = True
            return
        direction = 1 if remaining > 0 else -1
        speed = self.velocity * direction
        way = remaining * direction
        new = top = self._top_speed
        if way < self._braking_way:
            new = min(top, self._stopping_speed(way))
        # in every servo tick: min() and max() cost twice as much
        if new > speed + acceleration:
            new = speed + acceleration
        elif new < speed - acceleration:
            new = speed - acceleration
        if 0 <= new < speed:
            self.accel_done = self.slew_done = True
        elif new > 0 and new in (top, speed):
            self.accel_done = True
        self.velocity = new * direction

    def _stopping_speed(self, way: int) -> int:
        """Return the highest speed of a tick from which slowing down tick by tick ends within this way."""
        acceleration = self.acceleration
        if not acceleration:
            return way
        ticks = (isqrt(1 + 8 * (way // acceleration)) - 1) // 2
        return (way + acceleration * (ticks * (ticks + 1) // 2)) // (ticks + 1)
