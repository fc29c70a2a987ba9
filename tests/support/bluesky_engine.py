"""A RunEngine, a whole daemon and devices on one loop whose clock jumps: a scan takes as long as it computes."""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from bluesky import RunEngine
from event_model import DocumentNames, schema_validators

from ldcnd.client.loop_thread import LoopThread
from ldcnd.client.rig import Rig
from ldcnd.config.rig import RigConfig
from ldcnd.contract.samples import LinkState, Moving, StateSample
from ldcnd.lab.bluesky import Devices, PlanAxis
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.rig import RunningRig, running_rig, two_axes

with suppress(ImportError):
    import_module("ophyd")  # an engine imports it where it is, beside a loop that leaves hardly any time for that

TICK_S = 1.0
MODELS = ("ls182ap", "ls182ap")
COUNTS_PER_UNIT = {"x": 1000, "y": 1000}
"""Of config/simulated.toml."""


@dataclass  # an engine refers weakly to the method that takes them
class Documents:
    """What a RunEngine emits, each checked against event-model's own schema."""

    taken: list[tuple[str, dict[str, Any]]] = field(default_factory=list)

    def take(self, name: str, document: dict[str, Any]) -> None:
        """Check and keep a document."""
        schema_validators[DocumentNames[name]].validate(document)
        self.taken.append((name, document))

    def of(self, name: str) -> list[dict[str, Any]]:
        """Return the documents of one kind, in their order."""
        return [document for kind, document in self.taken if kind == name]

    def data(self, key: str) -> list[Any]:
        """Return the values of one key, in the order of the events that have it."""
        return [event["data"][key] for event in self.of("event") if key in event["data"]]

    def data_of_pages(self, key: str, columns: str = "data") -> list[Any]:
        """Return the values of one key, in the order of the pages of events that have it, or what else these have."""
        return [value for page in self.of("event_page") for value in page[columns].get(key, ())]

    @property
    def exit_status(self) -> str:
        """How the last run ended."""
        status: str = self.of("stop")[-1]["exit_status"]
        return status


@dataclass(frozen=True, slots=True)
class Laboratory:
    """A RunEngine and a rig."""

    engine: RunEngine
    devices: Devices
    running: RunningRig
    loop: LoopThread
    clock: JumpingLoop
    documents: Documents
    chain: Chain

    @contextmanager
    def powered(self, *axes: str) -> Iterator[tuple[PlanAxis, ...]]:
        """Control some axes, with their position loops closed."""
        with self.devices.control_all(*axes, client="scan") as held:
            for axis in held:
                axis.power(on=True).wait(20)
            yield held

    @contextmanager
    def clock_standing(self) -> Iterator[None]:
        """Let the clock stand until the context ends: what a thread begins in it begins at one instant."""
        self.loop.call(self.clock.hold, 1)
        yield
        self.loop.call(self.clock.hold, -1)

    @contextmanager
    def caught_moving(self, axis: str, target: float | None = None, for_s: float = 0.0) -> Iterator[Callable[[], None]]:
        """Yield a function that waits until an axis has moved for so long; then the clock stands until the end.

        A motion for which a thread only looks may be over before the thread runs.
        """

        def is_wanted(state: StateSample) -> bool:
            return state.moving is Moving.YES and (
                target is None or (state.command is not None and state.command.target == target)
            )

        async def catch() -> None:
            await self.running.until(axis, is_wanted)
            await asyncio.sleep(for_s)
            self.clock.hold(1)

        catching = self.loop.start(catch())
        yield lambda: catching.result(60)
        self.loop.call(self.clock.hold, -1)

    def truth(self, axis: str) -> float:
        """Return where the simulated motor of an axis of the simulated rig is, in axis units."""
        return self.module(axis).shaft.position_counts / COUNTS_PER_UNIT[axis]

    def potentiometer(self, axis: str) -> float:
        """Return how far the potentiometer on the motor of an axis is turned, 0 to 1."""
        return self.module(axis).shaft.potentiometer()

    def module(self, axis: str) -> SimulatedDrive:
        """Return the simulated drive of an axis."""
        module = self.chain.modules[list(COUNTS_PER_UNIT).index(axis)]
        assert isinstance(module, SimulatedDrive)
        return module

    def unplug(self, axis: str) -> None:
        """Switch a drive off."""

        async def switch() -> None:
            self.module(axis).power(on=False, at_s=asyncio.get_running_loop().time())

        self.loop.run(switch())


@contextmanager
def laboratory(config: RigConfig | None = None) -> Iterator[Laboratory]:
    """Run a daemon and a RunEngine until the context ends, on two axes of the simulated rig if not on another one."""
    loop = JumpingLoop()
    chain = build_chain(ChainSpec(tuple(map(ModuleSpec, MODELS))))
    chains = {} if config else {"line0": chain}

    def tick() -> None:
        loop.call_later(TICK_S, tick)

    loop.call_soon(tick)
    engine = RunEngine({}, loop=loop, context_managers=[])
    documents = Documents()
    engine.subscribe(documents.take)  # type: ignore[no-untyped-call]
    there = LoopThread(loop)
    try:
        with there.inside(running_rig(config or two_axes(), chains)) as running:

            async def rig() -> Rig:
                for name in running.daemon.rig.axes:
                    await running.until(name, lambda state: state.link is LinkState.UP)
                return Rig(running.client, await running.client.daemon())

            yield Laboratory(engine, Devices(there.run(rig()), there), running, there, loop, documents, chain)
    finally:
        loop.call_soon_threadsafe(loop.stop)
        engine._th.join()
        loop.close()
