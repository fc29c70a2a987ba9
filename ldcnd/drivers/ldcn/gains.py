"""The data of Set Gain: position loop, limits and servo rate.

Sources: LS-182AP manual, "Set Gain"; PIC-SERVO manual, 4.3, 5.2; for PIC-SERVO SC later vendor data sheets.
"""

from dataclasses import dataclass

from ldcnd.drivers.ldcn.fields import Field
from ldcnd.drivers.ldcn.profiles import Profile
from ldcnd.drivers.ldcn.registers import MOST_DIVISOR
from ldcnd.errors import NotSupported

_KP = Field("KP", 2, 0, 0x7FFF)
_KD = Field("KD", 2, 0, 0x7FFF)
_KI = Field("KI", 2, 0, 0x7FFF)
_IL = Field("IL", 2, 0, 0x7FFF)
_OL = Field("OL", 1, 0, 0xFF)
_CL = Field("CL", 1, 0, 0xFF)
_RESERVED_CL = Field("CL (reserved on this drive)", 1, 0, 0)
_EL = Field("EL", 2, 0, 0x3FFF)
_SR = Field("SR", 1, 1, MOST_DIVISOR)
_DEADBAND = Field("deadband compensation", 1, 0, 0xFF)
_STEP_MULTIPLIER = Field("step multiplier", 1, 1, 0xFF)

_BYTES_WITH_DEADBAND = 14
_BYTES_WITH_STEP_MULTIPLIER = 15


@dataclass(frozen=True, slots=True)
class Gains:
    """The registers of Set Gain.

    Attributes:
        kp: position gain, 0 to 0x7FFF.
        kd: derivative gain, 0 to 0x7FFF.
        ki: integral gain, 0 to 0x7FFF.
        il: integration limit, 0 to 0x7FFF; the drive multiplies it by 256.
        ol: PWM output limit, 0 to 255; the LS-182AP manual recommends 250.
        cl: current limit, 0 to 255, odd when the sense voltage rises with the current; 0 is off, and the only value on
            Logosol drives.
        el: position error limit, 0 to 0x3FFF counts.
        sr: servo rate divisor, 1 to 255.
        deadband: amplifier deadband compensation, 0 to 255; 0 on PIC-SERVO versions 1 to 3.
        step_multiplier: 1 to 255; 1 on everything but PIC-SERVO SC.
    """

    kp: int
    kd: int
    ki: int
    il: int
    ol: int
    cl: int
    el: int
    sr: int
    deadband: int = 0
    step_multiplier: int = 1


def encode_gains(profile: Profile, gains: Gains) -> bytes:
    """Return the 13, 14 or 15 data bytes for this device.

    Raises:
        ValueOutOfRange: a value does not fit its register.
        NotSupported: the device lacks a register that is not at its default.
    """
    if gains.deadband and profile.gain_bytes < _BYTES_WITH_DEADBAND:
        raise NotSupported(f"{profile.title} has no deadband compensation")
    if gains.step_multiplier != 1 and profile.gain_bytes < _BYTES_WITH_STEP_MULTIPLIER:
        raise NotSupported(f"{profile.title} has no step multiplier")
    values = (gains.kp, gains.kd, gains.ki, gains.il, gains.ol, gains.cl, gains.el, gains.sr)
    optional = (gains.deadband, gains.step_multiplier)
    fields = _fields(profile)
    return b"".join(field.encode(value) for field, value in zip(fields, values + optional, strict=False))


def decode_gains(profile: Profile, data: bytes) -> Gains:
    """Take data bytes as this device would, in range or not.

    Surplus bytes are ignored, a missing step multiplier is 1, everything else that is missing is 0.
    """
    values = []
    at = 0
    for field in _fields(profile):
        present = field is not _STEP_MULTIPLIER or at < len(data)
        values.append(field.decode(data[at:]) if present else 1)
        at += field.width
    return Gains(*values)


def _fields(profile: Profile) -> tuple[Field, ...]:
    """Return the registers in order; older devices have fewer."""
    fields: tuple[Field, ...] = (_KP, _KD, _KI, _IL, _OL, _CL if profile.current_limit else _RESERVED_CL, _EL, _SR)
    if profile.gain_bytes >= _BYTES_WITH_DEADBAND:
        fields += (_DEADBAND,)
    if profile.gain_bytes >= _BYTES_WITH_STEP_MULTIPLIER:
        fields += (_STEP_MULTIPLIER,)
    return fields
