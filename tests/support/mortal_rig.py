"""A daemon in this process that can be killed: from one instant on it sends nothing more and no line of it is executed.

What it had handed to the port before goes out to its end, as after SIGKILL of a process.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.daemon.assembly import build_daemon
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.line import SimulatedLine, open_simulated_line
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.rig import EPOCH_NS


class MortalLine:
    """Opens a simulated line, and lets nothing through any more after `kill`."""

    def __init__(self, chain: Chain) -> None:
        self.dead = False
        self._chain = chain

    async def open(self) -> SimulatedLine:
        """Open the line: an `Opener`."""
        line = await open_simulated_line(self._chain)
        write = line.write

        def write_while_alive(data: bytes) -> None:
            if not self.dead:
                write(data)

        line.write = write_while_alive  # type: ignore[method-assign]
        return line


@dataclass(frozen=True, slots=True)
class MortalRig:
    """The daemon's client, its line and its drives, and the way to kill the daemon."""

    client: RigClient
    chain: Chain
    line: MortalLine
    running: "asyncio.Task[None]"

    async def kill(self) -> None:
        """Kill the daemon: first its port, then all of its tasks; what they do about it reaches nobody."""
        self.line.dead = True
        self.running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self.running

    def drives(self) -> tuple[SimulatedDrive, ...]:
        """Return the drives as they are now."""
        now_s = asyncio.get_running_loop().time()
        self.chain.advance(now_s)
        found = tuple(module for module in self.chain.modules if isinstance(module, SimulatedDrive))
        for drive in found:
            drive.catch_up(now_s)
        return found


@asynccontextmanager
async def mortal_rig(config: RigConfig, chain: Chain) -> AsyncIterator[MortalRig]:
    """Run a daemon of one line on this chain, until the context ends or it is killed; its line is up."""
    (bus,) = config.bus
    loop = asyncio.get_running_loop()
    broker, line = MemoryBroker(), MortalLine(chain)

    def now_ns() -> int:
        return EPOCH_NS + round(loop.time() * 1e9)

    async with broker.session() as session, broker.session() as client:
        daemon = build_daemon(config, session, now_ns, "mortal", {bus.name: line.open})
        running = asyncio.create_task(daemon.run(), name="daemon")
        try:
            async with asyncio.timeout(60):
                await daemon.wait_up()
            yield MortalRig(RigClient(client, config.rig), chain, line, running)
        finally:
            running.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await running
