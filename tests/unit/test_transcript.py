from ldcnd.drives.ldcn.packet import (
    CommandCode,
    Packet,
    StatusFlag,
    StatusItem,
    StatusPacket,
    encode_packet,
    encode_status,
)
from ldcnd.drives.ldcn.profiles import LS_182AP, PIC_IO, PIC_SERVO_V4
from ldcnd.drives.ldcn.transcript import LdcnTranscript
from ldcnd.drives.smartstep.packet import CommandPacket as SmartStepCommand
from ldcnd.drives.smartstep.packet import Function, ReplyPacket, ResponseStatus, SmartStepTranscript
from ldcnd.line.flight_recorder import WireEvent, WireRecord


def sent(data: bytes) -> WireRecord:
    return WireRecord(0.0, WireEvent.SENT, data)


def received(data: bytes) -> WireRecord:
    return WireRecord(0.0, WireEvent.RECEIVED, data)


def test_a_status_request_and_its_reply_are_told_in_words():
    transcript = LdcnTranscript({})
    items = StatusItem.POSITION | StatusItem.ADC
    status = StatusPacket(StatusFlag.MOVE_DONE | StatusFlag.POWER_ON, position=-1200, adc=1001)

    request = transcript.describe(sent(encode_packet(Packet(3, CommandCode.READ_STATUS, bytes([items])))))
    reply = transcript.describe(received(encode_status(LS_182AP, items, status)))

    assert request.startswith("node 3: ReadStatus(")
    assert "POSITION" in request
    assert reply == "status 09 MOVE_DONE+POWER_ON, position -1200, adc 1001"


def test_the_layout_of_a_reply_follows_the_node_s_dialect_and_its_defined_items():
    transcript = LdcnTranscript({1: PIC_SERVO_V4})
    items = StatusItem.ADC
    defined = encode_status(PIC_SERVO_V4, items, StatusPacket(StatusFlag(0), adc=77))

    transcript.describe(sent(encode_packet(Packet(1, CommandCode.DEFINE_STATUS, bytes([items])))))
    transcript.describe(sent(encode_packet(Packet(1, CommandCode.NO_OPERATION, b""))))

    assert len(defined) == 3  # one byte less than a LS-182AP would send
    assert transcript.describe(received(defined)) == "status 00, adc 77"


def test_a_reply_of_a_node_that_nothing_is_known_of_is_no_reply_of_a_particular_drive():
    transcript = LdcnTranscript({})

    transcript.describe(sent(encode_packet(Packet(3, CommandCode.READ_STATUS, b"\x3f"))))

    assert transcript.describe(received(bytes(13))) == "13 bytes of node 3, of which nothing says what it is"


def test_a_pic_io_is_not_read_as_a_servo():
    transcript = LdcnTranscript({2: PIC_IO})

    direction = transcript.describe(sent(bytes.fromhex("aa 02 20 f7 0f 28")))
    pwm = transcript.describe(sent(bytes.fromhex("aa 02 24 80 40 e6")))
    transcript.describe(sent(bytes.fromhex("aa 02 13 03 18")))
    reply = transcript.describe(received(bytes.fromhex("00 f7 0f 80 86")))

    assert direction == "node 2: SetDirection(inputs=4087)"
    assert pwm == "node 2: SetPwmOutputs(pwm1=128, pwm2=64)"
    assert reply == "status, levels FF7, adc1 128"


def test_a_node_that_tells_its_identity_is_read_by_its_dialect_until_the_next_reset():
    transcript = LdcnTranscript({})
    transcript.describe(sent(bytes.fromhex("aa 02 13 20 35")))
    transcript.describe(received(bytes.fromhex("00 02 01 03")))

    known = transcript.describe(sent(bytes.fromhex("aa 02 26 08 00 30")))
    transcript.describe(sent(bytes.fromhex("aa ff 0f 0e")))
    unknown = transcript.describe(sent(bytes.fromhex("aa 02 26 08 00 30")))

    assert known == "node 2: SetOutput(levels=8)"
    assert unknown.startswith("node 2: SetGain(")


def test_a_reset_takes_the_defined_items_back():
    transcript = LdcnTranscript({})
    transcript.describe(sent(encode_packet(Packet(1, CommandCode.DEFINE_STATUS, bytes([StatusItem.POSITION])))))

    transcript.describe(sent(encode_packet(Packet(0xFF, CommandCode.HARD_RESET, b""))))
    transcript.describe(sent(encode_packet(Packet(1, CommandCode.NO_OPERATION, b""))))

    assert transcript.describe(received(b"\x08\x08")) == "status 08 POWER_ON"


def test_what_is_no_packet_is_said_to_be_none():
    transcript = LdcnTranscript({})

    assert transcript.describe(sent(bytes(4))) == "no complete packet in 4 bytes"
    assert "status checksum" in transcript.describe(received(b"\x08\x09"))
    assert not transcript.describe(WireRecord(0.0, WireEvent.TIMEOUT))


def test_a_reply_that_came_in_pieces_is_told_with_its_last_piece():
    transcript = LdcnTranscript({})
    items = StatusItem.POSITION
    reply = encode_status(LS_182AP, items, StatusPacket(StatusFlag(0), position=77))
    transcript.describe(sent(encode_packet(Packet(3, CommandCode.READ_STATUS, bytes([items])))))

    first = transcript.describe(WireRecord(0.0, WireEvent.PART, reply[:2]))
    last = transcript.describe(received(reply[2:]))

    assert (first, last) == ("", "status 00, position 77")


def test_smartstep_packets_are_told_in_words():
    request = SmartStepCommand(2, Function.REFERENCE, 0xE000).encode()
    reply = ReplyPacket(2, ResponseStatus(Function.REFERENCE), 0xE000, 0x1234).encode()
    transcript = SmartStepTranscript()

    assert transcript.describe(sent(request)) == "unit 2: REFERENCE E000H, 0000H"
    assert transcript.describe(received(reply)).endswith("E000H, 1234H")
    assert "checksum" in transcript.describe(received(b"nonsense"))
