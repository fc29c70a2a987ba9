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

from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType

from ldcnd.drivers import driver
from ldcnd.drivers.driver import AxisReading
from ldcnd.drivers.ldcn.profiles import Profile
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


@dataclass(frozen=True, slots=True)
class Fault:
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
        return self.code.remedy

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
    latched: Fault | None = None
    closed: bool = False
    seen: bool = True
    absolute: bool | None = None


AFTER_RESET = Knowledge(pic_ae=False, nothing_latched=True, absolute=False)
"""Manuals, "Power-up and Reset Conditions"."""


def diagnose(profile: Profile, status: Status, known: Knowledge) -> tuple[Fault, ...]:
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
    elif known.pic_ae or _servo_on(status):
        faults = _power_driver_on(profile, status, known)
    elif known.pic_ae is None:
        faults = _power_driver_not_known(status, known)
    else:
        faults = _power_driver_off(status, known)
    return tuple(faults + _warnings(status))


def _power_driver_off(status: Status, known: Knowledge) -> list[Fault]:
    """Read the rows of the table with Pic_ae = 0; a limit bit at 0 is no limit switch then."""
    flags, cause = status.flags, known.latched
    both = StatusFlag.LIMIT1 | StatusFlag.LIMIT2
    if flags & StatusFlag.POWER_ON:
        faults = [cause] if cause and cause.code in _DRIVER_STAYS else []  # the others would hold bit 3 at 0
        if not flags & StatusFlag.LIMIT1:
            faults.append(Fault(FaultCode.STOP_INPUT, latched=False))
        if not flags & StatusFlag.LIMIT2:
            faults.append(Fault(FaultCode.OVERHEAT, latched=False))
        return faults
    if known.nothing_latched:
        # the chapter on the stop input says that it, too, clears bit 3
        code = FaultCode.OVERVOLTAGE if flags & both == both else FaultCode.LATCHED_FAULT
        present = Fault(code, latched=False)
        return [cause, present] if cause else [present]
    return [cause or _UNREADABLE]


def _power_driver_not_known(status: Status, known: Knowledge) -> list[Fault]:
    """Read a status that means one thing with Pic_ae = 0 and another with 1, with the loop open."""
    flags = status.flags
    if known.latched:
        return [known.latched]
    if not flags & StatusFlag.POWER_ON:
        return [_UNREADABLE]
    both = StatusFlag.LIMIT1 | StatusFlag.LIMIT2
    if flags & both != both and flags & StatusFlag.POSITION_ERROR:
        return [Fault(FaultCode.LATCHED_FAULT, latched=True)]  # position error, or stop input or overheat
    return []


def _power_driver_on(profile: Profile, status: Status, known: Knowledge) -> list[Fault]:
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
        return [Fault(code, latched=True)]
    return [Fault(FaultCode.POSITION_ERROR, latched=True)]


def _power_driver_cause(status: Status) -> Fault:
    match bool(status.flags & StatusFlag.LIMIT2), bool(status.flags & StatusFlag.LIMIT1):
        case True, True:
            return Fault(FaultCode.OVERHEAT, latched=True)
        case False, True:
            return Fault(FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE, latched=True)
        case False, False:
            return Fault(FaultCode.OVERCURRENT, latched=True)
        case _ if status.aux is None:
            return _UNREADABLE
    if status.aux & AuxFlag.INDEX:
        return Fault(FaultCode.STOP_INPUT, latched=True)
    return Fault(FaultCode.ENCODER_OR_HALL, latched=True, loses_position=True)


def _pic_servo_faults(profile: Profile, status: Status, known: Knowledge) -> list[Fault]:
    cause = known.latched
    if cause is None and known.closed and _tripped(status):
        # a loss of motor power opens the loop and sets the same flag, so the drive must have been watched
        code = FaultCode.POSITION_ERROR if status.flags & StatusFlag.POWER_ON else FaultCode.POWER_LOST
        cause = Fault(code if known.seen else FaultCode.LATCHED_FAULT, latched=True)
    faults = [cause] if cause else []
    if not status.flags & StatusFlag.POWER_ON and not (cause and cause.code is FaultCode.POWER_LOST):
        faults.append(Fault(FaultCode.POWER_LOST, latched=False))
    if profile.current_limit and status.flags & StatusFlag.OVERCURRENT:
        faults.append(Fault(FaultCode.CURRENT_LIMIT, latched=True))
    return faults


def _warnings(status: Status) -> list[Fault]:
    aux = status.aux or AuxFlag(0)
    return [
        Fault(code, latched=True, loses_position=code is FaultCode.POSITION_WRAP)
        for flag, code in (
            (AuxFlag.POSITION_WRAP, FaultCode.POSITION_WRAP),
            (AuxFlag.SERVO_OVERRUN, FaultCode.SERVO_OVERRUN),
        )
        if aux & flag
    ]


def _servo_on(status: Status) -> bool:
    return status.aux is not None and bool(status.aux & AuxFlag.SERVO_ON)


def _tripped(status: Status) -> bool:
    """Whether the drive has switched the servo off; with the servo on the flag is an old one."""
    return bool(status.flags & StatusFlag.POSITION_ERROR) and not _servo_on(status)


_DRIVER_STAYS = frozenset({FaultCode.POSITION_ERROR, FaultCode.SENSOR_FAULT, FaultCode.LATCHED_FAULT})
"""Causes that a Logosol drive shows with bit 3 set."""
_UNREADABLE = Fault(FaultCode.LATCHED_FAULT, latched=True, loses_position=True)
"""Encoder or Hall signals may be among what it can be."""


def sensor_lost(profile: Profile, adc: int | None) -> bool:
    """Tell whether an A/D value means a broken sensor; without a value nothing is known against it."""
    if adc is None:
        return False
    return not SENSOR_LEAST <= adc << (SENSOR_BITS - profile.adc_bits) <= SENSOR_MOST


BEGUN_COUNTS = 16
"""A counter that was reset reads 0, and a shaft that its loop has let go settles near it."""
FOREIGN_CAPTURE = "a capture is armed that this daemon has not armed"
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
_SERVO_ON, _MOTION_LOCKED, _INDEX = map(int, (AuxFlag.SERVO_ON, AuxFlag.MOTION_LOCKED, AuxFlag.INDEX))
"""As numbers: arithmetic with flags costs ten times as much, and every reply needs it."""


Levels = tuple[bool, bool, bool, bool, bool | None, bool | None, bool | None, bool | None, bool | None]
"""Armed for homing, motion locked, servo on, profile done, reverse limit, forward limit, index, stop input, Pic_ae."""


@dataclass(frozen=True, slots=True)
class _Shown:
    """What the flags of a status packet say: worked out again only when they, or what is known, have changed."""

    faults: tuple[driver.Fault, ...]
    levels: Levels


NOTHING_SHOWN = _Shown((), (False, False, False, False, None, None, None, None, None))


class DriveState:
    """The record of one drive: what was sent to it, and what it has shown.

    Attributes:
        known: what decides on the meaning of its status.
        homing_armed: a capture was armed and has not been seen to come.
        loop_may_open: the loop is open on purpose (PWM mode), or will be once home is captured: then the position
            error flag, which every open loop shows, is no fault.
        motion_locked: the drive refuses motion since it homed on a limit switch.
        servo_divisor: servo rate divisor in force.
        guard: the limit switch at which the drive stops the present motion by itself; empty without one.
        guard_hit: it has.
        offset_counts: what the position counter lacks of the counts since the reset of the drive: Reset Position has
            set it back by this amount.
        setting_back: where the counter stood when Reset Position was sent to it last, until a reading shows the effect.
        counts: the latest position, in counts since the reset of the drive.
    """

    def __init__(self, name: str, profile: Profile) -> None:
        self._name = name
        self._profile = profile
        self._cycle_s = profile.servo_cycle_s
        self._question: object = ()  # what flags and faults were worked out from last
        self._shown: _Shown = NOTHING_SHOWN
        self.restarted()

    # -- what was commanded ------------------------------------------------------------------------------------------

    def restarted(self) -> None:
        """The drive was reset or lost power: nothing that was sent before holds any more."""
        self.known = AFTER_RESET
        self.homing_armed = False
        self.loop_may_open = False
        self.motion_locked = False
        self.servo_divisor = 1
        self.guard = ""
        self.guard_hit = False
        self.offset_counts = self.setting_back = self.counts = 0

    def taken_over(self, status: Status) -> None:
        """The drive is adopted as it is, and this host has never known it; the status packet has the auxiliary byte."""
        self.restarted()
        self.known = Knowledge(closed=_servo_on(status))
        self.homing_armed = bool(status.flags & StatusFlag.HOME_IN_PROGRESS)

    def unseen(self) -> None:
        """The drive was out of reach for a while; nothing was sent to it meanwhile, by this host at least."""
        self.known = replace(self.known, seen=False)

    def switched_unconfirmed(self) -> None:
        """A Stop Motor was sent, or may have been, that was not acknowledged: it may have opened the loop."""
        self.known = replace(self.known, pic_ae=None, nothing_latched=False, closed=False)

    def switched(self, *, pic_ae: bool, closed: bool) -> None:
        """The drive acknowledged a Stop Motor that closes the loop, or opens it."""
        self.known = replace(self.known, pic_ae=pic_ae, nothing_latched=False, closed=closed, seen=True, absolute=False)
        self.loop_may_open = False

    def clearing(self) -> None:
        """Clear Sticky Bits is on its way: a cause that was known may be gone before that is acknowledged."""
        if self.known.latched and self.known.pic_ae is not True:
            loses = self.known.latched.loses_position
            self.known = replace(self.known, latched=Fault(FaultCode.LATCHED_FAULT, latched=True, loses_position=loses))

    def cleared(self) -> None:
        """The drive acknowledged Clear Sticky Bits; it discards the cause of a switch-off only with Pic_ae = 0."""
        if self.known.pic_ae is False:
            self.known = replace(self.known, latched=None, nothing_latched=True)

    def loaded(self, *, absolute: bool, opens_loop: bool) -> None:
        """A motion was loaded: to an analog target or not; one that opens the loop on purpose, at once or at home."""
        self.known = replace(self.known, absolute=absolute)
        self.loop_may_open = opens_loop

    # -- what it shows -----------------------------------------------------------------------------------------------

    def reading(self, status: Status, asked: frozenset[TelemetryItem] = frozenset()) -> AxisReading:
        """Interpret a status packet that was requested for these items.

        Raises:
            BadReply: position, velocity or the auxiliary byte is missing.
        """
        if status.position is None or status.velocity is None or status.aux is None:
            raise BadReply(f"axis {self._name}: the status packet lacks position, velocity or aux")
        faults = self.faults(status)
        homing, locked, enabled, done, reverse, forward, index, stop_input, pic_ae = self._shown.levels
        counter = status.position
        if self.setting_back and abs(counter) < abs(self.setting_back) / 2:
            self.offset_counts += self.setting_back
            self.setting_back = 0
        self.counts = counts = counter + self.offset_counts
        if not homing:
            self.homing_armed = False
            self.guard_hit = bool(self.guard)
        self.motion_locked = locked
        tick_s = self._cycle_s * (self.servo_divisor if self._profile.divisor_slows_profile else 1)
        return AxisReading(
            position_counts=counts,
            following_error_counts=status.position_error,
            velocity_counts_per_s=status.velocity / tick_s,
            velocity_resolution_counts_per_s=1.0 / tick_s,
            adc_counts=status.adc,
            enabled=enabled,
            profile_done=done,
            homing=homing,
            faults=faults,
            reverse_limit=reverse,
            forward_limit=forward,
            index=index,
            stop_input=stop_input,
            amplifier_enable=pic_ae,
            asked=asked,
            cut_short=f"the drive stopped at the {self.guard}" if self.guard_hit else "",
            begun_anew=-BEGUN_COUNTS <= counter <= BEGUN_COUNTS,
            altered=FOREIGN_CAPTURE if homing and not self.homing_armed else "",
        )

    def faults(self, status: Status) -> tuple[driver.Fault, ...]:
        """Return the drive's complaints; recomputed only when something that they depend on has changed."""
        adc = status.adc if self.known.absolute is not False else None
        if (status.flags, status.aux, adc, self.known, self.loop_may_open) != self._question:
            faults = self._diagnose(status)
            self._shown = _Shown(faults, self._levels(int(status.flags), int(status.aux or 0)))
            self._question = (status.flags, status.aux, adc, self.known, self.loop_may_open)
        return self._shown.faults

    def _levels(self, flags: int, aux: int) -> "Levels":
        """Return what the flags mean now that the faults are known."""
        profile, known = self._profile, self.known
        logosol, powered, closed = profile.pic_ae_diagnostics, flags & _POWER_ON, aux & _SERVO_ON
        shows_limits = not logosol or (bool(known.pic_ae) and bool(powered))
        stop_input = None
        if logosol and (closed or (known.pic_ae is False and powered)):
            stop_input = not (closed or flags & _LIMIT1)
        reverse, forward = (_LIMIT2, _LIMIT1) if profile.limit1_is_forward else (_LIMIT1, _LIMIT2)
        return (
            bool(flags & _HOMING),
            profile.motion_lock_from is not None and bool(aux & _MOTION_LOCKED),
            bool(closed),
            bool(flags & _MOVE_DONE),
            bool(flags & reverse) if shows_limits else None,
            bool(flags & forward) if shows_limits else None,
            None if logosol and not powered else bool(aux & _INDEX) is profile.live_aux,
            stop_input,
            known.pic_ae,
        )

    def _diagnose(self, status: Status) -> tuple[driver.Fault, ...]:
        self._learn(status)
        open_on_purpose = self.loop_may_open and not status.flags & StatusFlag.HOME_IN_PROGRESS
        found = tuple(
            fault
            for fault in diagnose(self._profile, status, self.known)
            if not (open_on_purpose and fault.code is FaultCode.POSITION_ERROR)
        )
        cause = next((fault for fault in found if fault.latched and fault.stops), None)
        if status.aux is not None:
            self.known = replace(self.known, latched=cause, seen=True)
        return tuple(
            driver.Fault(fault.code.value, fault.remedy, stops=fault.stops, loses_position=fault.loses_position)
            for fault in found
        )

    def _learn(self, status: Status) -> None:
        """Take from a status what it proves."""
        logosol = self._profile.pic_ae_diagnostics
        if _servo_on(status):
            # PIC-SERVO closes its loop whatever the amplifier (manual, 5.2), a Logosol drive does not
            pic_ae = True if logosol else self.known.pic_ae
            self.known = replace(self.known, pic_ae=pic_ae, nothing_latched=False, latched=None, closed=True)
        elif logosol and self.known.pic_ae is False and status.flags & StatusFlag.POWER_ON:
            self.known = replace(self.known, nothing_latched=True)
