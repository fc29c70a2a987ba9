"""A numeric field in the data of an LDCN/NMC command: its name, width and range, and both directions of its bytes.

All fields are sent least significant byte first.
Sources: LS-182AP manual, "Serial Command Interface" and "Command Description"; PIC-SERVO manual, 5.2.
"""

from dataclasses import dataclass

from ldcnd.errors import ValueOutOfRange


@dataclass(frozen=True, slots=True)
class Field:
    """One register as it travels.

    Attributes:
        name: as in the manuals.
        width: bytes.
        least: the lower end of the documented range; a field that may be negative is two's complement.
        most: the upper end.
    """

    name: str
    width: int
    least: int
    most: int

    def check(self, value: int) -> None:
        """Refuse what the register does not take.

        Raises:
            ValueOutOfRange: with the limit that the value breaks.
        """
        if not self.least <= value <= self.most:
            nearest = self.least if value < self.least else self.most
            raise ValueOutOfRange(
                f"{self.name} {value} is outside {self.least} to {self.most}",
                value=value,
                limit=nearest,
                nearest=nearest,
            )

    def encode(self, value: int) -> bytes:
        """Return the field's bytes.

        Raises:
            ValueOutOfRange: see `check`.
        """
        self.check(value)
        return value.to_bytes(self.width, "little", signed=self.least < 0)

    def decode(self, data: bytes) -> int:
        """Return the value of up to `width` bytes, in range or not; missing ones count as 0, as in the firmware."""
        return int.from_bytes(data[: self.width].ljust(self.width, b"\0"), "little", signed=self.least < 0)


ADDRESS = Field("individual address", 1, 0x01, 0x7F)
"""PIC-SERVO takes 0 to 255 [manual, 5.2], but above 127 an individual address could not be told from a group's."""
GROUP_ADDRESS = Field("group address", 1, 0x80, 0xFF)
GROUP_MEMBER = 0x80
"""This bit of the group address, cleared in the data of Set Address, makes the module the leader of its group."""
POSITION = Field("position", 4, -0x7FFF_FFFF, 0x7FFF_FFFF)
"""Both manuals leave out the most negative 32-bit value."""
