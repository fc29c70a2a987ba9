"""LDCN/NMC registers: codes of baud rates, and the data of Set Gain.

Sources: LS-182AP manual, "Servo Control", "Set Gain", "Power-up and Reset Conditions", "Set Baud Rate" and the
calculation at its end; PIC-SERVO manual, 4.3 to 4.5, 5.2; for PIC-SERVO SC later vendor data sheets.
"""

from enum import Enum
from types import MappingProxyType

from ldcnd.drivers.driver import Gains
from ldcnd.drivers.ldcn.packet import Field
from ldcnd.drivers.ldcn.profiles import CLOCK_HZ, CYCLE_CLOCKS, Profile
from ldcnd.errors import NotSupported, ValueOutOfRange

SERVO_CYCLE_S = CYCLE_CLOCKS / CLOCK_HZ
"""The servo period of a device with the usual clock at divisor 1: 0.512 ms."""
FRACTION = 1 << 16
MOST_RATE = 0x7FFF_FFFF
"""The largest programmed acceleration, and the largest velocity of most devices."""
MOST_DIVISOR = 0xFF
CLOCKS_PER_BIT = 16
BAUD_TOLERANCE = 0.01
"""Most that a rate may differ from what a divisor makes: half of what a receiver bears is left to the host."""
RESET_BAUD = 19_200
"""The rate after power-up and Hard Reset, with the usual clock."""
RESET_BAUD_CODE = 0x3F


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
BAUD_KEYS = MappingProxyType({code: baud for rates in BAUD_DIVISORS.values() for baud, code in rates.items()})
"""The table of PIC-SERVO SC for the byte: it has the codes of both families and sets its clock to the rate itself."""


def baud_divisor(baud: int, codes: BaudCodes = BaudCodes.MANUAL, clock_hz: int = CLOCK_HZ) -> int:
    """Return the Set Baud Rate code of a rate: a printed one, or the divisor that makes it within 1 %.

    "Please refer to the PIC16C7x data sheet for details in obtaining other baud rates" (PIC-SERVO manual, 5.2).

    Raises:
        ValueOutOfRange: no divisor makes this rate; names the nearest that one makes.
    """
    if clock_hz == CLOCK_HZ and (printed := BAUD_DIVISORS[codes].get(baud)) is not None:
        return printed
    divisor = min(max(round(clock_hz / CLOCKS_PER_BIT / baud) - 1, 0), MOST_DIVISOR) if baud > 0 else MOST_DIVISOR
    made = actual_baud(divisor, clock_hz)
    if abs(made - baud) > BAUD_TOLERANCE * made:
        raise ValueOutOfRange(
            f"no divisor of a {clock_hz / 1e6:g} MHz clock makes {baud} baud; the nearest rate is {made:.0f}",
            value=baud,
            limit=round(made),
            nearest=round(made),
        )
    return divisor


def actual_baud(divisor: int, clock_hz: int = CLOCK_HZ) -> float:
    """Return the rate that a module really uses with this code, 0 to 255."""
    return clock_hz / CLOCKS_PER_BIT / (divisor + 1)


def baud_at_reset(clock_hz: int) -> int:
    """Return the rate after power-up and Hard Reset: 19200, and in proportion with another clock."""
    return RESET_BAUD if clock_hz == CLOCK_HZ else round(actual_baud(RESET_BAUD_CODE, clock_hz))


def module_baud(profile: Profile, code: int) -> float | None:
    """Return the rate that a device takes at this code of Set Baud Rate, 0 to 255; None when it has no such code."""
    return BAUD_KEYS.get(code) if profile.baud_keys else actual_baud(code, profile.clock_hz)


_KP = Field("KP", 2, 0, 0x7FFF)
_KD = Field("KD", 2, 0, 0x7FFF)
_KI = Field("KI", 2, 0, 0x7FFF)
_IL = Field("IL", 2, 0, 0x7FFF)
_OL = Field("OL", 1, 0, 0xFF)
_CL = Field("CL", 1, 0, 0xFF)
_RESERVED_CL = Field("CL (reserved on this drive)", 1, 0, 0)
_SR = Field("SR", 1, 1, MOST_DIVISOR)
_DEADBAND = Field("deadband compensation", 1, 0, 0xFF)
_STEP_MULTIPLIER = Field("step multiplier", 1, 1, 0xFF)

BYTES_WITH_DEADBAND = 14
_BYTES_WITH_STEP_MULTIPLIER = 15


def encode_gains(profile: Profile, gains: Gains) -> bytes:
    """Return the 13, 14 or 15 data bytes for this device.

    Raises:
        ValueOutOfRange: a value does not fit its register.
        NotSupported: the device lacks a register that is not at its default.
    """
    if gains.deadband and profile.gain_bytes < BYTES_WITH_DEADBAND:
        raise NotSupported(f"{profile.title} has no deadband compensation")
    if gains.step_multiplier != 1 and profile.gain_bytes < _BYTES_WITH_STEP_MULTIPLIER:
        raise NotSupported(f"{profile.title} has no step multiplier")
    values = (gains.kp, gains.kd, gains.ki, gains.il, gains.ol, gains.cl, gains.el, gains.sr)
    optional = (gains.deadband, gains.step_multiplier)
    fields = gain_fields(profile)
    return b"".join(field.encode(value) for field, value in zip(fields, values + optional, strict=False))


def decode_gains(profile: Profile, data: bytes) -> Gains:
    """Take data bytes as this device would, in range or not.

    Surplus bytes are ignored, a missing step multiplier is 1, everything else that is missing is 0.
    """
    values = []
    at = 0
    for field in gain_fields(profile):
        present = field is not _STEP_MULTIPLIER or at < len(data)
        values.append(field.decode(data[at:]) if present else 1)
        at += field.width
    return Gains(*values)


def gain_fields(profile: Profile) -> tuple[Field, ...]:
    """Return the registers in order; older devices have fewer."""
    fields: tuple[Field, ...] = (
        _KP,
        _KD,
        _KI,
        _IL,
        _OL,
        _CL if profile.current_limit else _RESERVED_CL,
        Field("EL", 2, 0, profile.most_error_limit),
        _SR,
    )
    if profile.gain_bytes >= BYTES_WITH_DEADBAND:
        fields += (_DEADBAND,)
    if profile.gain_bytes >= _BYTES_WITH_STEP_MULTIPLIER:
        fields += (_STEP_MULTIPLIER,)
    return fields
