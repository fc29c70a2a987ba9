"""Every recorded SmartStep packet, against the codec and against the simulated unit."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from ldcnd.drives.smartstep.addresses import OperatingMode
from ldcnd.drives.smartstep.commands import StringReply, reference, string_reference
from ldcnd.drives.smartstep.packet import (
    CommandPacket,
    Function,
    ReplyPacket,
    ResponseStatus,
    checksum,
    decode_command,
    decode_reply,
)
from ldcnd.drives.smartstep.parameters import PN000, PN100
from ldcnd.drives.smartstep.profiles import StringChecksum
from ldcnd.line.exchange import ReplyVerdict
from ldcnd.sim.smartstep.unit import SimulatedUnit, string_reply
from ldcnd.sim.smartstep.variant import SimulatedVariant


@dataclass(frozen=True)
class Vector:
    source: str
    meaning: str
    tx: bytes
    rx: bytes | None
    checksum_ok: bool


def load() -> list[Vector]:
    path = Path(__file__).parents[1] / "vectors" / "smartstep.json"
    return [
        Vector(
            entry["source"],
            entry["meaning"],
            entry["tx"].encode("ascii"),
            entry["rx"].encode("ascii") if entry["rx"] else None,
            entry["checksum_ok"],
        )
        for entry in json.loads(path.read_text())
    ]


VECTORS = load()
SILENT = [vector for vector in VECTORS if vector.source == "derived (documented silence)"]
WELL_FORMED = [vector for vector in VECTORS if vector.checksum_ok and b"W03" not in vector.tx]
STRINGS = [vector for vector in VECTORS if vector.rx and len(vector.rx) > 14]
ANSWERED = [vector for vector in VECTORS if vector.rx and len(vector.rx) == 14]
PRINTED_WRONG = b"W00C00003E855\r"


def name_of(vector: Vector) -> str:
    return vector.tx.decode("ascii").strip() + " " + vector.meaning[:30]


def turning(rpm: float) -> Callable[[SimulatedUnit], None]:
    def prepare(unit: SimulatedUnit) -> None:
        unit.drive.set_run(0.0, on=True)
        unit.drive.set_pulse_rate(rpm * 8000 / 60 / 4, 0.0)

    return prepare


def counting(command: int, feedback: int) -> Callable[[SimulatedUnit], None]:
    def prepare(unit: SimulatedUnit) -> None:
        unit.drive.motor.command_units = command
        unit.drive.motor.position = feedback

    return prepare


def tracing(unit: SimulatedUnit) -> None:
    unit.drive.write(0x2000, OperatingMode.DATA_TRACE)


def in_alarm(unit: SimulatedUnit) -> None:
    unit.drive.provoke(0x00C3, 0.0)


def filled(unit: SimulatedUnit) -> None:
    unit.drive.recorder.rings[0][:4] = [0x0000, 0x8001, 0x7FFF, 0xFFFF]


PREPARATIONS: dict[bytes, Callable[[SimulatedUnit], None]] = {
    b"W008000FFF68B\r": turning(-10),
    b"W1080000BB8AD\r": turning(3000),
    b"W00850A00C3AE\r": in_alarm,
    b"W1020002000B0\r": tracing,
    b"W00800C5678A6\r": counting(0x12345678, 0),
    b"W00800EFFFF74\r": counting(0, -1),
    b"W00800FFFFF73\r": counting(0, -1),
}


def answer(unit: SimulatedUnit, characters: bytes) -> bytes | None:
    unit.receive(characters, 2.0)
    sent = unit.transmissions(3.0)
    return sent[0].characters if sent else None


def unit_for(vector: Vector, variant: SimulatedVariant | None = None) -> SimulatedUnit:
    number = 1 if "drive is unit 1" in vector.meaning else int(vector.tx[1:2].strip() or b"0", 16)
    return SimulatedUnit(variant, {PN000: number << 8, PN100: 40})


@pytest.mark.parametrize("vector", WELL_FORMED, ids=name_of)
def test_recorded_command_survives_decoding_and_encoding(vector):
    command = decode_command(vector.tx)

    assert command is not None
    assert command.encode() == vector.tx


@pytest.mark.parametrize("vector", ANSWERED, ids=name_of)
def test_recorded_reply_survives_decoding_and_encoding(vector):
    reply = decode_reply(vector.rx)

    assert reply.encode() == vector.rx


@pytest.mark.parametrize("vector", [vector for vector in ANSWERED if vector.tx != PRINTED_WRONG], ids=name_of)
def test_simulated_unit_sends_the_recorded_reply(vector):
    unit = unit_for(vector)
    PREPARATIONS.get(vector.rx, lambda _: None)(unit)

    assert answer(unit, vector.tx) == vector.rx


@pytest.mark.parametrize("vector", SILENT, ids=name_of)
def test_simulated_unit_stays_silent_where_the_manual_says_so(vector):
    assert answer(unit_for(vector), vector.tx) is None


@pytest.mark.parametrize("vector", [vector for vector in SILENT if not vector.checksum_ok], ids=name_of)
def test_damaged_command_is_no_command(vector):
    assert decode_command(vector.tx) is None


def test_unknown_function_is_no_command():
    assert decode_command(b"W0301000000FC\r") is None


def test_example_4_as_printed_is_a_reference_and_cannot_have_its_printed_reply():
    printed = next(vector for vector in VECTORS if vector.tx == PRINTED_WRONG)
    command = decode_command(printed.tx)

    assert command is not None
    assert command.function is Function.REFERENCE
    assert decode_reply(printed.rx).status.function is Function.SETTING
    assert reference(0, 0xC000).check(printed.rx) is ReplyVerdict.FOREIGN


def test_checksum_example_of_the_manual():
    assert checksum(b"0000010000") == 0xFF
    assert CommandPacket(0, Function.REFERENCE, 0x0001).encode() == b"W0000010000FF\r"


@pytest.mark.parametrize(
    ("vector", "variant"), list(zip(STRINGS, (StringChecksum.HEADER, StringChecksum.ALL), strict=True)), ids=str
)
def test_recorded_string_replies_decode_and_come_from_the_simulated_unit(vector, variant):
    exchange = string_reference(1, 0x3000, 8)
    unit = unit_for(vector, SimulatedVariant(string_checksum=variant))
    filled(unit)

    decoded = exchange.decode(vector.rx)

    assert exchange.request == vector.tx
    assert exchange.check(vector.rx) is ReplyVerdict.INTACT
    assert decoded == StringReply(bytes.fromhex("000080017FFFFFFF"), frozenset({variant}))
    assert string_reply(decode_command(vector.tx), decoded.data, variant) == vector.rx
    assert answer(unit, vector.tx) == vector.rx


@pytest.mark.parametrize(
    ("request_characters", "address", "byte_count"),
    [
        (b"W12300003E8D3\r", 0x3000, 1000),
        (b"W12380003E8CB\r", 0x3800, 1000),
        (b"W1230C800C82E\r", 0x30C8, 200),
        (b"W12319000C865\r", 0x3190, 200),
        (b"W12332000C8D3\r", 0x3320, 200),
    ],
)
def test_recorded_string_commands_are_built_and_answered_in_full(request_characters, address, byte_count):
    vector = next(vector for vector in VECTORS if vector.tx == request_characters)
    unit = unit_for(vector)

    reply = answer(unit, vector.tx)

    assert string_reference(1, address, byte_count).request == vector.tx
    assert reply is not None
    assert len(reply) == 14 + 2 * byte_count


def test_every_vector_is_used():
    used = {*SILENT, *ANSWERED, *STRINGS, *WELL_FORMED}

    assert set(VECTORS) == used
    assert len(VECTORS) == 40


def test_example_6_is_a_data_error_of_a_setting():
    assert decode_reply(b"W0501000BB837\r") == ReplyPacket(0, ResponseStatus.SETTING_DATA_ERROR, 0x0100, 3000)
