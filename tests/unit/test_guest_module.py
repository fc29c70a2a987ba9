"""A guest's own chain: what arranges is answered as on the bare line, what could concern a drive is handed on."""

import pytest

from ldcnd.contract.errors import NotSupported
from ldcnd.contract.rig_commands import SetIo
from ldcnd.drives.ldcn.packet import (
    CommandCode,
    Packet,
    StatusFlag,
    StatusItem,
    StatusPacket,
    encode_packet,
    encode_status,
)
from ldcnd.drives.ldcn.pic_io import SetDirection, SetOutput, SetPwmOutputs, SetSynchOutput, SynchOutput
from ldcnd.drives.ldcn.profiles import PIC_SERVO_SC
from ldcnd.drives.ldcn.received import ReceivedCommand
from ldcnd.drives.line_config import OutputConfig
from ldcnd.ports.guest_module import GuestModule, PendingReply
from ldcnd.ports.outputs import GuestOutputs
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.quirks import ModuleSettings

READING = StatusPacket(StatusFlag(0x09), position=-70_000)
ADDRESS_1 = Packet(0, CommandCode.SET_ADDRESS, bytes((1, 0xFF)))


class Program:
    """A host program on a chain of two drives that are at rest; readings come at once unless they are held back."""

    def __init__(self) -> None:
        self.commands: list[ReceivedCommand] = []
        settings = ModuleSettings(reset_dead_s=0.0)
        self.asked: list[tuple[PendingReply, StatusItem]] = []
        self.resets: list[int] = []
        self.chain = Chain(
            GuestModule(
                PIC_SERVO_SC, settings, self._ask, self.commands.append, lambda which=which: self.resets.append(which)
            )
            for which in (1, 2)
        )
        self.now_s = 0.0

    def _ask(self, items: StatusItem, answer: PendingReply) -> None:
        self.asked.append((answer, items))

    def send(self, *packets: Packet) -> list[str]:
        return [self.send_bytes(encode_packet(packet)) for packet in packets]

    def send_bytes(self, data: bytes, *, read: bool = True) -> str:
        self.chain.write(self.now_s, data)
        self.now_s += 0.05
        self.chain.advance(self.now_s)
        if not read:
            return ""
        for answer, answer_items in self.asked:
            answer.give(encode_status(PIC_SERVO_SC, answer_items, READING), self.now_s)
        self.asked.clear()
        self.now_s += 0.05
        return b"".join(piece for _, piece in self.chain.advance(self.now_s)).hex()


def test_addresses_resets_and_rates_of_a_guest_are_its_own() -> None:
    program = Program()

    assert program.send(ADDRESS_1, Packet(0, CommandCode.SET_ADDRESS, bytes((2, 0xFF)))) == ["0909", "0909"]
    assert program.send(Packet(0xFF, CommandCode.SET_BAUD_RATE, bytes((0x14,)))) == [""]
    program.chain.baud = 57_600
    assert program.send(Packet(2, CommandCode.NO_OPERATION)) == ["0909"]
    program.resets.clear()  # those of the power coming
    assert program.send(Packet(0xFF, CommandCode.HARD_RESET)) == [""]
    assert program.resets == [1, 2]
    assert program.send(Packet(1, CommandCode.NO_OPERATION)) == [""]
    program.chain.baud = 19_200
    assert program.send(ADDRESS_1) == ["0909"]
    assert program.commands == []


def test_a_guest_reads_by_its_own_status_mask() -> None:
    program = Program()
    packet = b"\x09" + (-70_000).to_bytes(4, "little", signed=True)
    expected = (packet + bytes([sum(packet) & 0xFF])).hex()

    program.send(ADDRESS_1)

    define, read = Packet(1, CommandCode.DEFINE_STATUS, b"\x01"), Packet(1, CommandCode.NO_OPERATION)
    assert program.send(define, read) == [expected, expected]


def test_a_damaged_packet_is_reported_and_not_handed_on() -> None:
    program = Program()
    program.send(ADDRESS_1)
    damaged = encode_packet(Packet(1, CommandCode.START_MOTION))[:-1] + b"\x00"

    assert program.send_bytes(damaged) == "0b0b"
    assert program.commands == []
    assert program.send(Packet(1, CommandCode.NO_OPERATION)) == ["0909"]


def test_a_reading_that_comes_late_answers_no_later_request() -> None:
    program = Program()
    program.send(ADDRESS_1)
    ask = encode_packet(Packet(1, CommandCode.NO_OPERATION))

    program.send_bytes(ask, read=False)

    assert program.send_bytes(ask) == "0909"


def outputs_of(levels: dict[str, bool]) -> GuestOutputs:
    named = {name: OutputConfig(line=number) for number, name in enumerate(levels, 4)}
    return GuestOutputs("cabinet", named, lambda _: levels)


def test_a_duty_is_sent_each_time_it_is_commanded_for_a_refused_one_leaves_the_one_before():
    outputs = outputs_of({})

    said = [outputs.meaning(SetPwmOutputs(*duties)) for duties in ((128, 0), (0, 0), (0, 0))]

    assert said == [SetIo(module="cabinet", pwm1=duty / 255, pwm2=0.0) for duty in (128, 0, 0)]


def test_a_packet_sets_no_line_that_it_does_not_name():
    levels = {"lamp": False, "pump": False}
    outputs = outputs_of(levels)
    outputs.meaning(SetDirection(0xFFF & ~0x18))
    assert outputs.meaning(SetOutput(0x08)) == SetIo(module="cabinet", high=("lamp",))
    outputs.carried_out(SetOutput(0x08), SetIo(module="cabinet", high=("lamp",)))
    levels["lamp"] = False  # a client has set it low meanwhile

    assert outputs.meaning(SetPwmOutputs(1, 0)) == SetIo(module="cabinet", pwm1=1 / 255, pwm2=0.0)
    assert outputs.meaning(SetDirection(0xFFF & ~0x18)) is None


def test_levels_that_were_refused_are_driven_by_no_later_packet():
    outputs = outputs_of({"lamp": False, "pump": False})
    outputs.meaning(SetDirection(0xFFF & ~0x08))
    outputs.meaning(SetOutput(0x18))  # refused: it was not carried out

    assert outputs.meaning(SetDirection(0xFFF & ~0x18)) is None


def test_the_next_program_does_not_put_in_force_what_the_one_before_has_stored():
    outputs = outputs_of({"lamp": False})
    outputs.meaning(SetDirection(0xFFF & ~0x08))
    outputs.meaning(SetSynchOutput(0x08, 10, 0))
    outputs.gone()

    with pytest.raises(NotSupported, match="stored no outputs"):
        outputs.meaning(SynchOutput())


def test_named_outputs_of_a_direction_packet_are_outputs_though_it_makes_others_outputs_too():
    outputs = GuestOutputs("cabinet", {"lamp": OutputConfig(line=10)}, lambda _: {"lamp": False})

    with pytest.raises(NotSupported, match="line 12"):
        outputs.meaning(SetDirection(0xFFF & ~0xA00))

    assert outputs.meaning(SetOutput(0xA00)) == SetIo(module="cabinet", high=("lamp",))
