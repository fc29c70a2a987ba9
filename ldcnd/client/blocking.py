"""The client for programs without an event loop: the same calls, each of which waits for its result.

Nothing is implemented twice: a call runs the asyncio client's own method on a loop in a thread of its own, and has its
arguments, its result and its errors. Safe to use from several threads.
"""

import asyncio
import concurrent.futures
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import AbstractAsyncContextManager, contextmanager
from functools import wraps
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

from ldcnd.client import connecting, events, lease, progress
from ldcnd.client.fleet import RigReport, survey
from ldcnd.client.rig_client import RigClient
from ldcnd.client.traces import Trace, take_trace
from ldcnd.messaging.zenoh_session import open_zenoh_session
from ldcnd.messaging.zenoh_settings import ZenohSettings
from ldcnd.model.commands import CommandReply
from ldcnd.model.events import CommandEvent
from ldcnd.model.samples import Sample
from ldcnd.model.traces import TakeTrace

P = ParamSpec("P")
ResultT = TypeVar("ResultT")
WrappedT = TypeVar("WrappedT")


class _Loop:
    """An event loop in a thread."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop

    # Any: what a coroutine yields and is sent is nobody's business but the loop's
    def run(self, work: Coroutine[Any, Any, ResultT]) -> ResultT:
        """Run a coroutine to its end; an interrupted wait cancels it."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    @contextmanager
    def inside(self, context: AbstractAsyncContextManager[ResultT]) -> Iterator[ResultT]:
        """Stay inside an asyncio context; one task enters and leaves it, as task groups want it."""
        entered: concurrent.futures.Future[ResultT] = concurrent.futures.Future()
        leaving = asyncio.Event()

        async def stay() -> None:
            async with context as value:
                entered.set_result(value)
                await leaving.wait()

        staying = asyncio.run_coroutine_threadsafe(stay(), self._loop)
        try:
            first: set[concurrent.futures.Future[Any]] = {entered, staying}
            concurrent.futures.wait(first, return_when=concurrent.futures.FIRST_COMPLETED)
            if not entered.done():
                staying.result()  # raises why it could not be entered
            yield entered.result()
        finally:
            self._loop.call_soon_threadsafe(leaving.set)
            staying.result()

    def each(self, items: AsyncIterator[ResultT]) -> Iterator[ResultT]:
        """Yield what an asyncio iterator yields."""

        async def following() -> tuple[ResultT, ...]:
            async for item in items:
                return (item,)
            return ()

        while item := self.run(following()):
            yield item[0]


class Facade(Generic[WrappedT]):
    """What the facades have in common: an object of the asyncio client, and the loop that it lives on."""

    def __init__(self, loop: _Loop, wrapped: WrappedT) -> None:
        self._loop = loop
        self._wrapped = wrapped


def _waiting(
    method: Callable[Concatenate[WrappedT, P], Coroutine[Any, Any, ResultT]],
) -> Callable[Concatenate[Facade[WrappedT], P], ResultT]:
    """Return a method that waits for the result of another one."""

    @wraps(method)
    def call(facade: Facade[WrappedT], /, *args: P.args, **kwargs: P.kwargs) -> ResultT:
        return facade._loop.run(method(facade._wrapped, *args, **kwargs))  # noqa: SLF001 - the facade is ours

    return call


class Control(Facade[lease.Control]):
    """See `ldcnd.client.lease.Control`; the lease is renewed in the background."""

    command = _waiting(lease.Control.command)


class Rig(Facade[RigClient]):
    """See `ldcnd.client.rig_client.RigClient`; made by `open_rig`."""

    daemon = _waiting(RigClient.daemon)
    axes = _waiting(RigClient.axes)
    buses = _waiting(RigClient.buses)
    line_plan = _waiting(RigClient.line_plan)
    command_list = _waiting(RigClient.command_list)
    last = _waiting(RigClient.last)
    last_published = _waiting(RigClient.last_published)
    descriptions = _waiting(RigClient.descriptions)
    monitors = _waiting(RigClient.monitors)
    state = _waiting(RigClient.state)
    states = _waiting(RigClient.states)
    faults = _waiting(RigClient.faults)
    last_health = _waiting(RigClient.last_health)
    last_bus_health = _waiting(RigClient.last_bus_health)
    command = _waiting(RigClient.command)
    why = _waiting(RigClient.why)
    plan = _waiting(RigClient.plan)
    stop = _waiting(RigClient.stop)
    wait_for_end = _waiting(RigClient.wait_for_end)

    @contextmanager
    def control(self, name: str, *axes: str, lease_s: float = 1.0, force: bool = False) -> Iterator[Control]:
        """See `ldcnd.client.lease.control`."""
        held = lease.control(self._wrapped, name, *axes, lease_s=lease_s, force=force)
        with self._loop.inside(held) as control:
            yield Control(self._loop, control)

    @contextmanager
    def samples(self, axis: str = "*", item: str = "*") -> Iterator[Iterator[tuple[str, Sample]]]:
        """See `RigClient.samples`."""
        with self._loop.inside(self._wrapped.samples(axis, item)) as samples:
            yield self._loop.each(samples)

    @contextmanager
    def follow(self, command: CommandReply) -> Iterator[Iterator[progress.Progress]]:
        """See `ldcnd.client.progress.follow`; the iteration ends with the command."""
        with self._loop.inside(progress.follow(self._wrapped, command)) as motion:
            yield self._loop.each(motion)

    @contextmanager
    def events(self, axis: str | None = None, *, history: bool = False) -> Iterator[Iterator[CommandEvent]]:
        """See `ldcnd.client.events.follow_events`."""
        with self._loop.inside(events.follow_events(self._wrapped, axis, history=history)) as following:
            yield self._loop.each(following)

    def take_trace(self, axis: str, request: TakeTrace, within_s: float) -> Trace:
        """See `ldcnd.client.traces.take_trace`."""
        return self._loop.run(take_trace(self._wrapped, axis, request, within_s))


@contextmanager
def open_rig(settings: ZenohSettings, rig: str | None = None) -> Iterator[Rig]:
    """See `ldcnd.client.connecting.open_rig`."""
    with _running_loop() as loop, loop.inside(connecting.open_rig(settings, rig)) as client:
        yield Rig(loop, client)


def fleet(settings: ZenohSettings, rig: str | None = None) -> tuple[RigReport, ...]:
    """See `ldcnd.client.fleet.survey`."""
    with _running_loop() as loop, loop.inside(open_zenoh_session(settings)) as session:
        return loop.run(survey(session, rig))


@contextmanager
def _running_loop() -> Iterator[_Loop]:
    """Run an event loop in a thread for as long as the context lasts."""
    running: concurrent.futures.Future[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = concurrent.futures.Future()

    async def stay() -> None:
        ending = asyncio.Event()
        running.set_result((asyncio.get_running_loop(), ending))
        await ending.wait()

    thread = threading.Thread(target=lambda: asyncio.run(stay()), name="ldcnd client")
    thread.start()
    loop, ending = running.result()
    try:
        yield _Loop(loop)
    finally:
        loop.call_soon_threadsafe(ending.set)
        thread.join()
