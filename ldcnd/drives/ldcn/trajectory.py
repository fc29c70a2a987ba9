"""The data of Load Trajectory, and the motions of the daemon as such data; the points of a path.

Velocity and acceleration are 16.16 fixed-point numbers of counts per servo tick (per tick squared); on devices whose
servo rate divisor also slows the profile generator, the tick is the divisor times 0.512 ms.
Sources: LS-182AP manual, "Load Trajectory", "PWM Mode Operation", "Absolute positioning mode", "Analog positioning
sensor control"; PIC-SERVO manual, 4.4, 4.5, 5.2. Where the LS-182AP text has bit 4 choose between trapezoid and
velocity it means bit 5, as its own list of bits says.

A path point of PIC-SERVO SC and CMC is 16 bits: a difference of position that is walked through at a fixed rate, in the
upper ones, shifted by the number of cycles that it takes, bit 1 for the longer of two periods, bit 0 for reverse.
Without these two bits the word is the speed, in 1/256 count per servo cycle. A point has no absolute position, so the
host sums up what it has sent. Source: PIC-SERVO SC data sheet, 4.4.5, 5.2; the cycles of a period from the scale
factors of the vendor's library.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntFlag, StrEnum
from itertools import compress

from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.drives.driver import NO_CEILING, ROUNDING, AnalogMotion, Ceiling, CountsMotion, PwmOutput, inward
from ldcnd.drives.ldcn.faults import SENSOR_BITS, SENSOR_LEAST, SENSOR_MOST
from ldcnd.drives.ldcn.packet import POSITION, RegisterField
from ldcnd.drives.ldcn.profiles import CYCLE_CLOCKS, Profile
from ldcnd.drives.ldcn.registers import FRACTION, MOST_DIVISOR, MOST_RATE, TRAJECTORY_CONTROL, TRAJECTORY_NAMES

ACCELERATION = RegisterField("acceleration", 4, 0, MOST_RATE)
MOST_PWM = 0xFF


class ProfileMode(StrEnum):
    """The operation of the profile generator while the position servo is on."""

    TRAPEZOIDAL = "trapezoidal"
    VELOCITY = "velocity"


class TrajectoryControl(IntFlag):
    """The control byte; bits 0 to 3 say which fields follow."""

    LOAD_POSITION = 0x01
    LOAD_VELOCITY = 0x02
    LOAD_ACCELERATION = 0x04
    LOAD_PWM_OR_TARGET = 0x08
    SERVO = 0x10
    VELOCITY_MODE = 0x20
    REVERSE = 0x40  # in trapezoidal mode: a relative goal on PIC-SERVO SC, nothing elsewhere
    START_NOW = 0x80


_BITS = tuple(map(int, TrajectoryControl))
"""In this order, as numbers: arithmetic with flags costs ten times as much."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """The values to load; None leaves a register as it is.

    Attributes:
        position: counts, -0x7FFFFFFF to 0x7FFFFFFF; the goal in trapezoidal mode.
        velocity: programmed velocity, 0 to 0x7FFFFFFF.
        acceleration: programmed acceleration, 0 to 0x7FFFFFFF.
        pwm_or_target: without the servo the PWM value, 0 to 255; with it, on devices with absolute positioning, the A/D
            value at which a motion in velocity mode ends.
        servo: position servo on; off sends the PWM value straight to the amplifier.
        mode: the profile, while the servo is on.
        reverse: backward, in velocity and PWM mode; in trapezoidal mode the direction follows from the position.
        start_now: execute at once instead of waiting for Start Motion.
        relative: the position is a distance from the present command position; PIC-SERVO SC, trapezoidal mode.
    """

    position: int | None = None
    velocity: int | None = None
    acceleration: int | None = None
    pwm_or_target: int | None = None
    servo: bool = True
    mode: ProfileMode = ProfileMode.TRAPEZOIDAL
    reverse: bool = False
    start_now: bool = False
    relative: bool = False

    @property
    def control(self) -> TrajectoryControl:
        """The control byte that announces these fields."""
        present = (
            self.position is not None,
            self.velocity is not None,
            self.acceleration is not None,
            self.pwm_or_target is not None,
            self.servo,
            self.mode is ProfileMode.VELOCITY,
            self.reverse or self.relative,
            self.start_now,
        )
        return TrajectoryControl(sum(compress(_BITS, present)))


def trajectory_bytes(profile: Profile, control: TrajectoryControl) -> int:
    """Return how many data bytes this control byte implies, itself included; 1 to 15."""
    return 1 + sum(field.width for field in _fields(profile, control) if field)


def encode_trajectory(profile: Profile, trajectory: Trajectory) -> bytes:
    """Return the data bytes for this device.

    Raises:
        ValueOutOfRange: a value does not fit its register.
        NotSupported: an analog target on a device without absolute positioning, a relative move on another device than
            PIC-SERVO SC or in another mode than the trapezoidal one, or a backward trapezoid: the bit means nothing
            there on most devices, and a relative move on PIC-SERVO SC.
    """
    trapezoidal = trajectory.servo and trajectory.mode is ProfileMode.TRAPEZOIDAL
    if trajectory.relative and not (trapezoidal and profile.sc_extensions):
        raise NotSupported(f"{profile.title} has no relative moves, or this is no trapezoidal one")
    # bit 6 "is ignored in trapezoidal profile mode" (LS-182AP manual)
    if trapezoidal and trajectory.reverse:
        raise NotSupported("a trapezoidal move takes its direction from the position, not from the reverse bit")
    if trajectory.servo and trajectory.pwm_or_target and not profile.analog_target:
        raise NotSupported(f"{profile.title} has no absolute positioning: with the servo on it takes no analog target")
    values = (trajectory.position, trajectory.velocity, trajectory.acceleration, trajectory.pwm_or_target)
    control = trajectory.control
    data = bytearray((control,))
    for field, value in zip(_fields(profile, control), values, strict=True):
        if field and value is not None:
            data += field.encode(value)
    return bytes(data)


def decode_trajectory(profile: Profile, data: bytes) -> Trajectory:
    """Take data bytes as this device would: missing ones count as 0, surplus ones are ignored."""
    control = TrajectoryControl(data[0] if data else 0)
    at = 1
    values: list[int | None] = []
    for field in _fields(profile, control):
        values.append(field.decode(data[at:]) if field else None)
        at += field.width if field else 0
    position, velocity, acceleration, pwm_or_target = values
    servo = bool(control & TrajectoryControl.SERVO)
    trapezoidal = not control & TrajectoryControl.VELOCITY_MODE
    reverse = bool(control & TrajectoryControl.REVERSE)
    relative = reverse and servo and trapezoidal and profile.sc_extensions
    return Trajectory(
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        pwm_or_target=pwm_or_target,
        servo=servo,
        mode=ProfileMode.TRAPEZOIDAL if trapezoidal else ProfileMode.VELOCITY,
        reverse=reverse and not relative,
        start_now=bool(control & TrajectoryControl.START_NOW),
        relative=relative,
    )


def _fields(profile: Profile, control: TrajectoryControl) -> tuple[RegisterField | None, ...]:
    """Return position, velocity, acceleration and PWM or target, None for those that the control byte leaves out."""
    position, velocity, acceleration, pwm_or_target = [int(control) & bit for bit in _BITS[:4]]
    return (
        POSITION if position else None,
        RegisterField("velocity", 4, 0, profile.most_velocity) if velocity else None,
        ACCELERATION if acceleration else None,
        _pwm_or_target(profile, control) if pwm_or_target else None,
    )


def _pwm_or_target(profile: Profile, control: TrajectoryControl) -> RegisterField:
    if control & TrajectoryControl.SERVO and profile.analog_target:
        return RegisterField("analog target", profile.pwm_bytes, 0, (1 << profile.adc_bits) - 1)
    return RegisterField("PWM", profile.pwm_bytes, 0, MOST_PWM)


def trajectory_values(trajectory: Trajectory) -> dict[str, int]:
    """Return what Load Trajectory writes: the control byte, and the fields that are present."""
    values = {name: getattr(trajectory, name) for name in TRAJECTORY_NAMES}
    return {name: value for name, value in values.items() if value is not None} | {
        TRAJECTORY_CONTROL: int(trajectory.control)
    }


def quantised(motion: CountsMotion, servo_divisor: int, profile: Profile, most: Ceiling = NO_CEILING) -> CountsMotion:
    """Return the motion as the registers will hold it, rounded to the nearest that is not above the ceiling.

    Raises:
        ValueOutOfRange: a value does not fit its register, or the smallest register value is above the ceiling.
    """
    _check_encoder_rate(motion.velocity_counts_per_s, profile)
    velocity = programmed_velocity(motion.velocity_counts_per_s, servo_divisor, profile, most.velocity_counts_per_s)
    return replace(
        motion,
        velocity_counts_per_s=math.copysign(
            velocity_counts_per_s(velocity, servo_divisor, profile), motion.velocity_counts_per_s
        ),
        acceleration_counts_per_s2=_held_acceleration(motion, servo_divisor, profile, most),
        servo_divisor=servo_divisor,
    )


def quantised_output(output: PwmOutput, servo_divisor: int, profile: Profile, most: Ceiling = NO_CEILING) -> PwmOutput:
    """Return the raw duty as the registers will hold it, as `quantised` does.

    Raises:
        ValueOutOfRange: as `quantised`.
    """
    pwm = programmed_duty(output.duty, most.duty)
    return PwmOutput(
        math.copysign(pwm / MOST_PWM, output.duty),
        _held_acceleration(output, servo_divisor, profile, most),
        servo_divisor,
    )


def _held_acceleration(motion: CountsMotion | PwmOutput, servo_divisor: int, profile: Profile, most: Ceiling) -> float:
    register = programmed_acceleration(
        motion.acceleration_counts_per_s2, servo_divisor, profile, most.acceleration_counts_per_s2
    )
    return acceleration_counts_per_s2(register, servo_divisor, profile)


def _check_encoder_rate(counts_per_s: float, profile: Profile) -> None:
    """Refuse a speed at which the drive would lose counts.

    PIC-SERVO manual, 3.2: 500 kHz; LS-182AP manual, "Features": 2 MHz.

    Raises:
        ValueOutOfRange: names the highest speed.
    """
    most = float(profile.encoder_counts_per_s)
    if abs(counts_per_s) > most:
        raise ValueOutOfRange(
            f"{abs(counts_per_s):.10g} counts/s: {profile.title} counts up to {most:.10g} a second",
            value=counts_per_s,
            limit=most,
            nearest=math.copysign(most, counts_per_s),
        )


def trajectory_of(motion: CountsMotion | AnalogMotion | PwmOutput, servo_divisor: int, profile: Profile) -> Trajectory:
    """Return what Load Trajectory takes for a motion; it waits for Start Motion.

    Raises:
        ValueOutOfRange: a value does not fit its register, or is an analog target in the range of a broken sensor.
        NotSupported: an analog target on a drive without absolute positioning.
    """
    if not isinstance(motion, PwmOutput):
        _check_encoder_rate(motion.velocity_counts_per_s, profile)
    acceleration = programmed_acceleration(motion.acceleration_counts_per_s2, servo_divisor, profile)
    match motion:
        case PwmOutput():
            return Trajectory(
                acceleration=acceleration,
                # with an acceleration, although PWM mode has none: the smooth stop that ends it decelerates by it
                pwm_or_target=programmed_duty(motion.duty),
                servo=False,
                reverse=motion.duty < 0,
            )
        case AnalogMotion():
            _check_analog_target(motion.target_counts, profile)
            return Trajectory(
                velocity=programmed_velocity(motion.velocity_counts_per_s, servo_divisor, profile),
                acceleration=acceleration,
                pwm_or_target=motion.target_counts,
                # "The direction bit is calculated internally" (LS-182AP manual, "Absolute positioning mode")
                mode=ProfileMode.VELOCITY,
            )
        case CountsMotion():
            continuous = motion.target_counts is None
            return Trajectory(
                position=motion.target_counts,
                velocity=programmed_velocity(motion.velocity_counts_per_s, servo_divisor, profile),
                acceleration=acceleration,
                mode=ProfileMode.VELOCITY if continuous else ProfileMode.TRAPEZOIDAL,
                reverse=continuous and motion.velocity_counts_per_s < 0,
            )


def _check_analog_target(target: int, profile: Profile) -> None:
    """Refuse a target where the drive would take its sensor for a broken one."""
    if not profile.analog_target:
        raise NotSupported(f"{profile.title} cannot move to an analog target")
    shift = SENSOR_BITS - profile.adc_bits
    # rounded inwards on a converter that is coarser
    low, high = -(-SENSOR_LEAST >> shift), SENSOR_MOST >> shift
    if not low <= target <= high:
        nearest = low if target < low else high
        raise ValueOutOfRange(
            f"analog target {target} is outside {low} to {high}, where the drive takes its sensor for broken",
            value=target,
            limit=nearest,
            nearest=nearest,
        )


def programmed_velocity(counts_per_s: float, servo_divisor: int, profile: Profile, ceiling: float = math.inf) -> int:
    """Return the velocity register for a velocity, whose sign it does not have; 33.554432 per count/s at SR 1.

    It is the nearest one that is not above the ceiling.

    Raises:
        ValueOutOfRange: not a number, beyond the register, or so small that it would become 0.
    """
    return _programmed(
        "velocity", " counts/s", counts_per_s, ceiling, _velocity_factor(servo_divisor, profile), profile.most_velocity
    )


def velocity_counts_per_s(programmed: int, servo_divisor: int, profile: Profile) -> float:
    """Return the speed that a velocity register stands for, in counts per second.

    Raises:
        ValueOutOfRange: the servo rate divisor is outside 1 to 255.
    """
    return programmed / _velocity_factor(servo_divisor, profile)


def programmed_acceleration(
    counts_per_s2: float, servo_divisor: int, profile: Profile, ceiling: float = math.inf
) -> int:
    """Return the acceleration register, as `programmed_velocity`; 0.017179869184 per count/s^2 at SR 1.

    Raises:
        ValueOutOfRange: not a number, beyond the register, or so small that it would become 0.
    """
    return _programmed(
        "acceleration", " counts/s^2", counts_per_s2, ceiling, _acceleration_factor(servo_divisor, profile), MOST_RATE
    )


def programmed_duty(duty: float, ceiling: float = math.inf) -> int:
    """Return the PWM register for a raw duty from -1 to 1, as `programmed_velocity`.

    Raises:
        ValueOutOfRange: not a number, above 1, or so small that it would become 0.
    """
    return _programmed("duty", "", duty, ceiling, MOST_PWM, MOST_PWM)


def acceleration_counts_per_s2(programmed: int, servo_divisor: int, profile: Profile) -> float:
    """Return the acceleration that an acceleration register stands for, in counts per second squared.

    Raises:
        ValueOutOfRange: the servo rate divisor is outside 1 to 255.
    """
    return programmed / _acceleration_factor(servo_divisor, profile)


def _velocity_factor(servo_divisor: int, profile: Profile) -> float:
    return FRACTION * _profile_tick_s(servo_divisor, profile)


def _acceleration_factor(servo_divisor: int, profile: Profile) -> float:
    return FRACTION * _profile_tick_s(servo_divisor, profile) ** 2


def _profile_tick_s(servo_divisor: int, profile: Profile) -> float:
    if not 1 <= servo_divisor <= MOST_DIVISOR:
        raise ValueOutOfRange(
            f"servo rate divisor {servo_divisor} is outside 1 to {MOST_DIVISOR}",
            value=servo_divisor,
            limit=1 if servo_divisor < 1 else MOST_DIVISOR,
            nearest=min(max(servo_divisor, 1), MOST_DIVISOR),
        )
    return CYCLE_CLOCKS / profile.clock_hz * (servo_divisor if profile.divisor_slows_profile else 1)


def _programmed(what: str, unit: str, value: float, ceiling: float, factor: float, most_register: int) -> int:
    size, most = abs(value), most_register / factor
    # this comparison is false for what is not a number, too
    if not size <= most:
        raise ValueOutOfRange(
            f"{what} {value:.10g}{unit} is beyond {most:.10g}{unit}",
            value=value,
            limit=most,
            nearest=math.copysign(most, value),
        )
    # `round` would take the even one of two that are equally near
    register = inward(math.floor(size * factor + 0.5), min(ceiling * factor * (1 + ROUNDING), most_register))
    if register == 0 and value:
        least = 1 / factor
        held = least > ceiling * (1 + ROUNDING)
        divides = ", or load a larger servo rate divisor" if unit else ""
        raise ValueOutOfRange(
            f"{what} {value:g}{unit} is too small for the drive, the least is {least:g}"
            + (f", and the limit is {ceiling:g}" if held else ""),
            value=value,
            limit=least,
            nearest=None if held else math.copysign(least, value),
            remedy=f"raise the limit to the least{divides}" if held else None,
        )
    return register


# -- path points -------------------------------------------------------------------------------------------------------

REVERSE = 0x0001
LONG_PERIOD = 0x0002
SPEED_MASK = 0xFFFC
WORD_BYTES = 2
MOST_POINTS_PER_PACKET = 7
_SPEED_FRACTION = 256


def point_cycles(word: int, *, fast_path: bool) -> int:
    """Return for how many servo cycles a point moves: 16, 32 or 64."""
    cycles = 64 if word & LONG_PERIOD else 32
    return cycles // 2 if fast_path else cycles


@dataclass(frozen=True, slots=True)
class PathPoint:
    """One step of a path.

    Attributes:
        counts: from the point before; at most 16383, 8191 or 4095 either way with 64, 32 or 16 cycles.
        cycles: servo cycles that it takes: 64 or 32, on the fast path 32 or 16.
    """

    counts: int
    cycles: int


def encode_point(point: PathPoint, *, fast_path: bool) -> int:
    """Return the word of a point.

    Args:
        point: to encode.
        fast_path: the option as last set by I/O Control.

    Raises:
        ValueOutOfRange: the step does not fit its period, or the period is none of the two.
    """
    periods = (32, 16) if fast_path else (64, 32)
    if point.cycles not in periods:
        allowed = f"{periods[0]} or {periods[1]}"
        raise ValueOutOfRange(f"a path point takes {allowed} cycles", value=point.cycles, limit=allowed)
    most = most_step(point.cycles)
    if abs(point.counts) > most:
        raise ValueOutOfRange(
            f"a path point of {point.cycles} cycles moves {most} counts at most, not {point.counts}",
            value=point.counts,
            limit=most,
            nearest=most if point.counts > 0 else -most,
        )
    # sign and magnitude, not two's complement: bit 0 is the sign
    word = abs(point.counts) * _SPEED_FRACTION // point.cycles
    if point.cycles == periods[0]:
        word |= LONG_PERIOD
    return word | REVERSE if point.counts < 0 else word


def encode_points(profile: Profile, points: Iterable[PathPoint], *, fast_path: bool) -> bytes:
    """Return the data of Add Path Points for 1 to 7 points.

    Raises:
        NotSupported: the device has no path mode.
        ValueOutOfRange: too many points, none, or one that does not fit.
    """
    if not profile.path_points:
        raise NotSupported(f"{profile.title} has no path mode")
    words = [encode_point(point, fast_path=fast_path) for point in points]
    if not 1 <= len(words) <= MOST_POINTS_PER_PACKET:
        raise ValueOutOfRange(
            f"{len(words)} path points, a packet takes 1 to {MOST_POINTS_PER_PACKET}",
            value=len(words),
            limit=MOST_POINTS_PER_PACKET,
        )
    return b"".join(word.to_bytes(WORD_BYTES, "little") for word in words)


def most_step(cycles: int) -> int:
    """Return the largest step whose speed still fits the word: below 256 counts per cycle."""
    return (1 << 16) * cycles // _SPEED_FRACTION - 1
