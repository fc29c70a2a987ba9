"""A SmartStep as a guest sets it: what its settings mean in commands of an axis.

Parameters, counters and traces are commands as of any client, so access, the count of EEPROM writes and the books are
those of everybody. An operating mode and the settings of a trace are kept here until the guest executes them: nothing
else reaches 2000H, whose other modes may move a motor. Source: manual 2.2, 3, 4, 5 (2), 6 (2).
"""

from collections.abc import Awaitable, Callable

from ldcnd.contract.commands import AxisCommand, CommandReply
from ldcnd.contract.errors import AddressRefused, BusyTracing, DataRefused
from ldcnd.contract.parameters import ClearCounter, Memory, WriteParameter
from ldcnd.contract.traces import AbortTrace, TakeTrace
from ldcnd.drives.smartstep.addresses import (
    EEPROM_AREA,
    RAM_AREA,
    RAM_OFFSET,
    OperatingMode,
    Register,
    TraceRegister,
    operating_mode,
)
from ldcnd.drives.smartstep.commands import EXECUTE
from ldcnd.drives.smartstep.drive import SmartStepAxis
from ldcnd.drives.smartstep.parameter_store import COUNTERS
from ldcnd.drives.smartstep.trace_data import (
    HIGHEST_PRE_TRIGGER,
    NO_TRIGGER,
    POINTS,
    SHORTEST_INTERVAL,
    DataObject,
    IoObject,
    period_s,
)

Do = Callable[[AxisCommand[CommandReply]], Awaitable[None]]
"""Carries out a command of the axis under the guest's lease; raises LdcndError."""
FIRST_OBJECT = int(TraceRegister.TRACE_1_OBJECT)
SECOND_OBJECT = int(TraceRegister.TRACE_2_OBJECT)


class GuestUnit:
    """One drive as its guest sets it.

    Attributes:
        drive: the drive.
    """

    def __init__(self, drive: SmartStepAxis) -> None:
        self.drive = drive
        self.restart()

    def restart(self) -> None:
        """Forget what the guest has set and not executed."""
        self._mode = OperatingMode.NORMAL
        self._registers: dict[int, int] = {}
        self._traces = False

    def kept(self, address: int) -> int | None:
        """Return the word that the guest has set at an address and the drive does not have; None without one."""
        if address == Register.OPERATING_MODE and self._mode is not OperatingMode.NORMAL:
            return self._mode
        return self._registers.get(address)

    async def set(self, address: int, value: int, do: Do) -> None:
        """Carry out a setting.

        Raises:
            DataRefused: the drive, or what stands before it, does not take this value.
            DriveFault, RequestRefused: it is not done for another reason.
            BusError: the line failed.
        """
        steers = address in (Register.OPERATING_MODE, Register.OPERATION)
        if self._mode is OperatingMode.DATA_TRACE and not steers:
            raise self._busy()
        if address in EEPROM_AREA:
            await do(WriteParameter(parameter=_label(address), value=value, memory=Memory.EEPROM))
            return
        if address in RAM_AREA:
            await do(WriteParameter(parameter=_label(address - RAM_OFFSET), value=value, memory=Memory.RAM))
            return
        tracing = await self.drive.words.mode() == OperatingMode.DATA_TRACE
        self._traces = self._traces and tracing
        if address == Register.OPERATING_MODE:
            await self._enter(value, do, tracing=tracing)
        elif tracing:
            raise self._busy()
        elif address == Register.OPERATION:
            await self._execute(value, do)
        else:
            self._keep(address, value)

    async def _enter(self, value: int, do: Do, *, tracing: bool) -> None:
        mode = operating_mode(value)
        if not isinstance(mode, OperatingMode):
            raise DataRefused(f"operating mode {value:04X}H is not one of the manual's, and may move a motor")
        if tracing:
            if mode is not OperatingMode.NORMAL or not self._traces:
                raise self._busy()
            await do(AbortTrace())
        self._mode = mode

    async def _execute(self, value: int, do: Do) -> None:
        if value != EXECUTE:
            raise DataRefused(f"{value:04X}H executes nothing")
        if self._mode is OperatingMode.DATA_TRACE:
            await do(await self._trace())
            self._traces = True
        elif self._mode is not OperatingMode.NORMAL:
            counter = next(name for name, each in COUNTERS.items() if each.clear_mode is self._mode)
            await do(ClearCounter(counter=counter))
        self._mode = OperatingMode.NORMAL  # from here on the drive's own tells

    async def _trace(self) -> TakeTrace:
        """Return what records as the guest has set it; what it has not set is as the drive has it."""
        first, second, interval = [
            self._registers[register] if register in self._registers else await self.drive.words.read(register)
            for register in (FIRST_OBJECT, SECOND_OBJECT, int(TraceRegister.SMPTMS))
        ]
        channels = dict.fromkeys((*_channels(first), *_channels(second)))
        cyclec_us = await self.drive.words.read(Register.CYCLEC)
        return TakeTrace(channels=tuple(channels), interval_s=period_s(interval, cyclec_us), samples=POINTS)

    def _keep(self, address: int, value: int) -> None:
        match address:
            case Register.TRACE_1_OBJECT | Register.TRACE_2_OBJECT:
                _channels(value)
            case Register.SMPTMS if value < SHORTEST_INTERVAL:
                raise DataRefused(f"a sampling interval of {value} units is shorter than {SHORTEST_INTERVAL}")
            case Register.PTRGNO if value > HIGHEST_PRE_TRIGGER:
                raise DataRefused(f"{value} points before the trigger are more than {HIGHEST_PRE_TRIGGER}")
            case Register.TRGC1 if value != NO_TRIGGER:
                raise DataRefused("the bits of the drive's own trigger are not known: use the trigger of `trace`")
            case Register.SMPTMS | Register.PTRGNO | Register.TRGC1 | Register.TRGC2:
                pass
            case _:
                raise AddressRefused(f"a program does not set {address:04X}H")
        self._registers[address] = value

    def _busy(self) -> BusyTracing:
        return BusyTracing(f"axis {self.drive.spec.name}: a trace is under way")


def _label(number: int) -> str:
    return f"Pn{number:03X}"


def _channels(word: int) -> tuple[str, str]:
    """Return the channels of the word of a trace object (manual 4, setting 3)."""
    try:
        return DataObject(word & 0xFF).name.lower(), IoObject(word >> 8).name.lower()
    except ValueError:
        raise DataRefused(f"the manual lists no trace object {word:04X}H") from None
