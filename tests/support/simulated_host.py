"""A host on a simulated LDCN/NMC chain that needs no event loop: it passes the time itself."""

from ldcnd.drives.ldcn.packet import CommandCode, Packet, StatusItem, StatusPacket, decode_status, encode_packet
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.sim.chain import Chain

PATIENCE_S = 0.03
"""Longer than any exchange at 9600 baud."""


class SimulatedHost:
    """Sends packets and collects what comes back.

    Attributes:
        now_s: the line's clock.
        heard: the pieces that came back on the last request, with their instants.
    """

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self.now_s = 0.0
        self.heard: list[tuple[float, bytes]] = []

    def wait(self, for_s: float) -> bytes:
        """Pass time; return what arrived meanwhile."""
        self.now_s += for_s
        self.heard = self.chain.advance(self.now_s)
        return b"".join(data for _, data in self.heard)

    def send(self, address: int, command: CommandCode, *data: int) -> bytes:
        """Send one packet and return everything that comes back."""
        self.chain.write(self.now_s, encode_packet(Packet(address, command, bytes(data))))
        return self.wait(PATIENCE_S)

    def read(self, address: int, profile: Profile, items: StatusItem | int = 0x7F) -> StatusPacket:
        """Read status items once."""
        wanted = StatusItem(items)
        return decode_status(profile, wanted, self.send(address, CommandCode.READ_STATUS, wanted))

    def address_all(self) -> None:
        """Give the modules addresses 1, 2, ... and the group FF."""
        for address in range(1, len(self.chain.modules) + 1):
            reply = self.send(0, CommandCode.SET_ADDRESS, address, 0xFF)
            assert len(reply) == 2, f"module {address} answered {reply.hex()}"


def little(value: int, width: int) -> bytes:
    """Return a number as it travels."""
    return value.to_bytes(width, "little", signed=value < 0)
