"""A line without time: takes exchanges as a `Bus` does and carries them to a simulated chain at once."""

import inspect
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import TypeVar

from ldcnd.drives.ldcn.packet import CommandCode, Packet, PacketReader
from ldcnd.line.exchange import Exchange, Lane
from ldcnd.line.proof import Proofs
from tests.support.simulated_host import SimulatedHost

ReplyT = TypeVar("ReplyT")

Interference = Callable[[], Awaitable[object] | object]
"""What happens beside an exchange: it may raise."""
REPLIED_S = 0.03
"""Longer than any exchange at 9600 baud."""


class DirectBus:
    """What drivers need of a `Bus`.

    Attributes:
        packets: what was sent.
        sent: the commands, each with its lane.
        instead: what happens before the next packet of a command; if it raises, the packet is not sent.
        after: what happens after the next packet of a command, before its reply is taken.
        settings, baud, proofs: as of a `Bus`.
    """

    def __init__(self, host: SimulatedHost) -> None:
        self.host = host
        self.packets: list[Packet] = []
        self.sent: list[tuple[CommandCode, Lane]] = []
        self.instead: dict[CommandCode, Interference] = {}
        self.after: dict[CommandCode, Interference] = {}
        self.settings = SimpleNamespace(name="direct", bits_per_byte=10)
        self.baud = 19_200
        self.proofs = Proofs()

    async def execute(
        self,
        exchange: Exchange[ReplyT],
        lane: Lane = Lane.COMMAND,
        *,
        once: bool = False,
        sent: Callable[[], None] | None = None,
    ) -> ReplyT:
        """Carry an exchange out; `once` makes no difference where nothing is repeated."""
        packet = packet_of(exchange.request)
        command = CommandCode(packet.command)
        self.packets.append(packet)
        self.sent.append((command, lane))
        await _happen(self.instead, command)
        if sent:
            sent()
        self.host.chain.write(self.host.now_s, exchange.request)
        reply = self.host.wait(REPLIED_S)
        await _happen(self.after, command)
        return exchange.decode(reply)

    def commands(self, since: int = 0) -> list[CommandCode]:
        """Return the commands that were sent."""
        return [command for command, _ in self.sent[since:]]


async def _happen(happenings: dict[CommandCode, Interference], command: CommandCode) -> None:
    if command in happenings:
        result = happenings.pop(command)()
        if inspect.isawaitable(result):
            await result


def packet_of(request: bytes) -> Packet:
    """Return the packet that is sent."""
    reader = PacketReader()
    (received,) = [received for value in request if (received := reader.feed(value))]
    return received.packet
