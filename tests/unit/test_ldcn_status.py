"""Status packets: LS-182AP manual, "Define Status"; PIC-SERVO manual, 5.2 and 5.3."""

import pytest

from ldcnd.contract.errors import BadReply
from ldcnd.drives.ldcn.packet import (
    AuxFlag,
    StatusFlag,
    StatusItem,
    StatusPacket,
    check_status,
    decode_status,
    encode_status,
    item_bytes,
    status_bytes,
)
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.line.exchange import ReplyVerdict

LS_182AP = PROFILES["ls-182ap"]
PIC_SERVO_SC = PROFILES["pic-servo-sc"]
EVERYTHING = StatusItem(0xFF)


@pytest.mark.parametrize(
    ("name", "data_bytes"),
    [
        ("pic-servo-v1", 14),
        ("pic-servo-v4", 14),
        ("pic-servo-sc", 17),
        ("pic-servo-cmc", 14),
        ("ls-173ap", 16),
        ("ls-182ap", 17),
    ],
)
def test_the_full_mask_makes_these_data_bytes(name, data_bytes):
    assert item_bytes(PROFILES[name], EVERYTHING) == data_bytes
    assert status_bytes(PROFILES[name], EVERYTHING) == data_bytes + 2


def test_equal_lengths_do_not_mean_equal_layouts():
    data = encode_status(LS_182AP, EVERYTHING, StatusPacket(StatusFlag(0x09), position=1, adc=0x0203, velocity=4))

    other = decode_status(PIC_SERVO_SC, EVERYTHING, data)

    assert len(data) == status_bytes(PIC_SERVO_SC, EVERYTHING)
    assert (other.adc, other.velocity) != (0x0203, 4)


def test_every_item_comes_in_the_order_of_its_bit():
    data = bytes.fromhex("0b  04 03 02 01  06 05  fe ff  2c  0d 0c 0b 0a  5a 14  f0 ff")
    data += bytes([sum(data) & 0xFF])

    status = decode_status(LS_182AP, EVERYTHING, data)

    assert status == StatusPacket(
        StatusFlag.MOVE_DONE | StatusFlag.CHECKSUM_ERROR | StatusFlag.POWER_ON,
        position=0x01020304,
        adc=0x0506,
        velocity=2,
        aux=AuxFlag.SERVO_ON | AuxFlag.ACCEL_DONE | AuxFlag.SERVO_OVERRUN,
        home=0x0A0B0C0D,
        device_id=90,
        version=20,
        position_error=-16,
    )


def test_forward_velocity_is_negative_on_the_wire():
    data = bytes.fromhex("08 ff ff 06")

    assert decode_status(LS_182AP, StatusItem.VELOCITY, data).velocity == 1


def test_ignored_items_take_no_bytes():
    v4 = PROFILES["pic-servo-v4"]
    items = StatusItem.POSITION_ERROR | StatusItem.BIT7

    status = decode_status(v4, items, b"\x08\x08")

    assert (status.position_error, status.bit7) == (None, None)


def test_unknown_flag_bits_are_kept():
    status = decode_status(LS_182AP, StatusItem.AUX, bytes([0x08, 0xC0, 0xC8]))

    assert status.aux == 0xC0
    assert status.aux & AuxFlag.MOTION_LOCKED


@pytest.mark.parametrize(("frame", "reason"), [("09 31", "checksum"), ("09 00 09", "makes 2"), ("", "makes 2")])
def test_what_cannot_be_the_reply_is_refused(frame, reason):
    with pytest.raises(BadReply, match=reason):
        decode_status(LS_182AP, StatusItem(0), bytes.fromhex(frame))


@pytest.mark.parametrize(
    ("frame", "verdict"),
    [
        ("09 00 28 00 00 31", ReplyVerdict.INTACT),
        ("09 00 28 00 00 32", ReplyVerdict.CORRUPT),
        ("0b 0b", ReplyVerdict.REJECTED),
        ("0b 0a", ReplyVerdict.CORRUPT),
        ("ff ff 00 fe", ReplyVerdict.REJECTED),
    ],
)
def test_a_reply_is_judged_by_checksum_and_checksum_error_bit(frame, verdict):
    assert check_status(bytes.fromhex(frame)) is verdict


def test_a_value_that_does_not_fit_is_not_sent():
    with pytest.raises(OverflowError):
        encode_status(PIC_SERVO_SC, StatusItem.ADC, StatusPacket(StatusFlag(0), adc=256))
