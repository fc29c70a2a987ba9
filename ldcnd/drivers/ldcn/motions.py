"""Motions of the daemon as trajectories of an LDCN/NMC drive.

Sources: LS-182AP manual, "Load Trajectory", "PWM Mode Operation", "Absolute positioning mode", "Analog positioning
sensor control"; PIC-SERVO manual, 4.4, 4.5, 5.2.
"""

from dataclasses import replace

from ldcnd.drivers.driver import AnalogMotion, Motion, PwmOutput
from ldcnd.drivers.ldcn.faults import SENSOR_BITS, SENSOR_LEAST, SENSOR_MOST
from ldcnd.drivers.ldcn.profiles import Profile
from ldcnd.drivers.ldcn.registers import (
    acceleration_counts_per_s2,
    programmed_acceleration,
    programmed_velocity,
    velocity_counts_per_s,
)
from ldcnd.drivers.ldcn.trajectory import MOST_PWM, ProfileMode, Trajectory
from ldcnd.errors import NotSupported, ValueOutOfRange


def quantised(motion: Motion, servo_divisor: int, profile: Profile) -> Motion:
    """Return the motion as the registers will hold it.

    Raises:
        ValueOutOfRange: a value does not fit its register.
    """
    velocity = programmed_velocity(abs(motion.velocity_counts_per_s), servo_divisor, profile)
    acceleration = programmed_acceleration(motion.acceleration_counts_per_s2, servo_divisor, profile)
    speed = velocity_counts_per_s(velocity, servo_divisor, profile)
    return replace(
        motion,
        velocity_counts_per_s=speed if motion.velocity_counts_per_s > 0 else -speed,
        acceleration_counts_per_s2=acceleration_counts_per_s2(acceleration, servo_divisor, profile),
    )


def trajectory_of(motion: Motion | AnalogMotion | PwmOutput, servo_divisor: int, profile: Profile) -> Trajectory:
    """Return what Load Trajectory takes for a motion; it waits for Start Motion.

    Raises:
        ValueOutOfRange: a value does not fit its register, or is an analog target that looks like a broken sensor.
        NotSupported: an analog target on a drive without absolute positioning.
    """
    acceleration = programmed_acceleration(motion.acceleration_counts_per_s2, servo_divisor, profile)
    match motion:
        case PwmOutput():
            return Trajectory(
                acceleration=acceleration,
                pwm_or_target=round(abs(motion.duty) * MOST_PWM),
                servo=False,
                reverse=motion.duty < 0,
            )
        case AnalogMotion():
            _check_analog_target(motion.target_counts, profile)
            return Trajectory(
                velocity=programmed_velocity(motion.velocity_counts_per_s, servo_divisor, profile),
                acceleration=acceleration,
                pwm_or_target=motion.target_counts,
                mode=ProfileMode.VELOCITY,
            )
        case Motion():
            continuous = motion.target_counts is None
            return Trajectory(
                position=motion.target_counts,
                velocity=programmed_velocity(abs(motion.velocity_counts_per_s), servo_divisor, profile),
                acceleration=acceleration,
                mode=ProfileMode.VELOCITY if continuous else ProfileMode.TRAPEZOIDAL,
                reverse=continuous and motion.velocity_counts_per_s < 0,
            )


def _check_analog_target(target: int, profile: Profile) -> None:
    """Refuse a target where the drive would take its sensor for a broken one."""
    if not profile.analog_target:
        raise NotSupported(f"{profile.title} cannot move to an analog target")
    shift = SENSOR_BITS - profile.adc_bits
    low, high = -(-SENSOR_LEAST >> shift), SENSOR_MOST >> shift
    if not low <= target <= high:
        nearest = low if target < low else high
        raise ValueOutOfRange(
            f"analog target {target} is outside {low} to {high}, where the drive takes its sensor for broken",
            value=target,
            limit=nearest,
            nearest=nearest,
        )
