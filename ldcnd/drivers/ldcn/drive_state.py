"""What a host must remember of an LDCN/NMC drive to read its status packets right, and what they then say.

Source: LS-182AP manual, "Diagnostic bits": the same bits mean other things with the power driver off, in absolute
positioning mode, and with the loop opened on purpose.
"""

from ldcnd.drivers.driver import AxisReading, Fault
from ldcnd.drivers.ldcn.faults import LOSE_POSITION, WARNINGS, FaultCode, diagnose
from ldcnd.drivers.ldcn.profiles import Profile
from ldcnd.drivers.ldcn.registers import SERVO_CYCLE_S
from ldcnd.drivers.ldcn.status import AuxFlag, Status, StatusFlag
from ldcnd.errors import BadReply
from ldcnd.model.samples import TelemetryItem

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
        self._diagnosed: tuple[object, tuple[Fault, ...]] = ((), ())  # the latest question, and the answer to it
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
            reverse_limit=bool(flags & _LIMIT1) if shows_limits else None,
            forward_limit=bool(flags & _LIMIT2) if shows_limits else None,
            asked=asked,
        )

    def faults(self, status: Status) -> tuple[Fault, ...]:
        """Return what the drive complains about; worked out anew only when something that it depends on has changed."""
        adc = status.adc if self.absolute else None
        question = (status.flags, status.aux, adc, self.amp_enabled, self.absolute, self.loop_may_open)
        if question != self._diagnosed[0]:
            self._diagnosed = (question, self._diagnose(status))
        return self._diagnosed[1]

    def _diagnose(self, status: Status) -> tuple[Fault, ...]:
        open_on_purpose = self.loop_may_open and not status.flags & StatusFlag.HOME_IN_PROGRESS
        return tuple(
            Fault(
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
