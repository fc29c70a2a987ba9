"""What an LDCN/NMC status packet says, given what the host knows of the drive, and what to do about it.

On Logosol drives status bits 3, 5, 6 and aux bit 0 form a code whose meaning depends on the power driver enable bit
Pic_ae: while it is 0 they show what is wrong at present, while it is 1 what switched the power driver off. PIC-SERVO
has a power bit, a sticky position error and a sticky current limit. So the host remembers what it has told the drive.
Sources: LS-182AP manual, "Diagnostic bits" and "Status byte and auxiliary status byte definitions"; PIC-SERVO manual,
4.5 and 5.3. The position error flag is also set whenever the servo is off: alone it is no fault.
"""

from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from ldcnd.drivers import driver
from ldcnd.drivers.driver import AxisReading
from ldcnd.drivers.ldcn.profiles import Profile
from ldcnd.drivers.ldcn.registers import SERVO_CYCLE_S
from ldcnd.drivers.ldcn.status import AuxFlag, Status, StatusFlag
from ldcnd.errors import BadReply
from ldcnd.model.samples import TelemetryItem

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
    CURRENT_LIMIT = "current_limit"
    POSITION_WRAP = "position_wrap"
    SERVO_OVERRUN = "servo_overrun"

    @property
    def remedy(self) -> str:
        """What it means and what to do, for an operator."""
        return _REMEDIES[self]


WARNINGS = frozenset({FaultCode.CURRENT_LIMIT, FaultCode.POSITION_WRAP, FaultCode.SERVO_OVERRUN})
"""What does not switch the motor off: current limiting only lowers the PWM value (PIC-SERVO manual, 4.3)."""

LOSE_POSITION = frozenset({FaultCode.ENCODER_OR_HALL, FaultCode.POSITION_WRAP})
"""What takes the meaning from the position: counts were missed, or the counter started again at its other end."""

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
            "the motor left the position error limit: check for a jam, gains and acceleration, then reset"
        ),
        FaultCode.SENSOR_FAULT: "the analog position sensor is disconnected or at its end: check its cable, then reset",
        FaultCode.POWER_LOST: "the motor supply is off: switch it on, then reset",
        FaultCode.CURRENT_LIMIT: "the motor current was limited: if it lasts check for a jam; reset clears the flag",
        FaultCode.POSITION_WRAP: (
            "the 32-bit position counter wrapped around: reset, find the reference position again"
        ),
        FaultCode.SERVO_OVERRUN: "the drive's processor was late for a servo cycle: harmless unless it lasts",
    }
)


@dataclass(frozen=True, slots=True)
class Fault:
    """One complaint.

    Attributes:
        code: which.
        latched: the drive remembers it, the cause may be gone; it takes Clear Sticky Bits (on Logosol drives with
            Pic_ae = 0) to find out. Otherwise the cause is there at present.
    """

    code: FaultCode
    latched: bool

    @property
    def remedy(self) -> str:
        """What it means and what to do, for an operator."""
        return self.code.remedy


def diagnose(profile: Profile, status: Status, *, pic_ae: bool, absolute_mode: bool) -> tuple[Fault, ...]:
    """List what is wrong, worst first; empty when nothing is.

    A servo that was switched off on purpose with the amplifier left on looks like one that a position error switched
    off: the drive makes no difference, so it is reported.

    Args:
        profile: the dialect.
        status: needs the auxiliary byte, and the A/D value for sensor faults. Without it the servo counts as off, and a
            stop input cannot be told from a lost encoder: both are reported.
        pic_ae: bit 0 of the last Stop Motor that the drive executed; false after reset.
        absolute_mode: a motion to an analog target was the last one started.
    """
    if not profile.pic_ae_diagnostics:
        faults = _pic_servo_faults(profile, status, amp_enabled=pic_ae)
    elif pic_ae:
        faults = _latched_faults(profile, status, absolute_mode=absolute_mode)
    else:
        faults = _present_faults(status)
    return tuple(faults + _warnings(status))


def _present_faults(status: Status) -> list[Fault]:
    """Read the rows of the table with Pic_ae = 0; a limit bit at 0 is no limit switch then."""
    if not status.flags & StatusFlag.POWER_ON:
        return [Fault(FaultCode.OVERVOLTAGE, latched=False)]
    faults = []
    if not status.flags & StatusFlag.LIMIT1:
        faults.append(Fault(FaultCode.STOP_INPUT, latched=False))
    if not status.flags & StatusFlag.LIMIT2:
        faults.append(Fault(FaultCode.OVERHEAT, latched=False))
    return faults


def _latched_faults(profile: Profile, status: Status, *, absolute_mode: bool) -> list[Fault]:
    """Read the rows of the table with Pic_ae = 1."""
    flags = status.flags
    if not flags & StatusFlag.POWER_ON:
        return [Fault(code, latched=True) for code in _power_driver_codes(status)]
    if not _tripped(status):
        return []
    both = StatusFlag.LIMIT1 | StatusFlag.LIMIT2
    if absolute_mode and flags & both == both and sensor_lost(profile, status.adc):
        return [Fault(FaultCode.SENSOR_FAULT, latched=True)]
    return [Fault(FaultCode.POSITION_ERROR, latched=True)]


def _power_driver_codes(status: Status) -> tuple[FaultCode, ...]:
    match bool(status.flags & StatusFlag.LIMIT2), bool(status.flags & StatusFlag.LIMIT1):
        case True, True:
            return (FaultCode.OVERHEAT,)
        case False, True:
            return (FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE,)
        case False, False:
            return (FaultCode.OVERCURRENT,)
        case _ if status.aux is None:
            return (FaultCode.STOP_INPUT, FaultCode.ENCODER_OR_HALL)
    return (FaultCode.STOP_INPUT,) if status.aux & AuxFlag.INDEX else (FaultCode.ENCODER_OR_HALL,)


def _pic_servo_faults(profile: Profile, status: Status, *, amp_enabled: bool) -> list[Fault]:
    faults = []
    if not status.flags & StatusFlag.POWER_ON:
        faults.append(Fault(FaultCode.POWER_LOST, latched=False))  # switches the servo off, which sets pos_error
    elif amp_enabled and _tripped(status):
        faults.append(Fault(FaultCode.POSITION_ERROR, latched=True))
    if profile.current_limit and status.flags & StatusFlag.OVERCURRENT:
        faults.append(Fault(FaultCode.CURRENT_LIMIT, latched=True))
    return faults


def _warnings(status: Status) -> list[Fault]:
    aux = status.aux or AuxFlag(0)
    return [
        Fault(code, latched=True)
        for flag, code in (
            (AuxFlag.POSITION_WRAP, FaultCode.POSITION_WRAP),
            (AuxFlag.SERVO_OVERRUN, FaultCode.SERVO_OVERRUN),
        )
        if aux & flag
    ]


def _tripped(status: Status) -> bool:
    """Whether a position error has switched the servo off; with the servo on the flag is an old one."""
    servo_on = status.aux is not None and bool(status.aux & AuxFlag.SERVO_ON)
    return bool(status.flags & StatusFlag.POSITION_ERROR) and not servo_on


def sensor_lost(profile: Profile, adc: int | None) -> bool:
    """Tell whether an A/D value means a broken sensor; without a value nothing is known against it."""
    if adc is None:
        return False
    return not SENSOR_LEAST <= adc << (SENSOR_BITS - profile.adc_bits) <= SENSOR_MOST


_MOVE_DONE, _POWER_ON, _LIMIT1, _LIMIT2, _HOMING = map(
    int,
    (
        StatusFlag.MOVE_DONE,
        StatusFlag.POWER_ON,
        StatusFlag.LIMIT1,
        StatusFlag.LIMIT2,
        StatusFlag.HOME_IN_PROGRESS,
    ),
)
_SERVO_ON, _MOTION_LOCKED = map(int, (AuxFlag.SERVO_ON, AuxFlag.MOTION_LOCKED))
"""As numbers: arithmetic with flags costs ten times as much, and every reply needs it."""


class DriveState:
    """The memory of one drive.

    Attributes:
        amp_enabled: bit 0 of the last Stop Motor that the drive acknowledged (Pic_ae).
        homing_armed: a capture was armed and has not been seen to come.
        absolute: a motion to an analog target was the last one loaded.
        loop_may_open: the loop is open on purpose (PWM mode), or will be once home is captured: then the position
            error flag, which every open loop shows, is no fault.
        motion_locked: the drive refuses motion since it homed on a limit switch.
        servo_divisor: servo rate divisor in force.
    """

    def __init__(self, name: str, profile: Profile) -> None:
        self._name = name
        self._profile = profile
        self._diagnosed: tuple[object, tuple[driver.Fault, ...]] = ((), ())  # the latest question, and the answer to it
        self.forget()

    def forget(self) -> None:
        """Take the state of a drive that was just reset."""
        self.amp_enabled = False
        self.homing_armed = False
        self.absolute = False
        self.loop_may_open = False
        self.motion_locked = False
        self.servo_divisor = 1

    def reading(self, status: Status, asked: frozenset[TelemetryItem] = frozenset()) -> AxisReading:
        """Interpret a status packet that was asked for because of these items.

        Raises:
            BadReply: position, velocity or the auxiliary byte is missing.
        """
        if status.position is None or status.velocity is None or status.aux is None:
            raise BadReply(f"axis {self._name}: the status packet lacks position, velocity or aux")
        flags, aux = int(status.flags), int(status.aux)
        if not flags & _HOMING:
            self.homing_armed = False
        if aux & _SERVO_ON:
            self.amp_enabled = True  # no drive closes its loop without; known also after somebody else enabled it
        self.motion_locked = self._profile.motion_lock_from is not None and bool(aux & _MOTION_LOCKED)
        shows_limits = self._shows_limits(flags)
        reverse, forward = (_LIMIT2, _LIMIT1) if self._profile.limit1_is_forward else (_LIMIT1, _LIMIT2)
        tick_s = SERVO_CYCLE_S * (self.servo_divisor if self._profile.divisor_slows_profile else 1)
        return AxisReading(
            position_counts=status.position,
            following_error_counts=status.position_error,
            velocity_counts_per_s=status.velocity / tick_s,
            velocity_resolution_counts_per_s=1.0 / tick_s,
            adc_counts=status.adc,
            enabled=bool(aux & _SERVO_ON),
            profile_done=bool(flags & _MOVE_DONE),
            homing=bool(flags & _HOMING),
            faults=self.faults(status),
            reverse_limit=bool(flags & reverse) if shows_limits else None,
            forward_limit=bool(flags & forward) if shows_limits else None,
            asked=asked,
        )

    def faults(self, status: Status) -> tuple[driver.Fault, ...]:
        """Return what the drive complains about; worked out anew only when something that it depends on has changed."""
        adc = status.adc if self.absolute else None
        question = (status.flags, status.aux, adc, self.amp_enabled, self.absolute, self.loop_may_open)
        if question != self._diagnosed[0]:
            self._diagnosed = (question, self._diagnose(status))
        return self._diagnosed[1]

    def _diagnose(self, status: Status) -> tuple[driver.Fault, ...]:
        open_on_purpose = self.loop_may_open and not status.flags & StatusFlag.HOME_IN_PROGRESS
        return tuple(
            driver.Fault(
                fault.code.value,
                fault.remedy,
                stops=fault.code not in WARNINGS,
                loses_position=fault.code in LOSE_POSITION,
            )
            for fault in diagnose(self._profile, status, pic_ae=self.amp_enabled, absolute_mode=self.absolute)
            if not (open_on_purpose and fault.code is FaultCode.POSITION_ERROR)
        )

    def _shows_limits(self, flags: int) -> bool:
        if not self._profile.pic_ae_diagnostics:
            return True
        return self.amp_enabled and bool(flags & _POWER_ON)
