"""A whole daemon in this process: simulated line, memory session, jumping clock."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from typing_extensions import override

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import CommandReply, Power
from ldcnd.contract.events import CommandStatus, ReadEvents
from ldcnd.contract.samples import LinkState, StateSample
from ldcnd.daemon.daemon import Daemon
from ldcnd.line.transport import Opener
from ldcnd.sim.chain import Chain
from ldcnd.sim.known import opener_of
from ldcnd.sim.ldcn.simulation import SimulatedLdcnLineConfig
from ldcnd.testing.memory_session import MemoryBroker, MemorySession
from ldcnd.testing.rig import SimulatedRig, lines_of

EPOCH_NS = 1_700_000_000_000_000_000
SIMULATED = Path(__file__).parents[2] / "config" / "simulated.toml"


@dataclass(frozen=True, slots=True)
class RunningRig:
    """A daemon that serves, and a client's ways to it."""

    daemon: Daemon
    client: RigClient
    session: MemorySession
    broker: MemoryBroker
    lives: SimulatedRig | None = field(default=None, kw_only=True)
    """Where its daemon can be ended, and another one started."""

    async def begin_anew(self, after_s: float, *, killed: bool) -> None:
        """End the daemon, or kill it, and start another one on the same lines some time later."""
        assert self.lives
        if killed:
            await self.lives.kill_daemon()
        else:
            await self.lives.close()
        await asyncio.sleep(after_s)
        await self.lives.start_daemon()
        object.__setattr__(self, "daemon", self.lives.daemon)

    async def until(self, axis: str, wanted: Callable[[StateSample], bool], within_s: float = 60.0) -> StateSample:
        """Wait for a state of an axis."""
        async with asyncio.timeout(within_s):
            async with self.client.samples(axis, "state") as states:
                sample = await self.client.state(axis)
                while sample is None or not wanted(sample):
                    _, latest = await anext(states)
                    assert isinstance(latest, StateSample)
                    sample = latest
                return sample

    async def power_on(self, *axes: str) -> None:
        """Close the loops of axes once their lines are up."""
        for axis in axes:
            await self.until(axis, lambda state: state.link is LinkState.UP)
            await self.client.command(axis, Power(on=True))

    async def refusal(self, waiting: CommandReply) -> str | None:
        """Return the code for which a command that waited did not begin; None if it did."""
        await self.client.wait_for_end(waiting.axis, waiting.command_id)
        page = await self.client.ask(ReadEvents(axis=waiting.axis, count=100))
        last = [event for event in page.events if event.command_id == waiting.command_id][-1]
        return last.code if last.status in (CommandStatus.REFUSED, CommandStatus.ABORTED) else None


class _Rig(SimulatedRig):
    """A rig whose daemon may have a clock that is wrong."""

    def __init__(
        self, config: RigConfig, broker: MemoryBroker, lines: Mapping[str, Chain], off_s: Callable[[], float]
    ) -> None:
        zero_ns = EPOCH_NS + round(asyncio.get_running_loop().time() * 1e9)
        super().__init__(config, broker, lines, zero_ns, (lambda _: None, lambda _: None))
        self._off_s = off_s

    @override
    def now_ns(self) -> int:
        return super().now_ns() + round(self._off_s() * 1e9)


@asynccontextmanager
async def running_rig(
    config: RigConfig | None = None,
    chains: Mapping[str, Chain] = MappingProxyType({}),
    *,
    broker: MemoryBroker | None = None,
    clock_off_s: Callable[[], float] = lambda: 0.0,
) -> AsyncIterator[RunningRig]:
    """Run a daemon until the context ends; its lines are up when the context begins.

    Args:
        config: the rig; the simulated one if missing.
        chains: simulated lines that exist already, by name.
        broker: the network; one of its own if missing.
        clock_off_s: returns by how much the machine's clock is wrong; time itself goes on.
    """
    config = config or load_config(SIMULATED)
    broker = broker or MemoryBroker()
    made = {bus.name: chains[bus.simulated] for bus in config.bus if bus.simulated in chains}
    unmade = config.model_copy(update={"bus": tuple(bus for bus in config.bus if bus.name not in made)})
    rig = _Rig(config, broker, {**lines_of(unmade), **made}, clock_off_s)
    async with broker.session() as session:
        try:
            await rig.start_daemon()
            yield RunningRig(rig.daemon, RigClient(session, config.rig), session, broker, lives=rig)
        finally:
            await rig.close()


def openers_of(config: RigConfig, chains: Mapping[str, Chain]) -> dict[str, Opener]:
    """Return what opens simulated lines that exist already, by the name of the bus; `chains` has them by their own."""
    return {
        bus.name: opener_of(bus, config.sim, chains[bus.simulated]) for bus in config.bus if bus.simulated in chains
    }


def two_axes() -> RigConfig:
    """Return the simulated rig with its first two axes and their drives only."""
    return first_axes(2)


def first_axes(count: int, **changes: object) -> RigConfig:
    """Return the simulated rig with its first axes and their drives only, each axis with these changes."""
    config = load_config(SIMULATED)
    (bus,), (line,) = config.bus, config.sim
    assert isinstance(line, SimulatedLdcnLineConfig)
    axes = tuple(axis.model_copy(update=changes) for axis in bus.axis[:count])
    return config.model_copy(
        update={
            "bus": (bus.model_copy(update={"axis": axes, "group": ()}),),
            "sim": (line.model_copy(update={"module": line.module[:count]}),),
        }
    )


def two_lines(folder: Path) -> RigConfig:
    """Return the centrifuge, with all its rules, as `line0` of a rig whose `line1` is that of the simulated rig."""
    machine = SIMULATED.with_name("centrifuge.toml").read_text(encoding="utf-8")
    plain = SIMULATED.read_text(encoding="utf-8").replace("line0", "line1")
    (path := folder / "two_lines.toml").write_text(machine + plain[plain.index("[[bus]]") :], encoding="utf-8")
    return load_config(path)
