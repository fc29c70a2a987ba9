"""The contract between the daemon and a drive whose parameters, alarms and counters can be read over its line."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from ldcnd.contract.parameters import (
    AlarmEntry,
    CounterName,
    DriveFacts,
    MonitorReading,
    ParameterInfo,
    ParameterValue,
    PlannedParameters,
    PlanParameters,
    WriteParameter,
)
from ldcnd.contract.samples import MonitorName


@dataclass(frozen=True, slots=True)
class MonitorValue:
    """One monitor, read.

    Attributes:
        reading: which, and what it says.
        resolved: a counter that was off by 65536 and was corrected by what it said before.
    """

    reading: MonitorReading
    resolved: bool = False


@dataclass(frozen=True, slots=True)
class Written:
    """The outcome of a parameter write.

    Attributes:
        value: both memories, read after the write.
        written: a write was sent to the drive; false when it had the value already.
        remarks: what deserves attention.
    """

    value: ParameterValue
    written: bool
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ClearedCounter:
    """The outcome of a counter clear.

    Attributes:
        value: what it counts now, signed.
        remarks: what deserves attention.
    """

    value: int
    remarks: tuple[str, ...] = ()


class ParameterAccess(ABC):
    """The parameters of one drive; one call at a time.

    Every call may raise the `BusError` that befell it, or the `DriveFault` with which the drive declined.
    """

    @abstractmethod
    def known(self) -> tuple[ParameterInfo, ...]:
        """Return what is known of the listed parameters."""

    @abstractmethod
    async def read(self, parameter: str, *, unlisted: bool = False) -> ParameterValue:
        """Read one parameter from both memories.

        Raises:
            ValueOutOfRange: there is no such parameter.
        """

    @abstractmethod
    async def read_all(self) -> tuple[ParameterValue, ...]:
        """Read all listed parameters that the drive has."""

    @abstractmethod
    async def facts(self) -> DriveFacts:
        """Read what the drive is: type, version, switches."""

    @abstractmethod
    async def plan(self, request: PlanParameters) -> PlannedParameters:
        """List the writes after which the drive would hold the values of a request; only reads."""

    @abstractmethod
    async def write(self, request: WriteParameter) -> Written:
        """Write one parameter unless it has the value already, and read both memories afterwards.

        Raises:
            ValueOutOfRange: there is no such parameter.
            NotSupported: EEPROM may not be written here.
            EepromBudgetSpent: it was written too often.
            WrongState: the wires do not allow writing, or a change of the unit number is not confirmed.
            OutcomeUnknown: the line failed before the write could be read back.
        """

    @abstractmethod
    async def clear_counter(self, counter: CounterName) -> ClearedCounter:
        """Set a pulse counter to 0 and read it.

        Raises:
            WrongState: command pulses come in, the motor turns, or the drive is busy.
        """

    @abstractmethod
    async def restart_eeprom_count(self, writes: int) -> int:
        """Count EEPROM writes of a replaced drive from here on; return what was counted for the one before.

        Raises:
            NotSupported: no count is kept.
        """

    @abstractmethod
    async def alarms(self) -> tuple[AlarmEntry, tuple[AlarmEntry, ...]]:
        """Read the present alarm and the history."""

    @abstractmethod
    async def monitors(self, names: tuple[MonitorName, ...]) -> tuple[MonitorValue, ...]:
        """Read monitors once, all of them where none is named; those that the drive lacks are left out."""

    @property
    @abstractmethod
    def eeprom_writes(self) -> int | None:
        """How many writes the drive's EEPROM has taken in all; None where they are not counted."""
