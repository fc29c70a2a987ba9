"""A whole rig in the process of a test: its daemon, its simulated lines, a client, and a network between them."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar

from typing_extensions import override

from ldcnd.axis.status import AxisStatus
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.errors import NotSupported, OutcomeUnknown, UnknownAxis
from ldcnd.contract.samples import LinkState
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.daemon import Daemon
from ldcnd.drives.known import FAMILIES
from ldcnd.drives.ldcn.config import LdcnBusConfig
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.line.transport import Opener, Receiver, Transport
from ldcnd.net.hand_over import Answer
from ldcnd.net.session import NO_PARAMETERS, QUERY_TIMEOUT_S, OnSample, Session
from ldcnd.sim.chain import Chain
from ldcnd.sim.known import SIMULATED, opener_of
from ldcnd.testing.blocking import RigClock, on_clock, run_in_thread
from ldcnd.testing.faults import Change, Processes, RigFaults
from ldcnd.testing.jumping_loop import JumpingLoop
from ldcnd.testing.lines import simulated_config
from ldcnd.testing.memory_session import MemoryBroker, MemorySession
from ldcnd.testing.timeline import Timeline
from ldcnd.testing.truth import Machine, ModuleTruth, Terminals, Truth, terminals_of
from ldcnd.testing.twin import RigState, config_of_twin, place, recall, restore

P = ParamSpec("P")
ResultT = TypeVar("ResultT")

BEGINS_NS = 1_700_000_000_000_000_000
"""The wall clock at the beginning of every rehearsal, UTC in ns since 1970: what is repeated is the same to the bit."""
UP_WITHIN_S = 60.0
SETTLES_S = 0.05
"""How late events are published at most, and more, in seconds of the jumping clock."""
LOOK_S = 0.01
"""How often a condition is looked at, in seconds of the jumping clock."""


def run(program: Coroutine[Any, Any, ResultT]) -> ResultT:
    """Run a program on a clock that jumps from timer to timer: minutes of a rig in a second; as `asyncio.run`.

    Everything that the program waits for must be in this process. A program that waits for what never comes ends with
    RuntimeError and the word deadlock.
    """
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        return runner.run(program)


class _MortalPort(Transport):
    """A port of a daemon that can be killed: from then on nothing passes in either direction."""

    def __init__(self, port: Transport, life: "_Life") -> None:
        self._port = port
        self._life = life
        self.fixed_baud, self.lag_s, self.pushes = port.fixed_baud, port.lag_s, port.pushes

    @override
    def attach(self, receiver: Receiver) -> None:
        self._port.attach(receiver)

    @override
    def write(self, data: bytes) -> None:
        if self._life.alive:
            self._port.write(data)

    @override
    def push(self) -> None:
        self._port.push()

    @override
    def expect(self, reply_bytes: int) -> None:
        self._port.expect(reply_bytes)

    @override
    def collect(self) -> None:
        self._port.collect()

    @override
    def discard_input(self) -> None:
        self._port.discard_input()

    @override
    def set_baud(self, baud: int) -> None:
        if self._life.alive:
            self._port.set_baud(baud)

    @override
    async def close(self) -> None:
        await self._port.close()


class _Life:
    """Of one daemon, from its start until it ends or is killed."""

    def __init__(self) -> None:
        self.alive = True

    def opener(self, open_port: Opener) -> Opener:
        async def open_mortal() -> Transport:
            return _MortalPort(await open_port(), self)

        return open_mortal


class _ClientSession(MemorySession):
    """The session of the rig's own client, which can be cut off: then nothing comes back."""

    cut = False

    @override
    async def query(
        self,
        key: str,
        payload: bytes = b"",
        *,
        encoding: str = "",
        parameters: Mapping[str, str] = NO_PARAMETERS,
        timeout_s: float = QUERY_TIMEOUT_S,
        urgent: bool = False,
        everyone: bool = False,
        in_order: bool = False,
    ) -> list[Answer]:
        if self.cut:
            await asyncio.sleep(timeout_s)
            raise OutcomeUnknown(f"{key}: no answer within {timeout_s:g} s; it may be carried out all the same")
        return await super().query(
            key,
            payload,
            encoding=encoding,
            parameters=parameters,
            timeout_s=timeout_s,
            urgent=urgent,
            everyone=everyone,
            in_order=in_order,
        )


class RigNetwork(Protocol):
    """What the sessions of a rig share: a `MemoryBroker`, or Zenoh in real time."""

    def session(self, *, overhear: OnSample | None = None) -> AbstractAsyncContextManager[Session]:
        """Join it; `overhear` gets every sample that this session publishes."""


class SimulatedRig:
    """A rig that is rehearsed on; made by `simulated_rig`.

    Attributes:
        config: of the daemon.
        client: the rig as a program sees it, the same as `ldcnd.connect` gives.
        faults: what may go wrong, by name.
        timeline: what has happened.
        lines: the simulated lines, by name of the bus.
        network: others can join it.
    """

    def __init__(
        self,
        config: RigConfig,
        network: RigNetwork,
        lines: Mapping[str, Chain],
        begins_ns: int,
        lose_client: tuple[Change, Change],
    ) -> None:
        self.config = config
        self.network = network
        self.lines = lines
        self.client: Rig
        self._loop = asyncio.get_running_loop()
        self._zero_s = self._loop.time()
        self._begins_ns = begins_ns
        self.timeline = Timeline(lambda: self.now_s, begins_ns)
        self._daemon: Daemon | None = None
        self._life = _Life()
        self._serving: asyncio.Task[None] | None = None
        self._runs = 0
        self._leases = count(1)  # the clock may stand between two of them
        self._errands: set[asyncio.Task[None]] = set()
        self._machines = {
            axis.name: Machine(axis, bus.name, lines[bus.name], place)
            for bus in config.bus
            for axis in bus.axis
            if bus.name in lines
            for place in [sorted(bus.models).index(axis.address) + 1]
        }
        self._modules = {
            module.name: Terminals(module, lines[bus.name], sorted(bus.models).index(module.address) + 1)
            for bus in config.bus
            if isinstance(bus, LdcnBusConfig) and bus.name in lines
            for module in bus.module
            if module.name
        }
        processes = Processes(
            kill_daemon=(lambda _: self._later(self.kill_daemon()), lambda _: self._later(self.start_daemon())),
            lose_client=lose_client,
        )
        self.faults = RigFaults(
            self.machine, self._modules, lines, self.truth, self._loop, processes, self.timeline.note
        )

    @property
    def now_s(self) -> float:
        """Seconds since the rig was made, on its own clock."""
        return self._loop.time() - self._zero_s

    @property
    def daemon(self) -> Daemon:
        """The daemon that runs.

        Raises:
            NotSupported: none does; it was killed.
        """
        if self._daemon is None:
            raise NotSupported("no daemon runs: it was killed", remedy="await rig.start_daemon()")
        return self._daemon

    def truth(self, axis: str) -> Truth:
        """Return what is really so with an axis, whatever the daemon says of it.

        Raises:
            UnknownAxis: there is no such axis.
        """
        return self.machine(axis).look(self._loop.time())

    def module_truth(self, module: str) -> ModuleTruth:
        """Return what is really so at the terminals of an I/O module: levels, outputs, doors, bolts.

        Raises:
            ValueOutOfRange: there is no such module.
        """
        return terminals_of(self._modules, module).look(self._loop.time())

    def packets(self, count: int = 12) -> str:
        """Return the last packets of each line, in words; those of a daemon that was killed are gone with it."""
        told: list[str] = []
        for line in self._daemon.rig.buses if self._daemon else ():
            models = {axis.config.address: axis.config.model for axis in line.axes}
            describe = FAMILIES[line.family].describe(models)
            packets = [
                record for record in line.bus.wire_log.records() if record.event in (WireEvent.SENT, WireEvent.RECEIVED)
            ]
            told.append(f"the last packets on {line.bus.settings.name}:")
            told += [
                f"{record.at_s - self._zero_s:9.3f} s  {record.event:<8} {describe(record) or record.data.hex(' ')}"
                for record in packets[-count:]
            ]
        return "\n".join(told)

    def settle(self) -> None:
        """Let what has happened come to the timeline, once nothing runs on the loop any more."""
        if isinstance(self._loop, JumpingLoop) and not self._loop.is_running() and not self._loop.is_closed():
            self._loop.run_until_complete(asyncio.sleep(SETTLES_S))

    async def until(self, condition: Callable[[], bool], within_s: float = 60.0) -> None:
        """Wait until something is so; it is asked every 10 ms of the rig's clock.

        Raises:
            TimeoutError: it was not within so many seconds.
        """
        async with asyncio.timeout(within_s):
            while not condition():  # noqa: ASYNC110 - on the jumping clock, looking again costs nothing
                await asyncio.sleep(LOOK_S)

    async def at_rest(self, *axes: str, within_s: float = 60.0) -> None:
        """Wait until axes stand, all of them if none is named.

        Raises:
            TimeoutError: one of them still moves.
        """
        names = axes or tuple(self._machines)
        await self.until(lambda: all(self.truth(name).at_rest for name in names), within_s)

    async def run_blocking(self, program: Callable[P, ResultT], *args: P.args, **kwargs: P.kwargs) -> ResultT:
        """Run a program that has no event loop, such as one that uses `ldcnd.open`, and return its result.

        It runs in a thread of its own. The clock stands while it computes, and jumps while it waits for the client or
        in `time.sleep`; `time.time` and `time.monotonic` show the rig's clock there.

        Args:
            program: what is run; `ldcnd.open()` and `ldcnd.connect_blocking()` in it reach this rig.
            args: of the program.
            kwargs: of the program.
        """
        if not isinstance(self._loop, JumpingLoop):
            return await asyncio.to_thread(program, *args, **kwargs)
        return await run_in_thread(self._loop, self.wall_s, program, *args, **kwargs)

    async def start_daemon(self, state: RigState | None = None) -> None:
        """Start a daemon on the same lines, and wait until they are up.

        Args:
            state: of the rig whose latches and references it begins with; none, when missing.

        Raises:
            TimeoutError: they do not come up within a minute of the rig's clock.
        """
        self._runs += 1
        self.timeline.note(f"daemon {self._runs} starts")
        made: asyncio.Future[Daemon] = self._loop.create_future()
        self._life = _Life()
        self._serving = asyncio.create_task(self._serve(self._life, made, state), name=f"daemon {self._runs}")
        up = asyncio.create_task(self._up(made), name="lines up")
        try:
            await asyncio.wait((self._serving, up), return_when=asyncio.FIRST_COMPLETED)
            if not up.done():
                await self._serving
            await up
        finally:
            up.cancel()
        if state:
            restore(self.daemon, self.machine, state)

    async def _up(self, made: "asyncio.Future[Daemon]") -> None:
        async with asyncio.timeout(UP_WITHIN_S):
            await (await made).wait_up()

    async def kill_daemon(self) -> None:
        """Kill the daemon, as SIGKILL does: not one packet of it follows, and the drives go on with what they do."""
        self.timeline.note(f"daemon {self._runs} is killed")
        self._life.alive = False
        if self._serving:
            self._serving.cancel()
        await self._ended()

    async def _ended(self) -> None:
        if self._serving:
            with contextlib.suppress(asyncio.CancelledError):
                await self._serving
        self._serving = self._daemon = None

    async def _serve(self, life: _Life, made: "asyncio.Future[Daemon]", state: RigState | None) -> None:
        config, run = self.config, f"run{self._runs}"
        openers = {
            bus.name: life.opener(opener_of(bus, config.sim, self.lines[bus.name]))
            for bus in config.bus
            if bus.name in self.lines
        }
        async with self.network.session(overhear=self.timeline.take) as session:
            self._daemon = build_daemon(
                config, session, self.now_ns, run, openers, lambda: f"lease-{self._runs}-{next(self._leases)}"
            )
            for name, axis in self._daemon.rig.axes.items():
                axis.tracker.watch(partial(self._refer, name), "scale", "referenced")
            if state:
                recall(self._daemon, state, self.now_ns())
            made.set_result(self._daemon)
            await self._daemon.run()

    def _refer(self, axis: str, _: AxisStatus, status: AxisStatus) -> None:
        if status.referenced:
            self.machine(axis).refer(status.scale, self._loop.time())

    def wall_s(self) -> float:
        """Return what the wall clock of the rig shows, in seconds since 1970."""
        return self.now_ns() / 1e9

    def now_ns(self) -> int:
        """Return the same in ns."""
        return self._begins_ns + round(self.now_s * 1e9)

    def machine(self, axis: str) -> Machine:
        """Return the simulated drive of an axis and what is on its shaft.

        Raises:
            UnknownAxis: there is no such axis.
        """
        if axis not in self._machines:
            raise UnknownAxis(f"there is no axis {axis!r}; there are {', '.join(self._machines)}", value=axis)
        return self._machines[axis]

    def _later(self, errand: Awaitable[None]) -> None:
        task = asyncio.ensure_future(errand)
        self._errands.add(task)
        task.add_done_callback(self._errands.discard)

    async def join(self, session: Session) -> None:
        """Connect the rig's own client, and wait until every drive answers."""
        client = RigClient(session, self.config.rig)
        self.client = Rig(client, await client.daemon())
        async with asyncio.timeout(UP_WITHIN_S):
            while not await self._all_answer(client):  # noqa: ASYNC110 - as above
                await asyncio.sleep(LOOK_S)

    async def _all_answer(self, client: RigClient) -> bool:
        states = await client.states()
        return all(name in states and states[name].link is LinkState.UP for name in self._machines)

    async def close(self) -> None:
        """End everything; what a test has left moving is halted as the configuration says."""
        for errand in tuple(self._errands):
            errand.cancel()
        if self._daemon:
            self._daemon.end()
        await self._ended()


@asynccontextmanager
async def simulated_rig(
    config: RigConfig | Path | str,
    *,
    seed: int | None = None,
    state: RigState | None = None,
    within_s: float | None = None,
) -> AsyncIterator[SimulatedRig]:
    """Rehearse on a rig until the context ends; its lines are up when the context begins.

    Ports become simulated lines, see `simulated_config`; nothing leaves the process, nothing is written.

    Args:
        config: the rig, or its file.
        seed: of everything that is drawn; the same seed gives the same bytes on the line.
        state: of the rig that it stands for, see `ldcnd.testing.twin`; where drives stand after their first power-up,
            when missing.
        within_s: longest time on the rig's clock; what is rehearsed is ended then. Without a bound when missing.

    Raises:
        ConfigError: the file is none of a rig, or of another rig than the state.
        NotSupported: the program does not run on the jumping clock.
        TimeoutError: it took longer; raised where the program is run.
    """
    loop = asyncio.get_running_loop()
    if not isinstance(loop, JumpingLoop):
        raise NotSupported(
            "a rehearsal needs the jumping clock, and this program runs on the wall clock",
            remedy="run it by ldcnd.testing.run, or as a test that asks for the fixture ldcnd_rig",
        )
    settings = simulated_config(loaded(config), seed=seed)
    if state:
        settings = config_of_twin(settings, state)
    broker = MemoryBroker()
    session = _ClientSession(broker)
    cut = (lambda _: setattr(session, "cut", True), lambda _: setattr(session, "cut", False))
    rig = SimulatedRig(settings, broker, lines_of(settings), BEGINS_NS, cut)
    async with AsyncExitStack() as stack:
        stack.push_async_callback(session.close)
        stack.push_async_callback(rig.close)
        stack.enter_context(loop.rehearsing(broker.session))
        stack.enter_context(on_clock(RigClock(loop.time, rig.wall_s, loop.hold_up)))
        if state:
            place(rig.machine, state)
        await rig.start_daemon(state)
        await rig.join(session)
        loop.ends_at_s = loop.time() + within_s if within_s else None
        stack.callback(setattr, loop, "ends_at_s", None)
        yield rig


def loaded(config: RigConfig | Path | str) -> RigConfig:
    """Return a rig; from its file, if that is given."""
    return config if isinstance(config, RigConfig) else load_config(Path(config))


def lines_of(config: RigConfig) -> dict[str, Chain]:
    """Make the simulated lines of a rig; their clock is that of the running loop."""
    simulated = {line.name: line for line in config.sim}
    now_s = asyncio.get_running_loop().time()
    return {bus.name: SIMULATED[bus.family].chain(simulated[bus.simulated], bus, now_s) for bus in config.bus}
