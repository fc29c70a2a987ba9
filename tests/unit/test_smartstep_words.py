from types import SimpleNamespace
from typing import cast

import pytest

from ldcnd.contract.errors import AddressRefused, BusyTracing, ByteCountRefused, DataRefused
from ldcnd.drives.smartstep.addresses import OperatingMode
from ldcnd.drives.smartstep.commands import Refusal, execute
from ldcnd.drives.smartstep.packet import ResponseStatus
from ldcnd.drives.smartstep.words import drive_error, stray_packets
from ldcnd.line.bus import Bus
from ldcnd.line.flight_recorder import WireEvent, WireLog


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


def test_only_what_came_unasked_since_an_instant_is_stray():
    first, second, third = (execute(unit).request for unit in (1, 2, 3))
    log = WireLog()
    log.add(1.0, WireEvent.STRAY, first)
    log.add(2.0, WireEvent.SENT, second)
    log.add(3.0, WireEvent.STRAY, third[:4])
    log.add(3.1, WireEvent.STRAY, third[4:])
    bus = cast("Bus", SimpleNamespace(wire_log=log))

    assert stray_packets(bus, 0.0) == [first, third]
    assert stray_packets(bus, 2.0) == [third]
