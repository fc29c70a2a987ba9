"""An LDCN/NMC network on a simulated chain, without a daemon around it."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from ldcnd.drives.driver import AxisSpec, Gains
from ldcnd.drives.ldcn.config import LineSpec
from ldcnd.drives.ldcn.network import LdcnNetwork, ldcn_line
from ldcnd.drives.ldcn.packet import Packet, PacketReader
from ldcnd.drives.ldcn.registers import RESET_BAUD
from ldcnd.line.bus import Bus
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.line.settings import BusSettings
from ldcnd.line.transport import Transport
from ldcnd.sim.chain import Chain
from ldcnd.sim.line import open_simulated_line

GAINS = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, cl=0, el=4000, sr=1, deadband=0)


def specs(*models: str) -> tuple[AxisSpec, ...]:
    """Return axes a1, a2, ... of these models at addresses 1, 2, ..."""
    return tuple(AxisSpec(f"a{number}", number, model, GAINS) for number, model in enumerate(models, 1))


@dataclass(frozen=True, slots=True)
class BareNetwork:
    """A network and its open line."""

    bus: Bus
    network: LdcnNetwork

    def sent(self, skip: int = 0) -> list[Packet]:
        """Return the packets sent so far but the first ones, nulls left out."""
        reader = PacketReader()
        data = b"".join(
            record.data for record in self.bus.wire_log.records() if record.event is WireEvent.SENT and record.data
        )
        received = [reader.feed(value) for value in data]
        return [each.packet for each in received if each][skip:]


@asynccontextmanager
async def bare_network(
    chain: Chain,
    axes: tuple[AxisSpec, ...],
    baud: int = 115_200,
    line: LineSpec | None = None,
    fixed_baud: int | None = None,
) -> AsyncIterator[BareNetwork]:
    """Open the line, perhaps through a port that cannot change its rate; nothing is brought up yet."""

    async def opener() -> Transport:
        transport = await open_simulated_line(chain)
        transport.set_baud(fixed_baud or RESET_BAUD)
        transport.fixed_baud = fixed_baud is not None
        return transport

    async with asyncio.TaskGroup() as group:
        bus, network = ldcn_line(BusSettings("a", fixed_baud or RESET_BAUD), opener, axes, baud, line)
        running = group.create_task(bus.run(), name="bus")
        await bus.wait_opened()
        try:
            yield BareNetwork(bus, network)
        finally:
            running.cancel()
