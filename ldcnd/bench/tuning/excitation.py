"""The moves from which an axis is identified and judged, one trial after the other; bounded in what they may do.

A trial begins and ends at standstill with the loop open, so each one starts where the axis is. This module says what
to try next from what was shown; who tries it is a session with a rig, or a simulated machine.

* Pulses find out whether the encoder counts the motor's way, and at which output the axis gives way. They have a
  derivative gain only: the drive adds output for as long as the command position moves and takes it away by itself,
  whatever the host does. So a motor whose encoder is disconnected turns for some milliseconds, and brakes.
* Soft moves have so little output that a runaway is slow, and an error limit just beyond their distance.
* Stiff moves are short. Only they show the dead time.
* Test moves go there and back with gains that are to be judged.
"""

import math
from collections.abc import Generator
from dataclasses import dataclass, replace
from enum import StrEnum

from ldcnd.bench.machine_faults import STANDS, MachineFault, fault_found
from ldcnd.bench.tuning.plant import FULL_PWM
from ldcnd.bench.tuning.response import Start, TrapezoidMove
from ldcnd.contract.errors import DriveFault, ValueOutOfRange
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.profiles import Profile

LEAST_WITHIN_COUNTS = 200
"""Within less than this, moves are too short to tell of an axis, counts."""
PULSE_TICKS = 10
"""Servo ticks in which the command of a pulse moves: also for how long it gives output."""
FASTEST_PULSE_SHARE = 1 / 600
"""Share of the distance that the command of a pulse moves in a tick at most."""
MOST_PULSE_LEVEL = 100
MOST_IMPULSE = 1000.0
"""Most that a pulse may be: PWM steps times servo ticks."""
SEEN_COUNTS = 2
"""An axis that has moved so far has moved: one count is noise."""
PULSE_MARGIN_COUNTS = 20
PULSE_MARGIN_SHARE = 0.05
"""An axis may run away in a pulse by these counts, or this share of the distance, before the drive opens its loop."""
PULSE_S = 0.25
ALL_PULSES = 2
"""Each level of pulses is half of the next: all of one direction together are at most so many times the last one."""
MOST_SOFT_LEVEL = 64
"""Largest output of a soft or a stiff move, PWM steps."""
FIRST_SOFT_SHARE = 1 / 4
"""Soft moves begin at this share of the output at which the axis gave way to a pulse."""
LEAST_SOFT_LEVEL = 5.0
"""With less output, PWM steps, the steps themselves hide what a trace could tell."""
SOFT_STEP = 1.5
SOFT_SHARE = 0.6
"""A soft move has arrived with this share of its distance: friction holds it there."""
SOFT_AUTHORITY = 1.5
"""The output limit of a soft move is so many times what friction and load hold at rest, at least: with less, the way
tells by how much the output exceeds friction, and not the inertia."""
FRACTION_OF_GAIN = 256
"""The drive divides what its gains make by this."""
SOFT_S = 0.6
MOST_SOFT_S = 2.4
"""A soft move lasts `SOFT_S`; where the axis is not at rest by then, it is made again with twice the time, seconds."""
STILL_S = 0.025
"""A record whose last counts are the same for so long has come to rest, seconds."""
SOFT_DERIVATIVE_TICKS = 8
STIFF_S = 0.3
BOTH_WAYS = 2
"""Records of a move: one there, one back."""
FELL_COUNTS = 10
FELL_SHARE = 0.1
"""An axis that goes farther than both by itself when the loop opens, falls: counts, and share of its move."""
NOT_FOLLOWING = (
    MachineFault.BRAKE,
    MachineFault.AT_END,
    MachineFault.HEAVY,
    MachineFault.COUPLING,
    MachineFault.NO_SUPPLY,
    MachineFault.LOAD_HANGS,
)
MOST_ERROR_LIMIT = 0x3FFF
"""Largest EL that `set_gains` takes, counts; some drives would take more."""


class Purpose(StrEnum):
    """What a trial is for."""

    PULSE = "pulse"
    SOFT = "soft"
    STIFF = "stiff"
    TEST = "test"


@dataclass(frozen=True, slots=True)
class Bounds:
    """What an axis may be asked to do.

    Attributes:
        within_counts: it stays so near to where it stood at the beginning.
        velocity_counts_per_s: the highest command velocity.
        acceleration_counts_per_s2: the highest command acceleration.
    """

    within_counts: int
    velocity_counts_per_s: float = math.inf
    acceleration_counts_per_s2: float = math.inf

    def move(
        self, distance_counts: int, velocity_counts_per_s: float, acceleration_counts_per_s2: float
    ) -> TrapezoidMove:
        """Return a move no faster than this axis may go."""
        return TrapezoidMove(
            distance_counts,
            min(velocity_counts_per_s, self.velocity_counts_per_s),
            min(acceleration_counts_per_s2, self.acceleration_counts_per_s2),
        )


@dataclass(frozen=True, slots=True)
class Trial:
    """One move to be made.

    Attributes:
        purpose: what it is for.
        gains: to be loaded before the loop is closed.
        move: from where the axis stands then.
        start: how the axis stands before.
        lasts_s: from its begin until the loop is opened.
    """

    purpose: Purpose
    gains: Gains
    move: TrapezoidMove
    start: Start
    lasts_s: float


@dataclass(frozen=True, slots=True)
class MoveRecord:
    """The trace of one move that began at standstill.

    Attributes:
        gains: the registers in force.
        move: the commanded move.
        start: how the axis stood.
        times_s: of the samples, rising; when the move began is not known better than by the trace itself.
        positions: counts from the command position before the move.
    """

    gains: Gains
    move: TrapezoidMove
    start: Start
    times_s: tuple[float, ...]
    positions: tuple[int, ...]

    @property
    def ends_at_rest(self) -> bool:
        """Whether the axis had come to rest by the end of the trace."""
        last = self.positions[-1]
        return all(
            at == last
            for time_s, at in zip(self.times_s, self.positions, strict=True)
            if time_s >= self.times_s[-1] - STILL_S
        )


@dataclass(frozen=True, slots=True)
class TrialOutcome:
    """What became of a trial.

    Attributes:
        record: the trace, with the move as the drive had it.
        tripped: the drive gave up.
        rest_counts: where the axis came to rest, from where it stood before.
    """

    record: MoveRecord
    tripped: bool
    rest_counts: int


Trials = Generator[Trial, TrialOutcome, tuple[MoveRecord, ...]]


class Excitation:
    """The trials of one axis, in the order of the methods; keeps account of where it stands.

    Args:
        profile: the dialect.
        bounds: what the axis may be asked to do.
        offset_counts: where it stands, from where it stood at the beginning.

    Attributes:
        offset_counts: where it stands now, likewise.
        level: output at which the axis gave way to pulses, PWM steps.
        farthest_counts: from where it stood at the beginning, as seen in the traces.

    Raises:
        ValueOutOfRange: within these bounds nothing can be found out.
    """

    def __init__(self, profile: Profile, bounds: Bounds, offset_counts: int = 0) -> None:
        if bounds.within_counts < LEAST_WITHIN_COUNTS:
            raise ValueOutOfRange(
                f"moves within {bounds.within_counts} counts tell too little of an axis",
                value=bounds.within_counts,
                limit=LEAST_WITHIN_COUNTS,
                remedy=f"allow at least {LEAST_WITHIN_COUNTS} counts",
            )
        self.level = 1
        self.offset_counts = offset_counts
        self.farthest_counts = abs(offset_counts)
        self._profile = profile
        self._bounds = bounds
        self._slack = 0.0

    @property
    def most_impulse(self) -> float:
        """The largest pulse, PWM steps times ticks.

        Without any friction a motor is carried by a pulse as far as full output would carry it in the same share of the
        time. It is taken to be no faster at full output than its drive can count. A load may keep it from coming back,
        so all pulses of one direction together stay within the distance.
        """
        profile = self._profile
        full_counts = profile.encoder_counts_per_s * profile.servo_cycle_s / FULL_PWM
        return min(self._bounds.within_counts / full_counts / ALL_PULSES, MOST_IMPULSE)

    @property
    def pulse_counts(self) -> int:
        """By how much the command of a pulse moves in a servo tick, counts; it reaches that within a pulse.

        The more, the less a single count of the axis changes the output: with one count a tick, the loop of a light
        motor with a fine encoder rings before friction gives way.
        """
        bounds, cycle_s = self._bounds, self._profile.servo_cycle_s
        return max(
            1,
            int(
                min(
                    FASTEST_PULSE_SHARE * bounds.within_counts,
                    bounds.velocity_counts_per_s * cycle_s,
                    bounds.acceleration_counts_per_s2 * cycle_s**2 * PULSE_TICKS,
                )
            ),
        )

    def pulses(self) -> Trials:
        """Find the output at which the axis gives way, and whether its encoder then counts the motor's way.

        Raises:
            DriveFault: it counts the other way, or not at all.
        """
        most = min(max(int(self.most_impulse / PULSE_TICKS), 1), MOST_PULSE_LEVEL)
        margin = max(PULSE_MARGIN_COUNTS, int(PULSE_MARGIN_SHARE * self._bounds.within_counts))
        counts, cycle_s = self.pulse_counts, self._profile.servo_cycle_s
        limit = min(PULSE_TICKS * counts + margin, MOST_ERROR_LIMIT)
        silent = [1, -1]
        fell_counts = 0
        for halvings in reversed(range(most.bit_length())):
            self.level = most >> halvings
            for direction in tuple(silent):  # a load may make one of them easier
                kd = math.ceil(FRACTION_OF_GAIN * self.level / counts)
                gains = Gains(kp=0, kd=kd, ki=0, il=0, ol=self.level, cl=0, el=limit, sr=1)
                move = self._bounds.move(direction * PULSE_TICKS * counts, counts / cycle_s, counts / cycle_s**2)
                shown = yield self._trial(Purpose.PULSE, gains, move, PULSE_S)
                gone = self._account(shown) * direction
                if gone <= -SEEN_COUNTS:
                    seen = (
                        f"the axis moved by {gone:+d} counts against an output of {self.level} of {FULL_PWM} PWM steps"
                    )
                    raise fault_found(seen, MachineFault.REVERSED, MachineFault.CARRIED, value=gone)
                if gone >= SEEN_COUNTS:
                    silent.remove(direction)
                    fell_counts = gone - direction * shown.rest_counts
            if not silent:
                return ()
        output = f"{most} of {FULL_PWM} PWM steps, {PULSE_TICKS} servo ticks long"
        if len(silent) == 1:
            way = "back" if silent == [-1] else "forward"
            if fell_counts >= SEEN_COUNTS:
                seen = f"the axis moved, fell back by {fell_counts} counts, and did not move {way} with {output}"
                raise fault_found(seen, MachineFault.LOAD_HANGS, value=fell_counts)
            raise fault_found(f"the axis did not move {way} with {output}", MachineFault.AT_END, value=most)
        # more would take a motor without an encoder farther than this tuning may go
        seen = f"the encoder counted nothing at {output}; a larger distance allows more"
        raise fault_found(seen, *STANDS, MachineFault.AT_END, MachineFault.LOAD_HANGS, value=most)

    def soft(self) -> Trials:
        """Move there and back by a fourth of the distance, with more output each time until the axis follows.

        Raises:
            DriveFault: it does not, or the drive gave up.
        """
        reach = min(self._bounds.within_counts // 4, MOST_ERROR_LIMIT * 3 // 4)
        level, lasts_s = max(self.level * FIRST_SOFT_SHARE, LEAST_SOFT_LEVEL), SOFT_S
        while level <= MOST_SOFT_LEVEL:
            kp = max(round(256 * level / reach), 1)
            gains = Gains(
                kp=kp,
                kd=SOFT_DERIVATIVE_TICKS * kp,
                ki=0,
                il=0,
                ol=max(round(level), 1),
                cl=0,
                el=reach * 4 // 3,
                sr=1,
            )
            records: list[MoveRecord] = []
            rests = True
            for distance in self._there_and_back(reach):
                move = self._bounds.move(distance, 100.0 * reach, 100_000.0 * reach)
                shown = yield self._trial(Purpose.SOFT, gains, move, lasts_s)
                self._account(shown)
                if shown.tripped:
                    raise _gave_up("a soft move")
                rests = shown.record.ends_at_rest
                if not rests:
                    break  # only the way in which it comes to rest distinguishes friction from inertia
                left = reach - abs(shown.rest_counts)
                if left > (1 - SOFT_SHARE) * reach or SOFT_AUTHORITY * kp * left >= FRACTION_OF_GAIN * gains.ol:
                    break  # at its limit all the way, the output tells only by how much it exceeds friction
                records.append(shown.record)
            if len(records) == BOTH_WAYS:
                return tuple(records)
            if not rests and lasts_s < MOST_SOFT_S:
                lasts_s *= 2
            else:
                level *= SOFT_STEP
        seen = f"the axis does not follow with {MOST_SOFT_LEVEL} of {FULL_PWM} PWM steps"
        raise fault_found(seen, *NOT_FOLLOWING, value=MOST_SOFT_LEVEL)

    def stiff(self, gains: Gains) -> Trials:
        """Move there and back by an eighth of the distance with stiff gains, without their integral.

        Raises:
            DriveFault: the drive gave up.
        """
        reach = min(self._bounds.within_counts // 8, MOST_ERROR_LIMIT // 2)
        gains = replace(gains, ki=0, il=0, ol=MOST_SOFT_LEVEL, el=2 * reach)
        records = []
        for distance in self._there_and_back(reach):
            move = self._bounds.move(distance, 100.0 * reach, 100_000.0 * reach)
            shown = yield self._trial(Purpose.STIFF, gains, move, STIFF_S)
            self._account(shown)
            if shown.tripped:
                raise _gave_up("a stiff move")
            records.append(shown.record)
        return tuple(records)

    def wanted(self) -> TrapezoidMove:
        """Return the test move: half of the distance, as fast as the axis may go and a model still has to allow."""
        distance = self._bounds.within_counts // 2
        return self._bounds.move(distance, 40.0 * distance, 800.0 * distance)

    def test(self, gains: Gains, move: TrapezoidMove, lasts_s: float) -> Trials:
        """Make the test move there and back; ends early where the drive gives up.

        Args:
            gains: to be judged; their error limit is lowered to half of the distance.
            move: there.
            lasts_s: time for one way, with settling.
        """
        gains = replace(gains, cl=0, el=min(gains.el, self._bounds.within_counts // 2))
        records = []
        for distance in self._there_and_back(abs(move.distance_counts)):
            there = replace(move, distance_counts=distance)
            shown = yield self._trial(Purpose.TEST, gains, there, lasts_s)
            self._account(shown)
            if shown.tripped:
                break
            records.append(shown.record)
        return tuple(records)

    def _there_and_back(self, distance: int) -> tuple[int, int]:
        """Return a distance and its opposite, first towards where the axis stood at the beginning."""
        first = -distance if self.offset_counts > 0 else distance
        return first, -first

    def _trial(self, purpose: Purpose, gains: Gains, move: TrapezoidMove, lasts_s: float) -> Trial:
        stands, ends = self.offset_counts, self.offset_counts + move.distance_counts
        if max(abs(stands), abs(ends)) > self._bounds.within_counts:
            raise DriveFault(
                f"the axis stands {stands:+d} counts from where it stood: the next move could leave the"
                f" {self._bounds.within_counts} counts that it may go",
                value=stands,
                limit=self._bounds.within_counts,
                remedy="secure the load, which carries it away between moves",
            )
        return Trial(purpose, gains, move, Start(0, self._slack), lasts_s)

    def _account(self, shown: TrialOutcome) -> int:
        """Note where the axis has been and is now; return how far it was from where it stood, signed."""
        positions = (*shown.record.positions, shown.rest_counts)
        gone = max(positions, key=abs)
        self.farthest_counts = max(self.farthest_counts, *(abs(self.offset_counts + each) for each in positions))
        self.offset_counts += shown.rest_counts
        fell = shown.rest_counts - shown.record.positions[-1]
        if shown.record.ends_at_rest and not shown.tripped and abs(fell) > max(FELL_COUNTS, abs(gone) * FELL_SHARE):
            raise fault_found(
                f"the axis fell by {fell:+d} counts when the loop opened", MachineFault.LOAD_HANGS, value=fell
            )
        if abs(shown.rest_counts) >= SEEN_COUNTS:
            self._slack = 1.0 if shown.rest_counts > 0 else 0.0
        return gone


def _gave_up(what: str) -> DriveFault:
    return fault_found(f"the drive opened its loop in {what}: the axis did not follow", *NOT_FOLLOWING)
