import pytest

from ldcnd.drivers.smartstep.packet import Command, Function, Reply, ResponseStatus, decode_reply
from ldcnd.errors import BadReply, ValueOutOfRange


@pytest.mark.parametrize("unit", [-1, 16])
def test_unit_numbers_end_at_15(unit):
    with pytest.raises(ValueOutOfRange):
        Command(unit, Function.REFERENCE, 0x8000)


@pytest.mark.parametrize(("address", "data"), [(0x10000, 0), (-1, 0), (0, 0x10000), (0, -1)])
def test_fields_fit_four_digits(address, data):
    with pytest.raises(ValueOutOfRange):
        Command(1, Function.SETTING, address, data)


def test_unit_15_is_written_as_f():
    assert Command(15, Function.REFERENCE, 0x8000).encode()[:3] == b"WF0"


@pytest.mark.parametrize(
    "damaged",
    [
        b"",
        b"W0001000028D7",
        b"W0001000028D7\n",
        b"X0001000028D7\r",
        b"W0001000028D8\r",
        b"W0001000028d7\r",
        b"W00010000 8D7\r",
        b"W0001000028D7\r\r",
    ],
)
def test_reply_that_breaks_a_rule_is_bad(damaged):
    with pytest.raises(BadReply):
        decode_reply(damaged)


@pytest.mark.parametrize("code", [0x3, 0x7, 0xB, 0xC, 0xF])
def test_status_outside_the_manuals_table_is_bad(code):
    packet = Reply(1, ResponseStatus.REFERENCE, 0x8000, 0).encode()
    ss = (int(packet[11:13], 16) - code) & 0xFF
    packet = b"W1%X80000000%02X\r" % (code, ss)

    with pytest.raises(BadReply, match="status"):
        decode_reply(packet)


@pytest.mark.parametrize(
    ("status", "function", "normal"),
    [
        (0x0, Function.REFERENCE, True),
        (0x1, Function.SETTING, True),
        (0x2, Function.STRING_REFERENCE, True),
        (0x4, Function.REFERENCE, False),
        (0x5, Function.SETTING, False),
        (0x6, Function.STRING_REFERENCE, False),
        (0x8, Function.REFERENCE, False),
        (0x9, Function.SETTING, False),
        (0xA, Function.STRING_REFERENCE, False),
    ],
)
def test_status_says_its_function_and_outcome(status, function, normal):
    assert ResponseStatus(status).function is function
    assert ResponseStatus(status).normal is normal
