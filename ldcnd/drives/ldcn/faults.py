"""Faults in LDCN/NMC status packets, interpreted with the host's record of the drive, and their remedies.

On Logosol drives status bits 3, 5, 6 and aux bit 0 form a code whose meaning depends on the power driver enable bit
Pic_ae: while it is 0 they show what is wrong at present, while it is 1 what switched the power driver off. Bit 3 stays
0 after that until Pic_ae is 0 and Clear Sticky Bits has found nothing wrong any more (footnote of the table): with
Pic_ae = 0 it means overvoltage only if nothing can be latched. PIC-SERVO has a power bit, a sticky position error and a
sticky current limit. Neither reports Pic_ae, so the host records what it has sent to the drive and which
cause it has seen, and where the cause is unknown it says so: `FaultCode.LATCHED_FAULT`.
Sources: LS-182AP manual, "Diagnostic bits" and "Status byte and auxiliary status byte definitions"; PIC-SERVO manual,
4.5 and 5.3. The position error flag is also set whenever the servo is off: alone it is no fault.
"""

from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag, StatusPacket
from ldcnd.drives.ldcn.profiles import Profile

# A/D values "less than 8" and "more than 1015" disable it (LS-182AP manual, "Analog positioning sensor control")
SENSOR_LEAST = 8
SENSOR_MOST = 1015
SENSOR_BITS = 10
"""The analog sensor counts as connected between these A/D values of 10 bits; coarser converters are scaled up."""


class FaultCode(StrEnum):
    """Everything a drive of this family can complain about."""

    STOP_INPUT = "stop_input"
    OVERVOLTAGE = "overvoltage"
    MOTOR_SHORT_OR_OVERVOLTAGE = "motor_short_or_overvoltage"
    OVERHEAT = "overheat"
    OVERCURRENT = "overcurrent"
    ENCODER_OR_HALL = "encoder_or_hall"
    POSITION_ERROR = "position_error"
    SENSOR_FAULT = "sensor_fault"
    POWER_LOST = "power_lost"
    LATCHED_FAULT = "latched_fault"
    CURRENT_LIMIT = "current_limit"
    POSITION_WRAP = "position_wrap"
    SERVO_OVERRUN = "servo_overrun"

    @property
    def remedy(self) -> str:
        """Meaning and remedy, for an operator."""
        return _REMEDIES[self]


WARNINGS = frozenset({FaultCode.CURRENT_LIMIT, FaultCode.POSITION_WRAP, FaultCode.SERVO_OVERRUN})
"""Conditions that do not switch the motor off: current limiting only lowers the PWM value (PIC-SERVO manual, 4.3)."""

_UNFOLLOWED = frozenset(
    {FaultCode.POSITION_ERROR, FaultCode.OVERCURRENT, FaultCode.ENCODER_OR_HALL, FaultCode.LATCHED_FAULT}
)
"""A jam and an encoder that stands still look the same: in both the motor pushes as far as it may. A cause that is not
known may be either."""

_REMEDIES = MappingProxyType(
    {
        FaultCode.STOP_INPUT: "the stop input is open: close the emergency stop circuit, then reset",
        FaultCode.OVERVOLTAGE: "the supply voltage is too high: check supply and braking energy, then reset",
        FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE: (
            "short circuit at the motor output, or supply voltage too high: check motor, cable and supply, then reset"
        ),
        FaultCode.OVERHEAT: "the drive is too hot (80 degC): let it cool down, check load and cooling, then reset",
        FaultCode.OVERCURRENT: (
            "the current stayed at its limit for the overload time: check for a jam and the current setting, then reset"
        ),
        FaultCode.ENCODER_OR_HALL: (
            "encoder or Hall signals are lost: check sensor cable and supply, reset, find the reference position again"
        ),
        FaultCode.POSITION_ERROR: (
            "the motor left the position error limit: check for a jam, gains and acceleration, then reset; home again"
            " if the shaft has moved and its position has not"
        ),
        FaultCode.SENSOR_FAULT: "the analog position sensor is disconnected or at its end: check its cable, then reset",
        FaultCode.POWER_LOST: "the motor supply is off: switch it on, then reset",
        FaultCode.LATCHED_FAULT: (
            "the drive has tripped, and its status does not show why: check stop circuit, supply, motor, encoder and"
            " temperature, then reset"
        ),
        FaultCode.CURRENT_LIMIT: "the motor current was limited: if it lasts check for a jam; reset clears the flag",
        FaultCode.POSITION_WRAP: (
            "the 32-bit position counter wrapped around: reset, find the reference position again"
        ),
        FaultCode.SERVO_OVERRUN: "the drive's processor was late for a servo cycle: harmless unless it lasts",
    }
)
_REMEMBERED = MappingProxyType(
    {
        FaultCode.STOP_INPUT: (
            "the stop input was opened, and may be open still: close the emergency stop circuit, then reset"
        ),
        FaultCode.OVERHEAT: "the drive was too hot (80 degC): let it cool down, check load and cooling, then reset",
        FaultCode.ENCODER_OR_HALL: (
            "encoder or Hall signals were lost: check sensor cable and supply, reset, find the reference position again"
        ),
        FaultCode.SENSOR_FAULT: (
            "the analog position sensor was disconnected or at its end: check its cable, then reset"
        ),
        FaultCode.POWER_LOST: "the motor supply was off: see that it is on, then reset",
    }
)
"""What is said of a cause of which only is known that it switched the motor off: it may be gone."""


@dataclass(frozen=True, slots=True)
class LdcnFault:
    """One complaint.

    Attributes:
        code: which.
        latched: it switched the motor off, and the drive or the host remembers it: the cause may be gone; it takes
            Clear Sticky Bits (on Logosol drives with Pic_ae = 0) to find out. Otherwise the cause is there at present.
        loses_position: counts may have been missed.
    """

    code: FaultCode
    latched: bool
    loses_position: bool = False

    @property
    def remedy(self) -> str:
        """Meaning and remedy, for an operator."""
        return (_REMEMBERED.get(self.code) if self.latched else None) or self.code.remedy

    @property
    def hides_motion(self) -> bool:
        """Whether it may be an encoder that does not count: what is read then looks like rest."""
        return self.code in _UNFOLLOWED

    @property
    def stops(self) -> bool:
        """Whether the motor is off because of it, or cannot be switched on by the drive's own rules.

        Motor power that is missing while the loop is open stops nothing, and its return moves nothing.
        """
        return self.code not in WARNINGS and (self.latched or self.code is not FaultCode.POWER_LOST)


@dataclass(frozen=True, slots=True)
class Knowledge:
    """The host's record of a drive beyond its status.

    Attributes:
        pic_ae: bit 0 of the last Stop Motor that the drive executed; None while that is not known.
        nothing_latched: the power driver holds no cause: after a reset, after Clear Sticky Bits with Pic_ae = 0, and
            once bit 3 was seen set with Pic_ae = 0.
        latched: the cause that switched the motor off and was not cleared since; None without one.
        closed: the loop was closed, and this host has not opened it since.
        seen: the drive was watched since then; false after a time without readings.
        absolute: a motion to an analog target was the last one started; None while that is not known.
    """

    pic_ae: bool | None = None
    nothing_latched: bool = False
    latched: LdcnFault | None = None
    closed: bool = False
    seen: bool = True
    absolute: bool | None = None


AFTER_RESET = Knowledge(pic_ae=False, nothing_latched=True, absolute=False)
"""Manuals, "Power-up and Reset Conditions"."""


def diagnose(profile: Profile, status: StatusPacket, known: Knowledge) -> tuple[LdcnFault, ...]:
    """List what is wrong, worst first; empty when nothing is, or nothing is known to be.

    A servo that was switched off on purpose with the amplifier left on appears like one that a position error switched
    off: the drive makes no difference, so it is reported.

    Args:
        profile: the dialect.
        status: needs the auxiliary byte, and the A/D value for sensor faults. Without it the servo counts as off, and a
            stop input cannot be distinguished from a lost encoder.
        known: what the host remembers.
    """
    if not profile.pic_ae_diagnostics:
        faults = _pic_servo_faults(profile, status, known)
    elif known.pic_ae or servo_on(status):
        faults = _power_driver_on(profile, status, known)
    elif known.pic_ae is None:
        faults = _power_driver_not_known(status, known)
    else:
        faults = _power_driver_off(status, known)
    return tuple(faults + _warnings(status))


def _power_driver_off(status: StatusPacket, known: Knowledge) -> list[LdcnFault]:
    """Read the rows of the table with Pic_ae = 0; a limit bit at 0 is no limit switch then."""
    flags, cause = status.flags, known.latched
    both = StatusFlag.LIMIT1 | StatusFlag.LIMIT2
    if flags & StatusFlag.POWER_ON:
        faults = [cause] if cause and cause.code in _DRIVER_STAYS else []  # the others would hold bit 3 at 0
        if not flags & StatusFlag.LIMIT1:
            faults.append(LdcnFault(FaultCode.STOP_INPUT, latched=False))
        if not flags & StatusFlag.LIMIT2:
            faults.append(LdcnFault(FaultCode.OVERHEAT, latched=False))
        return faults
    if known.nothing_latched:
        # the chapter on the stop input says that it, too, clears bit 3
        code = FaultCode.OVERVOLTAGE if flags & both == both else FaultCode.LATCHED_FAULT
        present = LdcnFault(code, latched=False)
        return [cause, present] if cause else [present]
    return [cause or _UNREADABLE]


def _power_driver_not_known(status: StatusPacket, known: Knowledge) -> list[LdcnFault]:
    """Read a status that means one thing with Pic_ae = 0 and another with 1, with the loop open."""
    flags = status.flags
    # what was seen while the meaning was known still holds: nothing has cleared it since
    if known.latched:
        return [known.latched]
    if not flags & StatusFlag.POWER_ON:
        return [_UNREADABLE]
    both = StatusFlag.LIMIT1 | StatusFlag.LIMIT2
    if flags & both != both and flags & StatusFlag.POSITION_ERROR:
        return [LdcnFault(FaultCode.LATCHED_FAULT, latched=True)]  # position error, or stop input or overheat
    return []


def _power_driver_on(profile: Profile, status: StatusPacket, known: Knowledge) -> list[LdcnFault]:
    """Read the rows of the table with Pic_ae = 1."""
    flags = status.flags
    if not flags & StatusFlag.POWER_ON:
        return [_power_driver_cause(status)]
    if not _tripped(status):
        return []
    if known.latched and known.latched.code in _DRIVER_STAYS:
        return [known.latched]  # the sensor may be back
    both = StatusFlag.LIMIT1 | StatusFlag.LIMIT2
    if known.absolute is not False and flags & both == both and sensor_lost(profile, status.adc):
        code = FaultCode.SENSOR_FAULT if known.absolute else FaultCode.LATCHED_FAULT
        return [LdcnFault(code, latched=True)]
    return [LdcnFault(FaultCode.POSITION_ERROR, latched=True)]


def _power_driver_cause(status: StatusPacket) -> LdcnFault:
    # bits 6 and 5 of the rows that have Power_on = 0 and Pic_ae = 1 (LS-182AP manual, "Diagnostic bits")
    match bool(status.flags & StatusFlag.LIMIT2), bool(status.flags & StatusFlag.LIMIT1):
        case True, True:
            return LdcnFault(FaultCode.OVERHEAT, latched=True)
        case False, True:
            return LdcnFault(FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE, latched=True)
        case False, False:
            return LdcnFault(FaultCode.OVERCURRENT, latched=True)
        case _ if status.aux is None:
            return _UNREADABLE
    # the rows of stop input and of encoder or Hall sensors differ in this bit alone
    if status.aux & AuxFlag.INDEX:
        return LdcnFault(FaultCode.STOP_INPUT, latched=True)
    return LdcnFault(FaultCode.ENCODER_OR_HALL, latched=True, loses_position=True)


def _pic_servo_faults(profile: Profile, status: StatusPacket, known: Knowledge) -> list[LdcnFault]:
    cause = known.latched
    if cause is None and known.closed and _tripped(status):
        # a loss of motor power opens the loop and sets the same flag, so the drive must have been watched
        code = FaultCode.POSITION_ERROR if status.flags & StatusFlag.POWER_ON else FaultCode.POWER_LOST
        cause = LdcnFault(code if known.seen else FaultCode.LATCHED_FAULT, latched=True)
    faults = [cause] if cause else []
    powered = bool(status.flags & StatusFlag.POWER_ON)
    if not powered and profile.sc_extensions and servo_on(status):
        # below 0.9 V at VOLT_SENSE the drive opens its loop; above 4.5 V ENABLE is low until it is over, and the motion
        # then goes on (PIC-SERVO SC data sheet, 4.7)
        faults.append(LdcnFault(FaultCode.OVERVOLTAGE, latched=False))
    elif not powered and not (cause and cause.code is FaultCode.POWER_LOST):
        faults.append(LdcnFault(FaultCode.POWER_LOST, latched=False))
    if profile.current_limit and status.flags & StatusFlag.OVERCURRENT:
        faults.append(LdcnFault(FaultCode.CURRENT_LIMIT, latched=True))
    return faults


def _warnings(status: StatusPacket) -> list[LdcnFault]:
    aux = status.aux or AuxFlag(0)
    return [
        LdcnFault(code, latched=True, loses_position=code is FaultCode.POSITION_WRAP)
        for flag, code in (
            (AuxFlag.POSITION_WRAP, FaultCode.POSITION_WRAP),
            (AuxFlag.SERVO_OVERRUN, FaultCode.SERVO_OVERRUN),
        )
        if aux & flag
    ]


def servo_on(status: StatusPacket) -> bool:
    """Tell whether a status shows the loop closed."""
    return status.aux is not None and bool(status.aux & AuxFlag.SERVO_ON)


def _tripped(status: StatusPacket) -> bool:
    """Whether the drive has switched the servo off; with the servo on the flag is an old one."""
    return bool(status.flags & StatusFlag.POSITION_ERROR) and not servo_on(status)


_DRIVER_STAYS = frozenset({FaultCode.POSITION_ERROR, FaultCode.SENSOR_FAULT, FaultCode.LATCHED_FAULT})
"""Causes that a Logosol drive shows with bit 3 set."""
_UNREADABLE = LdcnFault(FaultCode.LATCHED_FAULT, latched=True, loses_position=True)
"""Encoder or Hall signals may be among what it can be."""


def sensor_lost(profile: Profile, adc: int | None) -> bool:
    """Tell whether an A/D value means a broken sensor; without a value nothing is known against it."""
    if adc is None:
        return False
    return not SENSOR_LEAST <= adc << (SENSOR_BITS - profile.adc_bits) <= SENSOR_MOST
