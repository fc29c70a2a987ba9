import pytest

from ldcnd.drivers.smartstep.operating_modes import OperatingMode
from ldcnd.drivers.smartstep.packet import ResponseStatus
from ldcnd.drivers.smartstep.refusals import Refusal, RefusalReason


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        (0x8, RefusalReason.ADDRESS),
        (0x4, RefusalReason.DATA),
        (0x9, RefusalReason.ADDRESS),
        (0x5, RefusalReason.DATA),
        (0xA, RefusalReason.ADDRESS),
        (0x6, RefusalReason.BYTE_COUNT),
    ],
)
def test_reason_by_the_manuals_table(status, reason):
    assert Refusal(0, ResponseStatus(status), 0x0100, 0).reason is reason


def test_address_error_of_a_setting_means_busy_while_tracing():
    refusal = Refusal(0, ResponseStatus.SETTING_ADDRESS_ERROR, 0x1100, 60)

    assert refusal.reason_in(OperatingMode.DATA_TRACE) is RefusalReason.TRACING
    assert refusal.reason_in(OperatingMode.NORMAL) is RefusalReason.ADDRESS


@pytest.mark.parametrize("address", [0x2000, 0x2001])
def test_mode_and_operation_may_be_set_while_tracing_so_their_errors_are_real(address):
    refusal = Refusal(0, ResponseStatus.SETTING_ADDRESS_ERROR, address, 0)

    assert refusal.reason_in(OperatingMode.DATA_TRACE) is RefusalReason.ADDRESS


def test_message_says_unit_address_value_and_reason():
    refusal = Refusal(3, ResponseStatus.SETTING_DATA_ERROR, 0x0100, 3000)

    assert str(refusal) == "unit 3: setting to 0BB8H 0100H: data error (e=5)"
