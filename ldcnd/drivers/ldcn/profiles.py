"""The dialects of LDCN and NMC: one row per device, chosen by (device id, version).

A profile is the only place that knows how devices differ: status layout, field widths, registers, homing sources.
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


class HomingSource(IntFlag):
    """Bits of the homing control byte that capture the home position (manuals, "Set Homing Mode")."""

    LIMIT1 = 0x01  # LS-182AP: reverse limit
    LIMIT2 = 0x02  # LS-182AP: forward limit
    INDEX = 0x08
    POSITION_ERROR = 0x40
    CURRENT = 0x80


@dataclass(frozen=True, slots=True)
class Profile:
    """One dialect.

    Attributes:
        name: the name used in the configuration, and `title` the one for people.
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
        sc_extensions: Reset Position with data, output modes in command 0x8, path points and Hard Reset with data.
        motion_lock_from: from this version on, Stop Motor bit 7 unlocks motion and aux bit 7 says that it is locked
            (after homing on a limit); None on devices without the lock.
    """

    name: str
    title: str
    device_id: int
    versions: range
    support: Support
    adc_bytes: int = 1
    adc_bits: int = 8
    position_error_bytes: int = 0
    bit7_bytes: int = 0
    pwm_bytes: int = 1
    gain_bytes: int = 14
    divisor_slows_profile: bool = True
    stop_here: bool = True
    stops_on_home: bool = True
    homing_sources: HomingSource = (
        HomingSource.LIMIT1
        | HomingSource.LIMIT2
        | HomingSource.INDEX
        | HomingSource.POSITION_ERROR
        | HomingSource.CURRENT
    )
    limit_outputs: bool = False
    pic_ae_diagnostics: bool = False
    analog_target: bool = False
    offset_on_the_fly: bool = False
    current_limit: bool = True
    top_baud: int = 115_200
    sc_extensions: bool = False
    motion_lock_from: int | None = None


PIC_SERVO_V4 = Profile(
    "pic-servo-v4",
    "PIC-SERVO version 4",
    0,
    range(4, 5),
    Support.FULL,
    limit_outputs=True,
)
PIC_SERVO_V3 = replace(
    PIC_SERVO_V4,
    name="pic-servo-v3",
    title="PIC-SERVO version 3",
    versions=range(3, 4),
    gain_bytes=13,
    limit_outputs=False,  # the manual describes version 4; for older ones nobody vouches for it, nor for the next
)
PIC_SERVO_V2 = replace(
    PIC_SERVO_V3,
    name="pic-servo-v2",
    title="PIC-SERVO version 2",
    versions=range(2, 3),
    stops_on_home=False,
)
PIC_SERVO_V1 = replace(
    PIC_SERVO_V2,
    name="pic-servo-v1",
    title="PIC-SERVO version 1",
    versions=range(1, 2),
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
    sc_extensions=True,
)
LS_173AP = Profile(
    "ls-173ap",
    "Logosol LS-173AP",
    90,
    range(1, 20),
    Support.FULL,
    position_error_bytes=2,
    homing_sources=HomingSource.INDEX | HomingSource.POSITION_ERROR,
    pic_ae_diagnostics=True,
    analog_target=True,
    offset_on_the_fly=True,
    current_limit=False,
)
LS_182AP = replace(
    LS_173AP,
    name="ls-182ap",
    title="Logosol LS-182AP",
    versions=range(20, 256),
    adc_bytes=2,
    adc_bits=10,
    pwm_bytes=2,
    homing_sources=HomingSource.LIMIT1 | HomingSource.LIMIT2 | HomingSource.INDEX | HomingSource.POSITION_ERROR,
    motion_lock_from=22,
)
PIC_SERVO_CMC = replace(PIC_SERVO_SC, name="pic-servo-cmc", title="PIC-SERVO CMC", versions=range(5, 6))
LS_231 = Profile("ls-231", "Logosol LS-231/LS-132 family", 0, range(20, 40), Support.IDENTIFY)
LS_173 = Profile("ls-173", "Logosol LS-173/LS-174 family", 0, range(60, 80), Support.IDENTIFY)
PIC_IO = Profile("pic-io", "PIC-I/O or SK-2310g2", 2, range(256), Support.IDENTIFY)
PIC_STEP = Profile("pic-step", "PIC-STEP", 3, range(256), Support.IDENTIFY)

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
        PIC_STEP,
    )
}


def identify(device_id: int, version: int) -> Profile | None:
    """Return the dialect of a device, or None for one that nobody described: never guess a layout.

    Args:
        device_id: 0 to 255, status item 5, first byte.
        version: 0 to 255, status item 5, second byte.
    """
    for profile in PROFILES.values():
        if profile.device_id == device_id and version in profile.versions:
            return profile
    return None
