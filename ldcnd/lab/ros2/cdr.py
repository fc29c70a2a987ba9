"""Messages of ROS 2 in CDR, little-endian, as DDS and rmw_zenoh carry them."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

ENCAPSULATION = b"\x00\x01\x00\x00"
"""Plain CDR, little-endian; alignment counts from behind it."""


class Writer:
    """Appends values, each at a multiple of its size."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    @property
    def message(self) -> bytes:
        """The whole message, with its encapsulation."""
        return ENCAPSULATION + bytes(self._bytes)

    def octet(self, value: int) -> None:
        """Append a byte."""
        self._bytes.append(value)

    def int32(self, value: int) -> None:
        """Append a signed word of 32 bits."""
        self._align(4)
        self._bytes += struct.pack("<i", value)

    def uint32(self, value: int) -> None:
        """Append an unsigned word of 32 bits."""
        self._align(4)
        self._bytes += struct.pack("<I", value)

    def string(self, value: str) -> None:
        """Append a text; its length counts the zero behind it."""
        encoded = value.encode() + b"\0"
        self.uint32(len(encoded))
        self._bytes += encoded

    def float64s(self, values: Sequence[float]) -> None:
        """Append a sequence of numbers."""
        self.uint32(len(values))
        if values:
            self._align(8)
            self._bytes += struct.pack(f"<{len(values)}d", *values)

    def _align(self, size: int) -> None:
        self._bytes += bytes(-len(self._bytes) % size)


@dataclass(frozen=True, slots=True)
class MessageType:
    """A type of message.

    Attributes:
        name: as in key expressions.
        type_hash: of the definition, as REP-2016 computes it.
    """

    name: str
    type_hash: str


@dataclass(frozen=True, slots=True)
class JointState:
    """sensor_msgs/msg/JointState: radians and metres, and their rates.

    Attributes:
        t: when that was so, UTC in ns since 1970.
        names: of the joints.
        positions: of each.
        velocities: of each, or none at all.
    """

    t: int
    names: tuple[str, ...]
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()

    @property
    def payload(self) -> bytes:
        """The message in CDR."""
        writer = Writer()
        _header(writer, self.t)
        writer.uint32(len(self.names))
        for name in self.names:
            writer.string(name)
        writer.float64s(self.positions)
        writer.float64s(self.velocities)
        writer.float64s(())  # no drive says what effort it makes
        return writer.message


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """diagnostic_msgs/msg/DiagnosticStatus.

    Attributes:
        level: 0 is fine, 1 a warning, 2 an error, 3 means that nothing is known.
        name: of what it is about.
        message: in a few words.
        hardware_id: which device.
        values: more about it.
    """

    level: int
    name: str
    message: str
    hardware_id: str
    values: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class DiagnosticArray:
    """diagnostic_msgs/msg/DiagnosticArray.

    Attributes:
        t: when that was so, UTC in ns since 1970.
        statuses: of each device.
    """

    t: int
    statuses: tuple[DiagnosticStatus, ...]

    @property
    def payload(self) -> bytes:
        """The message in CDR."""
        writer = Writer()
        _header(writer, self.t)
        writer.uint32(len(self.statuses))
        for status in self.statuses:
            writer.octet(status.level)
            for text in (status.name, status.message, status.hardware_id):
                writer.string(text)
            writer.uint32(len(status.values))
            for key, value in status.values:
                writer.string(key)
                writer.string(value)
        return writer.message


JOINT_STATE = MessageType(
    "sensor_msgs::msg::dds_::JointState_",
    "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
)
DIAGNOSTIC_ARRAY = MessageType(
    "diagnostic_msgs::msg::dds_::DiagnosticArray_",
    "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
)


def _header(writer: Writer, t: int) -> None:
    """Append a std_msgs/msg/Header without a frame."""
    writer.int32(t // 1_000_000_000)
    writer.uint32(t % 1_000_000_000)
    writer.string("")
