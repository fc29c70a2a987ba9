"""The dialects of LDCN and NMC: one row per device, chosen by (device id, version).

A profile is the only place for differences between devices: status layout, field widths, registers, homing sources.
Sources: LS-182AP manual (712182023 rev. C) and PIC-SERVO manual (version 4), "Command description"; for devices these
do not cover, later vendor data sheets.
"""

from dataclasses import dataclass, replace
from enum import IntFlag, StrEnum


class Support(StrEnum):
    """How far ldcnd goes with a device."""

    FULL = "full"
    IDENTIFY = "identify"
    """Kept on the chain, published with identity and status byte, never moved."""


class DeviceKind(StrEnum):
    """The kind of a module; the same command codes have other meanings for another kind."""

    SERVO = "servo"
    IO = "io"
    STEPPER = "stepper"
    SUPERVISOR = "supervisor"


class HomingControl(IntFlag):
    """Set Homing Mode: what captures the home position, and how the drive stops there; 0 cancels the search."""

    LIMIT1 = 0x01  # the reverse limit, but the forward one with `limit1_is_forward`
    LIMIT2 = 0x02
    MOTOR_OFF = 0x04
    INDEX = 0x08
    STOP_ABRUPT = 0x10
    STOP_SMOOTH = 0x20
    POSITION_ERROR = 0x40
    CURRENT = 0x80


CLOCK_HZ = 20_000_000
"""The clock on which all timing in the manuals is based."""
CYCLE_CLOCKS = 10_240
"""Clocks of a servo cycle: 0.512 ms at 20 MHz."""


@dataclass(frozen=True, slots=True)
class Profile:
    """One dialect.

    Attributes:
        name: the name used in the configuration, and `title` the one for people.
        kind: what the commands beyond the common ones mean.
        device_id: first byte of status item 5.
        versions: the versions of that id that speak this dialect.
        adc_bytes: width of status item 1, and `adc_bits` its resolution.
        position_error_bytes: width of status item 6 (0: the device ignores the bit).
        bit7_bytes: width of status item 7 (0: ignored).
        pwm_bytes: width of the PWM / analog target field of Load Trajectory.
        gain_bytes: data bytes of Set Gain.
        divisor_slows_profile: the servo rate divisor also divides the profile clock (v x SR, a x SR^2).
        stop_here: Stop Motor bit 4 exists.
        stops_on_home: bits 2, 4, 5 of the homing control byte exist.
        homing_sources: what can capture the home position.
        limit_outputs: command 0x8 drives the limit pins.
        pic_ae_diagnostics: status bits 3 to 6 change meaning with the power driver enable bit (Logosol).
        analog_target: absolute positioning on the A/D value exists.
        offset_on_the_fly: a trapezoidal position loaded in mid-move is added as an offset; elsewhere it is erratic.
        current_limit: Set Gain's CL byte works.
        top_baud: the highest rate of Set Baud Rate.
        baud_keys: Set Baud Rate finds its byte in a table of rates; elsewhere the byte divides the clock.
        any_divisor: every rate that a divisor of the clock makes is known to work; elsewhere only those that the
            manuals print, and what byte makes another rate is not known: LS-231 takes 27 for 125000, which is 9
            elsewhere (`FW`).
        encoder_counts_per_s: the highest rate of encoder transitions that is counted without loss.
        most_velocity: the largest programmed velocity, 16.16 counts per tick.
        most_error_limit: the largest EL of Set Gain, counts.
        velocity_sign: the sign of status item 2 while the motor runs forward, 1 or -1.
        limit1_is_forward: LIMIT1 is the forward limit switch and LIMIT2 the reverse one.
        live_aux: aux bits 3 and 4 tell what the profile does now, and bit 0 is the level of the index; elsewhere the
            two are latched phases of a trapezoid, and bit 0 the complement of the level.
        sc_extensions: Reset Position with data, options in command 0x8, Hard Reset with data, relative moves, and
            goal, velocity and acceleration that may be changed during a trapezoidal move.
        advanced_stop: Stop Motor bit 5 turns on what the device has beyond version 4.
        path_points: how many points the path buffer holds; 0 without path mode.
        numbered_from_host: the first module that waits for an address is the one next to the host (LS-182AP manual,
            "Initializing procedure"); elsewhere it is customarily the one furthest from it (PIC-SERVO manual, 4.1).
        any_clock: "any clock between 10 MHz and 20 MHz may be used, with the timing specifications adjusted
            proportionally" (PIC-SERVO manual, 3.0).
        clock_hz: the clock; servo cycle, baud rates and the encoder rate scale with it.
        motion_lock_from: from this version on, Stop Motor bit 7 unlocks motion and aux bit 7 says that it is locked
            (after homing on a limit); None on devices without the lock.
    """

    name: str
    title: str
    device_id: int
    versions: range
    support: Support
    kind: DeviceKind = DeviceKind.SERVO
    adc_bytes: int = 1
    adc_bits: int = 8
    position_error_bytes: int = 0
    bit7_bytes: int = 0
    pwm_bytes: int = 1
    gain_bytes: int = 14
    divisor_slows_profile: bool = True
    stop_here: bool = True
    stops_on_home: bool = True
    homing_sources: HomingControl = (
        HomingControl.LIMIT1
        | HomingControl.LIMIT2
        | HomingControl.INDEX
        | HomingControl.POSITION_ERROR
        | HomingControl.CURRENT
    )
    limit_outputs: bool = False
    pic_ae_diagnostics: bool = False
    analog_target: bool = False
    offset_on_the_fly: bool = False
    current_limit: bool = True
    top_baud: int = 125_000
    baud_keys: bool = False
    any_divisor: bool = True
    # "encoder transition rate: 500 KHz (max.)" (PIC-SERVO manual, 3.2)
    encoder_counts_per_s: int = 500_000
    most_velocity: int = 0x7FFF_FFFF
    # "position error limit EL (0 - 0x3FFF)" (both manuals, "Set Gain")
    most_error_limit: int = 0x3FFF
    # "a positive number when moving in reverse direction" (LS-182AP manual, "Define Status")
    velocity_sign: int = -1
    limit1_is_forward: bool = False
    live_aux: bool = False
    sc_extensions: bool = False
    advanced_stop: bool = False
    path_points: int = 0
    numbered_from_host: bool = False
    any_clock: bool = False
    clock_hz: int = CLOCK_HZ
    motion_lock_from: int | None = None

    @property
    def servo_cycle_s(self) -> float:
        """The servo period at divisor 1, seconds; commands are executed at its end whatever the divisor is."""
        return CYCLE_CLOCKS / self.clock_hz


def at_clock(profile: Profile, clock_hz: int) -> Profile:
    """Return the profile of a device that is clocked otherwise, 10,000,000 to 20,000,000 Hz."""
    if clock_hz == profile.clock_hz:
        return profile
    return replace(
        profile,
        clock_hz=clock_hz,
        encoder_counts_per_s=profile.encoder_counts_per_s * clock_hz // profile.clock_hz,
        top_baud=profile.top_baud * clock_hz // profile.clock_hz,
    )


PIC_SERVO_V4 = Profile(
    "pic-servo-v4",
    "PIC-SERVO version 4",
    0,
    range(4, 5),
    Support.FULL,
    limit_outputs=True,
    any_clock=True,
)
PIC_SERVO_V3 = replace(
    PIC_SERVO_V4,
    name="pic-servo-v3",
    title="PIC-SERVO version 3",
    versions=range(3, 4),
    # "0xE6 (for version 4 and higher - use 0xD6 for versions 1, 2 & 3)" (PIC-SERVO manual, 5.2)
    gain_bytes=13,
    limit_outputs=False,  # the manual describes version 4; not verified for older ones, nor for the next
)
PIC_SERVO_V2 = replace(
    PIC_SERVO_V3,
    name="pic-servo-v2",
    title="PIC-SERVO version 2",
    versions=range(2, 3),
    # bits 2, 4 and 5 of Set Homing Mode: "don't care (versions 1 & 2)" (ibid.)
    stops_on_home=False,
)
PIC_SERVO_V1 = replace(
    PIC_SERVO_V2,
    name="pic-servo-v1",
    title="PIC-SERVO version 1",
    versions=range(1, 2),
    # "stop here (not available on version 1)" (ibid., "Stop Motor")
    stop_here=False,
)
PIC_SERVO_SC = Profile(
    "pic-servo-sc",
    "PIC-SERVO SC",
    0,
    range(10, 11),
    Support.FULL,
    position_error_bytes=2,
    bit7_bytes=1,
    gain_bytes=15,
    divisor_slows_profile=False,
    top_baud=230_400,
    baud_keys=True,
    any_divisor=False,
    encoder_counts_per_s=2_500_000,
    # 2.5 MHz in a cycle of 0.512 ms (SC data sheet, 5.2)
    most_velocity=1280 << 16,
    most_error_limit=0x7FFF,
    # the manual of the vendor's SC board tests the polarity so; the data sheet does not say
    velocity_sign=1,
    limit1_is_forward=True,
    live_aux=True,
    sc_extensions=True,
    path_points=128,
)
PIC_SERVO_CMC = replace(
    PIC_SERVO_V4,
    name="pic-servo-cmc",
    title="PIC-SERVO CMC",
    versions=range(5, 6),
    advanced_stop=True,
    path_points=96,
)
PIC_SERVO_CMC_ADVANCED = replace(PIC_SERVO_CMC, position_error_bytes=2, bit7_bytes=1)
"""The same device after Stop Motor with bit 5, which adds two status items and path mode; it has the same identity.

Before that it works as a version 4. Whether it already sends the two items is not known, so hosts do not request them.
"""
LS_173AP = Profile(
    "ls-173ap",
    "Logosol LS-173AP",
    90,
    range(1, 20),
    Support.FULL,
    position_error_bytes=2,
    homing_sources=HomingControl.INDEX | HomingControl.POSITION_ERROR,
    pic_ae_diagnostics=True,
    numbered_from_host=True,
    analog_target=True,
    offset_on_the_fly=True,
    current_limit=False,
    # "encoder transition rate up to 2MHz" (LS-182AP manual, "Features")
    encoder_counts_per_s=2_000_000,
)
LS_182AP = replace(
    LS_173AP,
    name="ls-182ap",
    title="Logosol LS-182AP",
    versions=range(20, 256),
    adc_bytes=2,
    adc_bits=10,
    # "(n = n + 2 bytes)" (LS-182AP manual); its printed examples with 14 data bytes have the form of the LS-173AP
    pwm_bytes=2,
    homing_sources=HomingControl.LIMIT1 | HomingControl.LIMIT2 | HomingControl.INDEX | HomingControl.POSITION_ERROR,
    motion_lock_from=22,
)
PIC_IO = Profile("pic-io", "PIC-I/O", 2, range(1, 2), Support.IDENTIFY, DeviceKind.IO)
LS_231 = Profile(
    "ls-231",
    "Logosol LS-231/LS-132 family",
    0,
    range(20, 40),
    Support.IDENTIFY,
    top_baud=115_200,
    any_divisor=False,
    numbered_from_host=True,
)
LS_173 = replace(LS_231, name="ls-173", title="Logosol LS-173/LS-174 family", versions=range(60, 80))
SK_2310G2 = replace(
    LS_231,
    name="sk-2310g2",
    title="Logosol SK-2310g2",
    device_id=2,
    versions=range(2, 256),
    kind=DeviceKind.SUPERVISOR,
)
PIC_STEP = replace(
    LS_231,
    name="pic-step",
    title="PIC-STEP",
    device_id=3,
    versions=range(256),
    kind=DeviceKind.STEPPER,
    numbered_from_host=False,
)

PROFILES: dict[str, Profile] = {
    profile.name: profile
    for profile in (
        PIC_SERVO_V1,
        PIC_SERVO_V2,
        PIC_SERVO_V3,
        PIC_SERVO_V4,
        PIC_SERVO_CMC,
        PIC_SERVO_SC,
        LS_173AP,
        LS_182AP,
        LS_231,
        LS_173,
        PIC_IO,
        SK_2310G2,
        PIC_STEP,
    )
}


def identify(device_id: int, version: int) -> Profile | None:
    """Return the dialect of a device, or None for an unsupported one: never guess a layout.

    Args:
        device_id: 0 to 255, status item 5, first byte.
        version: 0 to 255, status item 5, second byte.
    """
    for profile in PROFILES.values():
        if profile.device_id == device_id and version in profile.versions:
            return profile
    return None
