"""The power stage of a simulated servo drive: what it may drive, what it latches, what the status byte says about it.

Sources: LS-182AP manual, "Diagnostic bits", "Safety features and diagnostics"; PIC-SERVO manual, 4.5, 5.3.
"""

from abc import ABC, abstractmethod
from enum import Enum, StrEnum
from typing import ClassVar

from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag


class FaultCondition(StrEnum):
    """Faults around a drive; set and cleared from outside while it runs."""

    STOP_INPUT = "stop_input"
    OVERVOLTAGE = "overvoltage"
    OVERHEAT = "overheat"
    MOTOR_SHORT = "motor_short"
    OVERCURRENT = "overcurrent"
    ENCODER_LOSS = "encoder_loss"
    """A differential encoder or a Hall sensor lost its signal; Logosol drives notice."""
    MOTOR_POWER_OFF = "motor_power_off"
    """PIC-SERVO; a Logosol drive without its supply is silent altogether."""
    ENCODER_STUCK = "encoder_stuck"
    """The counter stands still, and the drive does not notice."""
    SENSOR_LOST = "sensor_lost"
    """The potentiometer is disconnected: the A/D converter reads 0."""
    LIMITS_ACTUATED = "limits_actuated"
    """Both limit switches are actuated, wherever the shaft is: the wire that they share is broken."""
    STALLED = "stalled"
    """Something holds the shaft."""
    UNBALANCED = "unbalanced"
    """The rotor on the shaft is out of balance: it hits the imbalance switch of its machine."""
    SLOW_PROCESSOR = "slow_processor"
    """The firmware is late for a servo cycle, which is remembered in a sticky bit and changes nothing else."""


class Trip(Enum):
    """Cause that switched a Logosol power driver off; the value is the status byte's pattern in bits 3, 5 and 6."""

    STOP_INPUT = StatusFlag.LIMIT2
    SHORT_OR_OVERVOLTAGE = StatusFlag.LIMIT1
    OVERHEAT = StatusFlag.LIMIT1 | StatusFlag.LIMIT2
    OVERCURRENT = StatusFlag(0)
    ENCODER = "encoder"
    """Same pattern as `STOP_INPUT`; auxiliary bit 0 tells them apart."""
    POSITION_ERROR = "position_error"
    """Shown with power_on set and the limit switches as they are."""
    SENSOR = StatusFlag.LIMIT1 | StatusFlag.LIMIT2 | StatusFlag.POWER_ON


_DRIVER_STAYS = frozenset({None, Trip.POSITION_ERROR, Trip.SENSOR})
"""Causes that leave power_on set."""
_TRIPS = (
    (FaultCondition.STOP_INPUT, Trip.STOP_INPUT),
    (FaultCondition.OVERVOLTAGE, Trip.SHORT_OR_OVERVOLTAGE),
    (FaultCondition.MOTOR_SHORT, Trip.SHORT_OR_OVERVOLTAGE),
    (FaultCondition.OVERHEAT, Trip.OVERHEAT),
    (FaultCondition.OVERCURRENT, Trip.OVERCURRENT),
    (FaultCondition.ENCODER_LOSS, Trip.ENCODER),
)
OF_POWER = frozenset({FaultCondition.MOTOR_POWER_OFF, *(condition for condition, _ in _TRIPS)})
"""Conditions that only a power stage can feel."""


class PowerStage(ABC):
    """Between the servo loop and the motor.

    Attributes:
        conditions: what is wrong at present.
        enabled: the enable bit of Stop Motor as last sent (AMP_EN, Pic_ae).
        drives: whether the motor gets voltage.
        allows_servo: whether the position loop may be closed.
        feels: the conditions that have an effect here, of those that only a power stage can feel.
    """

    feels: ClassVar[frozenset[FaultCondition]]

    def __init__(self) -> None:
        self.conditions: set[FaultCondition] = set()
        self.enabled = False
        self.drives = False
        self.allows_servo = False

    def enable(self, *, on: bool) -> None:
        """Take the enable bit of Stop Motor."""
        self.enabled = on
        self.check()

    @abstractmethod
    def check(self) -> None:
        """Draw the consequences of the conditions."""

    @abstractmethod
    def trip(self, cause: Trip) -> None:
        """Learn that the firmware gave up the loop."""

    @abstractmethod
    def clear(self) -> None:
        """Take Clear Sticky Bits."""

    @abstractmethod
    def flags(self, limits: StatusFlag) -> StatusFlag:
        """Return bits 3, 5 and 6 of the status byte.

        Args:
            limits: the limit switches as they are.
        """

    @abstractmethod
    def aux(self, index: AuxFlag) -> AuxFlag:
        """Return bit 0 of the auxiliary status byte.

        Args:
            index: what the encoder's index makes of it.
        """


class PicServoPower(PowerStage):
    """An external amplifier: an enable pin, and motor power that is sensed and whose loss opens the loop."""

    feels: ClassVar = frozenset({FaultCondition.MOTOR_POWER_OFF})

    def check(self) -> None:
        """Draw the consequences of the conditions."""
        self.allows_servo = FaultCondition.MOTOR_POWER_OFF not in self.conditions
        self.drives = self.enabled and self.allows_servo

    def trip(self, cause: Trip) -> None:
        """Nothing is latched: the loop is open and pos_error is set."""

    def clear(self) -> None:
        """Nothing is latched."""

    def flags(self, limits: StatusFlag) -> StatusFlag:
        """Return bits 3, 5 and 6 of the status byte."""
        return limits | StatusFlag.POWER_ON if self.allows_servo else limits

    def aux(self, index: AuxFlag) -> AuxFlag:
        """Return bit 0 of the auxiliary status byte."""
        return index


class ScPower(PicServoPower):
    """PIC-SERVO SC watches the supply: too low opens the loop, too high only disables the amplifier until it is over.

    Source: PIC-SERVO SC data sheet, 4.7.
    """

    feels: ClassVar = PicServoPower.feels | {FaultCondition.OVERVOLTAGE}

    def check(self) -> None:
        """Draw the consequences of the conditions."""
        super().check()
        self.drives = self.drives and FaultCondition.OVERVOLTAGE not in self.conditions

    def flags(self, limits: StatusFlag) -> StatusFlag:
        """Return bits 3, 5 and 6 of the status byte."""
        return super().flags(limits) if FaultCondition.OVERVOLTAGE not in self.conditions else limits


class LogosolPower(PowerStage):
    """A built-in power driver that latches the cause of its shut-down until Pic_ae = 0 and Clear Sticky Bits.

    A cause that stands while Pic_ae is 0 is shown but not latched; it is latched as soon as Pic_ae is set.
    """

    feels: ClassVar = frozenset(condition for condition, _ in _TRIPS)

    def __init__(self) -> None:
        super().__init__()
        self.latched: Trip | None = None

    def check(self) -> None:
        """Draw the consequences of the conditions."""
        if self.enabled and self.latched is None:
            for condition, cause in _TRIPS:
                if condition in self.conditions:
                    self.latched = cause
                    break
        self.drives = self.allows_servo = self.enabled and self.latched is None

    def trip(self, cause: Trip) -> None:
        """Latch the cause, unless an earlier one is latched."""
        if self.latched is None:
            self.latched = cause
        self.check()

    def clear(self) -> None:
        """Clear the latched cause, with Pic_ae = 0 only."""
        if not self.enabled:
            self.latched = None
        self.check()

    def flags(self, limits: StatusFlag) -> StatusFlag:
        """Return bits 3, 5 and 6 of the status byte."""
        if not self.enabled:
            return self._standing()
        match self.latched:
            case None | Trip.POSITION_ERROR:
                return limits | StatusFlag.POWER_ON
            case Trip.ENCODER:
                return StatusFlag.LIMIT2
            case Trip() as cause:
                return StatusFlag(cause.value)

    def aux(self, index: AuxFlag) -> AuxFlag:
        """Return bit 0 of the auxiliary status byte."""
        if self.enabled and self.latched is Trip.ENCODER:
            return AuxFlag(0)
        if self.enabled and self.latched in _DRIVER_STAYS:
            return index
        return AuxFlag.INDEX

    def _standing(self) -> StatusFlag:
        """Return the diagnostic bits with Pic_ae = 0: set means healthy."""
        flags = StatusFlag(0)
        if self.latched in _DRIVER_STAYS and FaultCondition.OVERVOLTAGE not in self.conditions:
            flags |= StatusFlag.POWER_ON
        if FaultCondition.STOP_INPUT not in self.conditions:
            flags |= StatusFlag.LIMIT1
        if FaultCondition.OVERHEAT not in self.conditions:
            flags |= StatusFlag.LIMIT2
        return flags
