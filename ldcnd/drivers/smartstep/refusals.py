"""A drive's error replies: what it refused and what the manual calls it.

Source: manual 2.2 (5) "Status"; 4 "Data setting limit".
"""

from dataclasses import dataclass
from enum import StrEnum

from ldcnd.drivers.smartstep.addresses import Register
from ldcnd.drivers.smartstep.operating_modes import OperatingMode
from ldcnd.drivers.smartstep.packet import Function, ResponseStatus


class RefusalReason(StrEnum):
    """Why a drive did not do it."""

    ADDRESS = "address error"
    DATA = "data error"
    BYTE_COUNT = "error in number of bytes"
    TRACING = "busy in Data Trace Mode"


@dataclass(frozen=True, slots=True)
class Refusal:
    """An intact reply by which the drive declines; nothing was changed, and the same again will be declined again.

    Attributes:
        data: as echoed; the value or the number of bytes that was asked for.
    """

    unit: int
    status: ResponseStatus
    address: int
    data: int

    @property
    def reason(self) -> RefusalReason:
        """The reason by the manual's table, taken by itself."""
        if self.status & 0x8:
            return RefusalReason.ADDRESS
        if self.status.function is Function.STRING_REFERENCE:
            return RefusalReason.BYTE_COUNT
        return RefusalReason.DATA

    def reason_in(self, mode: OperatingMode | int) -> RefusalReason:
        """Return the reason for a drive in this operating mode: settings meet an address error while it traces."""
        if (
            mode == OperatingMode.DATA_TRACE
            and self.status is ResponseStatus.SETTING_ADDRESS_ERROR
            and self.address not in (Register.OPERATING_MODE, Register.OPERATION)
        ):
            return RefusalReason.TRACING
        return self.reason

    def __str__(self) -> str:
        verb = {
            Function.REFERENCE: "reading",
            Function.SETTING: f"setting to {self.data:04X}H",
            Function.STRING_REFERENCE: f"reading {self.data} counts from",
        }[self.status.function]
        return f"unit {self.unit}: {verb} {self.address:04X}H: {self.reason} (e={self.status:X})"
