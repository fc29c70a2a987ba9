"""A guest's own chain: what arranges is answered as on the bare line, what could change a drive is not done."""

from ldcnd.drives.ldcn.packet import (
    CommandCode,
    Packet,
    StatusFlag,
    StatusItem,
    StatusPacket,
    encode_packet,
)
from ldcnd.drives.ldcn.profiles import PIC_SERVO_SC
from ldcnd.drives.ldcn.received import ReceivedCommand
from ldcnd.ports.guest_module import ReadOnlyModule
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.quirks import ModuleSettings

SETTINGS = ModuleSettings(reset_dead_s=0.0)
READING = StatusPacket(
    StatusFlag(0x09), position=-70_000, adc=3, velocity=0, home=12, device_id=0, version=10, position_error=0, bit7=0
)
ADDRESS_1 = Packet(0, CommandCode.SET_ADDRESS, bytes((1, 0xFF)))


class Guest:
    """A host program on a chain of two drives that are at rest."""

    def __init__(self, reading: StatusPacket | None = READING) -> None:
        self.refused: list[ReceivedCommand] = []
        self.asked: list[StatusItem] = []

        def read(items: StatusItem) -> StatusPacket | None:
            self.asked.append(items)
            return reading

        self.chain = Chain([ReadOnlyModule(PIC_SERVO_SC, SETTINGS, read, self.refused.append) for _ in range(2)])
        self.now_s = 0.0

    def send(self, *packets: Packet) -> list[str]:
        return [self.send_bytes(encode_packet(packet)) for packet in packets]

    def send_bytes(self, data: bytes) -> str:
        self.chain.write(self.now_s, data)
        self.now_s += 0.05
        return b"".join(piece for _, piece in self.chain.advance(self.now_s)).hex()


def test_addresses_resets_and_rates_of_a_guest_are_its_own() -> None:
    guest = Guest()

    assert guest.send(ADDRESS_1, Packet(0, CommandCode.SET_ADDRESS, bytes((2, 0xFF)))) == ["0909", "0909"]
    assert guest.send(Packet(0xFF, CommandCode.SET_BAUD_RATE, bytes((0x14,)))) == [""]
    guest.chain.baud = 57_600
    assert guest.send(Packet(2, CommandCode.NO_OPERATION)) == ["0909"]
    assert guest.send(Packet(0xFF, CommandCode.HARD_RESET)) == [""]
    assert guest.send(Packet(1, CommandCode.NO_OPERATION)) == [""]
    guest.chain.baud = 19_200
    assert guest.send(ADDRESS_1) == ["0909"]
    assert guest.refused == []


def test_a_guest_reads_by_its_own_status_mask() -> None:
    guest = Guest()
    position = (-70_000).to_bytes(4, "little", signed=True)
    packet = b"\x09" + position
    expected = (packet + bytes([sum(packet) & 0xFF])).hex()

    guest.send(ADDRESS_1)

    assert guest.send(Packet(1, CommandCode.DEFINE_STATUS, b"\x01"), Packet(1, CommandCode.NO_OPERATION)) == [
        expected,
        expected,
    ]
    assert guest.asked[-2:] == [StatusItem.POSITION] * 2


def test_what_could_change_a_drive_is_answered_and_not_done() -> None:
    guest = Guest()
    guest.send(ADDRESS_1)
    changes = (
        Packet(1, CommandCode.RESET_POSITION),
        Packet(1, CommandCode.LOAD_TRAJECTORY, bytes((0x91, 0x10, 0, 0, 0))),
        Packet(1, CommandCode.START_MOTION),
        Packet(1, CommandCode.SET_GAIN, bytes(14)),
        Packet(1, CommandCode.STOP_MOTOR, b"\x01"),
        Packet(1, CommandCode.IO_CONTROL, b"\x00"),
        Packet(1, CommandCode.SET_HOMING_MODE, b"\x02"),
        Packet(1, CommandCode.CLEAR_STICKY_BITS),
        Packet(1, CommandCode.SAVE_CURRENT_POSITION_AS_HOME),
    )

    assert guest.send(*changes) == ["0909"] * len(changes)
    assert len(guest.refused) == len(changes)


def test_a_damaged_packet_is_reported_and_neither_done_nor_refused() -> None:
    guest = Guest()
    guest.send(ADDRESS_1)
    damaged = encode_packet(Packet(1, CommandCode.START_MOTION))[:-1] + b"\x00"

    assert guest.send_bytes(damaged) == "0b0b"
    assert guest.refused == []
    assert guest.send(Packet(1, CommandCode.NO_OPERATION)) == ["0909"]


def test_a_drive_without_a_recent_reading_is_silent() -> None:
    guest = Guest(reading=None)

    assert guest.send(ADDRESS_1, Packet(1, CommandCode.NO_OPERATION)) == ["", ""]
