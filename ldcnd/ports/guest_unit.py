"""A SmartStep as a guest sets it: what its settings mean.

Parameters are commands of the axis as of any client, so the count of EEPROM writes and the books are those of
everybody. Operating modes and the settings of a trace are exchanges of the line: they move nothing, and what they do is
the guest's own affair, so it gets the drive's own reply at once. Only the modes of the manual pass: others may move a
motor. While somebody else traces, the guest has the reply of a drive that does. Source: manual 2.2, 3, 4, 5 (2), 6 (2).
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

from ldcnd.contract.commands import AxisCommand, CommandReply
from ldcnd.contract.errors import AddressRefused, BusyTracing, DataRefused
from ldcnd.contract.parameters import Memory, WriteParameter
from ldcnd.drives.smartstep.addresses import (
    EEPROM_AREA,
    RAM_AREA,
    RAM_OFFSET,
    OperatingMode,
    Register,
    operating_mode,
)
from ldcnd.drives.smartstep.commands import EXECUTE
from ldcnd.drives.smartstep.drive import SmartStepAxis
from ldcnd.drives.smartstep.modes import CLEAR_MODES, CLEAR_S

TRACE_SETTINGS = range(Register.TRACE_1_OBJECT, Register.TRGADR)


class GuestUnit:
    """One drive as its guest sets it.

    Attributes:
        drive: the drive.
    """

    def __init__(self, drive: SmartStepAxis, is_traced: Callable[[], bool]) -> None:
        """Begin with a guest that has set nothing.

        Args:
            drive: the drive.
            is_traced: tells whether a trace of a client is under way.
        """
        self.drive = drive
        self._is_traced = is_traced
        self._entered = OperatingMode.NORMAL

    def command_for(self, address: int, value: int) -> AxisCommand[CommandReply] | None:
        """Return the command that a setting means; None for one that goes to the drive as it is.

        Raises:
            BusyTracing: somebody else traces.
            DataRefused, AddressRefused: the drive does not get it.
        """
        if self._is_traced():
            raise BusyTracing(f"axis {self.drive.spec.name}: somebody else's trace is under way")
        if address in EEPROM_AREA:
            return WriteParameter(parameter=_label(address), value=value, memory=Memory.EEPROM)
        if address in RAM_AREA:
            return WriteParameter(parameter=_label(address - RAM_OFFSET), value=value, memory=Memory.RAM)
        if address == Register.OPERATING_MODE:
            if not isinstance(operating_mode(value), OperatingMode):
                raise DataRefused(f"operating mode {value:04X}H is not one of the manual's, and may move a motor")
        elif address == Register.OPERATION:
            if value != EXECUTE:
                raise DataRefused(f"{value:04X}H executes nothing")
        elif address not in TRACE_SETTINGS:
            raise AddressRefused(f"a program does not set {address:04X}H")
        return None

    def sending(self, address: int) -> AbstractContextManager[None]:
        """Return in what a setting goes to the drive as it is: one that executes a mode may clear a counter."""
        clears = address == Register.OPERATION and self._entered in CLEAR_MODES
        return self.drive.words.clears.clearing(CLEAR_S) if clears else nullcontext()

    def sends(self, address: int, value: int) -> str:
        """Take note of a setting that went to the drive as it is; return what it begins, in words, if it does."""
        if address == Register.OPERATING_MODE:
            self._entered = OperatingMode(value)
        elif address == Register.OPERATION:
            begun, self._entered = self._entered, OperatingMode.NORMAL  # which the drive goes back to by itself
            if begun is not OperatingMode.NORMAL:
                return f"{begun.name.lower().replace('_', ' ')} ({begun:04X}H)"
        return ""

    def may_have_taken(self, address: int, value: int) -> None:
        """Take note of a setting whose reply is lost: a mode is to be left again."""
        if address == Register.OPERATING_MODE:
            self._entered = OperatingMode(value) or self._entered

    @property
    def is_in_mode(self) -> bool:
        """A mode is entered that its guest has not executed."""
        return self._entered is not OperatingMode.NORMAL

    def leaves(self) -> bool:
        """Tell whether a mode is entered that its guest has not executed; it is its guest's no more."""
        is_in_mode, self._entered = self.is_in_mode, OperatingMode.NORMAL
        return is_in_mode


def _label(number: int) -> str:
    return f"Pn{number:03X}"
