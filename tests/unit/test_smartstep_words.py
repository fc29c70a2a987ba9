import pytest

from ldcnd.drivers.smartstep.addresses import OperatingMode
from ldcnd.drivers.smartstep.commands import Refusal
from ldcnd.drivers.smartstep.packet import ResponseStatus
from ldcnd.drivers.smartstep.words import drive_error
from ldcnd.errors import AddressRefused, BusyTracing, ByteCountRefused, DataRefused


@pytest.mark.parametrize(
    ("status", "error"),
    [
        (ResponseStatus.REFERENCE_ADDRESS_ERROR, AddressRefused),
        (ResponseStatus.SETTING_ADDRESS_ERROR, AddressRefused),
        (ResponseStatus.STRING_ADDRESS_ERROR, AddressRefused),
        (ResponseStatus.REFERENCE_DATA_ERROR, DataRefused),
        (ResponseStatus.SETTING_DATA_ERROR, DataRefused),
        (ResponseStatus.BYTE_COUNT_ERROR, ByteCountRefused),
    ],
)
def test_each_error_reply_is_an_error_of_its_own(status, error):
    raised = drive_error("feed", Refusal(1, status, 0x0100, 3000))

    assert type(raised) is error
    assert (raised.axis, f"e={status:X}" in raised.message) == ("feed", True)
    assert not raised.retryable


def test_a_setting_meets_a_busy_drive_while_it_traces():
    refusal = Refusal(1, ResponseStatus.SETTING_ADDRESS_ERROR, 0x1100, 3)

    raised = drive_error("feed", refusal, OperatingMode.DATA_TRACE)

    assert type(raised) is BusyTracing
    assert raised.retryable
