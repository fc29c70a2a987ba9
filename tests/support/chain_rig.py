"""A daemon on a simulated chain that outlives it, as drives outlive their host."""

import asyncio
import tomllib
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from types import MappingProxyType

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.contract.errors import TransportLost
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.line import BusService
from ldcnd.drives.ldcn.packet import Packet, PacketReader
from ldcnd.drives.ldcn.registers import RESET_BAUD
from ldcnd.line.bus import Bus
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.line.transport import Opener, Transport
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.line import open_simulated_line
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.rig import EPOCH_NS, SIMULATED, RunningRig

UP_WITHIN_S = 60.0
UNSEEN_MOTIONS_END: Mapping[str, object] = MappingProxyType({"loss": {"bus": "run_to_target"}})
"""Settings of axes whose motions are not stopped because nobody could see them for a while."""


def simulated_config(axes: Mapping[str, object] | None = None, **bus: object) -> RigConfig:
    """Return the simulated rig's configuration with other settings of its line, and of all its axes."""
    document = tomllib.loads(SIMULATED.read_text())
    document["bus"][0] |= {"margin_ms": 5, **bus}
    for axis in document["bus"][0]["axis"]:
        axis.update(axes or {})
    return RigConfig.model_validate(document)


def drive(chain: Chain, address: int) -> SimulatedDrive:
    """Return the drive at a place of the chain, with its servo cycles up to now behind it."""
    module = chain.modules[address - 1]
    assert isinstance(module, SimulatedDrive)
    module.catch_up(asyncio.get_running_loop().time())
    return module


@dataclass(frozen=True, slots=True)
class ChainRig(RunningRig):
    """A running daemon that can be killed."""

    running: "asyncio.Task[None]"

    @property
    def line(self) -> BusService:
        """Return the only line."""
        return self.daemon.rig.buses[0]

    @property
    def sent(self) -> list[Packet]:
        """Return every packet that the daemon has sent, nulls left out."""
        reader = PacketReader()
        records = self.line.bus.wire_log.records()
        data = b"".join(record.data for record in records if record.event is WireEvent.SENT)
        received = [reader.feed(value) for value in data]
        return [each.packet for each in received if each]

    async def kill(self) -> None:
        """End the daemon as SIGKILL would: nothing more is sent."""
        self.running.cancel()
        await asyncio.wait([self.running])


@asynccontextmanager
async def taken_away(bus: Bus) -> AsyncIterator[None]:
    """Have the cable of a line in the hands of others until the context ends, and back in its port then."""
    opener = bus._opener

    async def nothing() -> Transport:
        raise TransportLost("there is no adapter")

    bus._opener = nothing
    bus.drop("a cable that is pulled")
    try:
        yield
    finally:
        bus._opener = opener


@asynccontextmanager
async def rig_on(
    chain: Chain, config: RigConfig, *, up: bool = True, opener: Opener | None = None
) -> AsyncIterator[ChainRig]:
    """Run a daemon on this chain until the context ends; without `up` its line may stay down.

    Args:
        chain: the drives.
        config: the rig.
        up: its line is up when the context begins.
        opener: opens another way to the chain.
    """
    loop = asyncio.get_running_loop()
    broker = MemoryBroker()

    def now_ns() -> int:
        return EPOCH_NS + round(loop.time() * 1e9)

    async with broker.session() as session, broker.session() as client_session:
        daemon = build_daemon(config, session, now_ns, "test")
        daemon.rig.buses[0].bus._opener = opener or (lambda: open_simulated_line(chain, RESET_BAUD))
        async with asyncio.TaskGroup() as group:
            running = group.create_task(daemon.run(), name="daemon")
            rig = ChainRig(daemon, RigClient(client_session, config.rig), client_session, broker, running)
            try:
                if up:
                    async with asyncio.timeout(UP_WITHIN_S):
                        await daemon.wait_up()
                yield rig
            finally:
                daemon.end()
                await asyncio.wait([running])
