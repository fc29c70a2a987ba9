"""A simulated rig in real time, on an endpoint: for programs in other processes, and in other languages."""

import os
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

from ldcnd.client.loop_thread import LoopThread, loop_thread
from ldcnd.config.rig import RigConfig
from ldcnd.contract.errors import NotSupported
from ldcnd.contract.keys import Keys
from ldcnd.net.session import OnSample, Session
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.testing.lines import simulated_config
from ldcnd.testing.rig import SimulatedRig, lines_of, loaded
from ldcnd.testing.run_report import RunReport, watch_run
from ldcnd.testing.twin import RigState, config_of_twin, place

ResultT = TypeVar("ResultT")

COARSE_MS = 300.0
"""Least margin of the deadlines of replies: simulated lines are paced by the timers of this process."""
CONNECT = "LDCND_CONNECT"
"""The variable in which programs find the endpoint of their rig."""


class ServedRig:
    """A rig in real time that other programs connect to; made by `served_rig`.

    Attributes:
        endpoint: of its daemon, as `ldcnd --connect` and `ldcnd.connect` take it.
        ports: links to the terminals for old programs, by name of the port; not those of the real rig.
    """

    def __init__(self, endpoint: str, ports: Mapping[str, Path], thread: LoopThread, rig: SimulatedRig) -> None:
        self.endpoint = endpoint
        self.ports = ports
        self._thread = thread
        self._rig = rig

    @property
    def environment(self) -> dict[str, str]:
        """The environment of a program that finds this rig without being told where it is."""
        return {**os.environ, CONNECT: self.endpoint}

    def watch(self, ended: Callable[[], Awaitable[object]]) -> RunReport:
        """Watch the rig until something has ended, and return the report of the run.

        Args:
            ended: is called on the rig's loop, and returns what is waited for.
        """

        async def watching() -> RunReport:
            return await watch_run(self._rig.client.client, ended())

        return self._thread.run(watching())

    def ask(self, question: Callable[[SimulatedRig], ResultT]) -> ResultT:
        """Return what a function says of the rig, or let it change something there; it must not wait.

            rig.ask(lambda rig: rig.faults.jam("x", at=7.5))
            rig.ask(lambda rig: rig.truth("x").position)

        Args:
            question: gets the rig, whose clock is the real one.
        """

        async def answer() -> ResultT:
            return question(self._rig)

        return self._thread.run(answer())

    def until(self, condition: Callable[[SimulatedRig], bool], within_s: float = 10.0) -> None:
        """Wait until something is so.

        Raises:
            TimeoutError: it was not within so many seconds.
        """
        self._thread.run(self._rig.until(lambda: condition(self._rig), within_s))


@contextmanager
def served_rig(
    config: RigConfig | Path | str,
    *,
    seed: int | None = None,
    endpoint: str | None = None,
    state: RigState | None = None,
) -> Iterator[ServedRig]:
    """Serve a simulated rig in real time until the context ends; its lines are up when the context begins.

    Args:
        config: the rig, or its file; see `simulated_config`.
        seed: of everything that is drawn.
        endpoint: on which it is served; one on the loopback interface that is free, when missing.
        state: of the rig that it stands for; where drives stand after their first power-up, when missing.

    Raises:
        ConfigError: the file is none of a rig, or of another rig than the state.
        TimeoutError: its lines do not come up.
    """
    real = loaded(config)
    settings = simulated_config(real, seed=seed)
    slow = (bus.model_copy(update={"margin_ms": max(bus.margin_ms, COARSE_MS)}) for bus in settings.bus)
    settings = settings.model_copy(update={"bus": tuple(slow)})
    if state:
        settings = config_of_twin(settings, state)
    endpoint = endpoint or f"tcp/127.0.0.1:{_free_port()}"
    with ExitStack() as stack:
        ports: dict[str, Path] = {}
        if real.port:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="ldcnd-")))
            ports = {port.name: folder / port.name for port in real.port}
            own = tuple(port.model_copy(update={"link": ports[port.name], "listen": None}) for port in real.port)
            settings = settings.model_copy(update={"port": own})
        thread = stack.enter_context(loop_thread())
        rig = stack.enter_context(thread.inside(_serving(settings, endpoint, state)))
        yield ServedRig(endpoint, ports, thread, rig)


@asynccontextmanager
async def _serving(config: RigConfig, endpoint: str, state: RigState | None) -> AsyncIterator[SimulatedRig]:
    def cannot(_: float) -> None:
        raise NotSupported("the clients of this rig are other programs", remedy="end their processes")

    rig = SimulatedRig(config, _Zenoh(config.rig, endpoint), lines_of(config), time.time_ns(), (cannot, cannot))
    async with AsyncExitStack() as stack:
        stack.push_async_callback(rig.close)
        if state:
            place(rig.machine, state)
        await rig.start_daemon(state)
        client = ZenohSettings(mode="client", connect=(endpoint,))
        await rig.join(await stack.enter_async_context(open_zenoh_session(client)))
        yield rig


class _Zenoh:
    """The network of a rig that listens on one endpoint; each of its daemons in turn."""

    def __init__(self, rig: str, endpoint: str) -> None:
        self._telemetry = Keys(rig).all_telemetry
        self._settings = ZenohSettings(listen=(endpoint,))

    @asynccontextmanager
    async def session(self, *, overhear: OnSample | None = None) -> AsyncIterator[Session]:
        """Join it."""
        async with open_zenoh_session(self._settings) as session:
            if overhear:
                await session.subscribe(self._telemetry, overhear)
            yield session


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
