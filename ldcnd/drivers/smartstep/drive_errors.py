"""A drive's error replies as errors of ldcnd, with the manual's meaning.

Source: manual 2.2 (5) "Status"; 4 "Data setting limit".
"""

from ldcnd.drivers.smartstep.operating_modes import OperatingMode
from ldcnd.drivers.smartstep.refusals import Refusal, RefusalReason
from ldcnd.errors import AddressRefused, BusyTracing, ByteCountRefused, DataRefused, DriveFault


def drive_error(axis: str, refusal: Refusal, mode: OperatingMode | int = OperatingMode.NORMAL) -> DriveFault:
    """Return the error that an error reply stands for.

    Args:
        axis: who declined.
        refusal: how.
        mode: what 2000H says; in Data Trace Mode a setting's address error means that the drive is busy.
    """
    message = f"axis {axis}: {refusal}"
    match refusal.reason_in(mode):
        case RefusalReason.TRACING:
            return BusyTracing(
                f"axis {axis}: busy tracing: the drive takes no setting in Data Trace Mode (e={refusal.status:X})",
                axis=axis,
                remedy="wait for the end of the trace, or end it",
            )
        case RefusalReason.ADDRESS:
            return AddressRefused(message, axis=axis, value=f"{refusal.address:04X}H")
        case RefusalReason.BYTE_COUNT:
            return ByteCountRefused(message, axis=axis, value=refusal.data)
        case RefusalReason.DATA:
            return DataRefused(message, axis=axis, value=refusal.data)
