"""LDCN/NMC registers whose unit is made of clocks: programmed velocity and acceleration, baud rate divisor.

Velocity and acceleration are 16.16 fixed-point numbers of counts per servo tick (per tick squared); on devices whose
servo rate divisor also slows the profile generator, the tick is the divisor times 0.512 ms.
Sources: LS-182AP manual, "Servo Control", "Set Baud Rate" and the calculation at its end; PIC-SERVO manual, 4.4, 5.2.
"""

import math
from enum import Enum
from types import MappingProxyType

from ldcnd.drivers.ldcn.profiles import Profile
from ldcnd.errors import ValueOutOfRange

SERVO_CYCLE_S = 0.000512
"""The servo period at divisor 1; commands are executed at its end whatever the divisor is."""
FRACTION = 1 << 16
MOST_RATE = 0x7FFF_FFFF
"""The largest programmed velocity or acceleration."""
MOST_DIVISOR = 0xFF
PROCESSOR_HZ = 20_000_000
CLOCKS_PER_BIT = 16


class BaudCodes(Enum):
    """The two families of baud rate divisors in use; they differ by a per cent or two in the rate."""

    MANUAL = "manual"
    """As printed in both manuals; 57600 comes out 3.3 % fast."""
    ALTERNATE = "alternate"
    """As later vendor software has them; 57600 comes out 1.4 % slow."""


BAUD_DIVISORS = MappingProxyType(
    {
        BaudCodes.MANUAL: MappingProxyType({9600: 0x81, 19_200: 0x3F, 57_600: 0x14, 115_200: 0x0A, 230_400: 0x05}),
        BaudCodes.ALTERNATE: MappingProxyType({9600: 127, 19_200: 64, 57_600: 21, 115_200: 0x0A, 230_400: 0x05}),
    }
)
"""The divisor of each rate; 230400 exists on PIC-SERVO SC only."""


def programmed_velocity(counts_per_s: float, servo_divisor: int, profile: Profile) -> int:
    """Return the velocity register for a speed of at least 0, rounded to the nearest; 33.554432 per count/s at SR 1.

    Raises:
        ValueOutOfRange: negative or not a number, beyond the register, or so small that it would become 0.
    """
    return _programmed("velocity", "counts/s", counts_per_s, _velocity_factor(servo_divisor, profile))


def velocity_counts_per_s(programmed: int, servo_divisor: int, profile: Profile) -> float:
    """Return the speed that a velocity register stands for, in counts per second.

    Raises:
        ValueOutOfRange: the servo rate divisor is outside 1 to 255.
    """
    return programmed / _velocity_factor(servo_divisor, profile)


def programmed_acceleration(counts_per_s2: float, servo_divisor: int, profile: Profile) -> int:
    """Return the acceleration register, rounded to the nearest; 0.017179869184 per count/s^2 at SR 1.

    Raises:
        ValueOutOfRange: negative or not a number, beyond the register, or so small that it would become 0.
    """
    return _programmed("acceleration", "counts/s^2", counts_per_s2, _acceleration_factor(servo_divisor, profile))


def acceleration_counts_per_s2(programmed: int, servo_divisor: int, profile: Profile) -> float:
    """Return the acceleration that an acceleration register stands for, in counts per second squared.

    Raises:
        ValueOutOfRange: the servo rate divisor is outside 1 to 255.
    """
    return programmed / _acceleration_factor(servo_divisor, profile)


def baud_divisor(baud: int, codes: BaudCodes = BaudCodes.MANUAL) -> int:
    """Return the Set Baud Rate code of a rate.

    Raises:
        ValueOutOfRange: no code is known for this rate.
    """
    divisors = BAUD_DIVISORS[codes]
    divisor = divisors.get(baud)
    if divisor is None:
        allowed = ", ".join(str(known) for known in divisors)
        nearest = min(divisors, key=lambda known: abs(known - baud))
        raise ValueOutOfRange(f"{baud} baud is not one of {allowed}", value=baud, limit=allowed, nearest=nearest)
    return divisor


def actual_baud(divisor: int) -> float:
    """Return the rate that a module with a 20 MHz clock really uses with this code, 0 to 255."""
    return PROCESSOR_HZ / CLOCKS_PER_BIT / (divisor + 1)


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
    return SERVO_CYCLE_S * (servo_divisor if profile.divisor_slows_profile else 1)


def _programmed(what: str, unit: str, value: float, factor: float) -> int:
    most = MOST_RATE / factor
    if not 0 <= value <= most:
        nearest = most if value > most else 0.0
        raise ValueOutOfRange(
            f"{what} {value:.10g} {unit} is outside 0 to {most:.10g}",
            value=value,
            limit=nearest,
            nearest=nearest,
        )
    register = math.floor(value * factor + 0.5)
    if register == 0 and value > 0:
        least = 1 / factor
        raise ValueOutOfRange(
            f"{what} {value:g} {unit} is too small for the drive, the least is {least:g}",
            value=value,
            limit=least,
            nearest=least,
        )
    return min(register, MOST_RATE)
