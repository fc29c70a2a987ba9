"""An event loop whose clock jumps to its next timer instead of waiting, and that reports a deadlock as an error.

For everything that stays inside the process: the daemon, the simulated line, a capture that is played back, the memory
session. Not for real Zenoh, ptys or sockets: their bytes would arrive after the clock has jumped past every deadline.
The clock counts whole nanoseconds, as the kernel's does, so that an instant survives being written down.
"""

import asyncio
import heapq
import math
import selectors
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractAsyncContextManager, contextmanager
from contextvars import Context
from itertools import count
from typing import Any

from ldcnd.net.session import REHEARSALS, Session

NS_PER_S = 1e9
NEXT_TO_S = 1e-10
LONGEST_NAP_S = 0.5
"""Where the next known instant is farther away, a timer is on time."""


class Happening:
    """Something that comes from outside at a given instant, until it is cancelled."""

    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback: Callable[[], None] | None = callback

    def cancel(self) -> None:
        """Let it not come; safe to call twice and too late."""
        self.callback = None


class _JumpingSelector(selectors.SelectSelector):
    """Never waits: with nothing ready, the clock moves on to the next timer or arrival.

    Attributes:
        poked: the loop's own pipe was written to; as long as it was not, and nothing else is watched, nothing is ready.
        signalled: signals write to that pipe too.
        held: number of threads that run and may still ask for something now: the clock stands while there is one.
    """

    def __init__(self, now_s: float, awake_at_s: Sequence[float]) -> None:
        super().__init__()
        self.poked = True
        self.signalled = False
        self.held = 0
        self.now_s = now_s
        self.awake_at_s = sorted(awake_at_s)
        self.arrivals: list[tuple[float, int, Happening]] = []

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready: list[tuple[selectors.SelectorKey, int]] = []
        if self.poked or self.signalled or timeout is None or len(self.get_map()) > 1:
            self.poked = False
            ready = super().select(0)
        if ready or (timeout is not None and timeout <= 0):
            return ready
        if self.held:
            return super().select(LONGEST_NAP_S)
        while self.arrivals and self.arrivals[0][2].callback is None:
            heapq.heappop(self.arrivals)
        if timeout is None and not self.arrivals:
            raise RuntimeError("deadlock: nothing is ready and no timer is pending")
        timer_s = math.inf if timeout is None else self._awake_s(_whole_s(self.now_s + timeout))
        arrival_s = self.arrivals[0][0] if self.arrivals else math.inf
        self.now_s = max(self.now_s, min(timer_s, arrival_s))
        return ready

    def _awake_s(self, due_s: float) -> float:
        """Return when the process is awake next, from an instant on."""
        place = bisect_left(self.awake_at_s, due_s)
        awake_s = self.awake_at_s[place] if place < len(self.awake_at_s) else due_s
        return awake_s if awake_s - due_s < LONGEST_NAP_S else due_s


def _whole_s(at_s: float) -> float:
    """Return the whole nanosecond next to an instant that is meant to be one: timers are, the sum may be a bit off."""
    whole_s = round(at_s * NS_PER_S) / NS_PER_S
    return whole_s if abs(whole_s - at_s) < NEXT_TO_S else at_s


class JumpingLoop(asyncio.SelectorEventLoop):
    """A selector loop in virtual time.

    Args:
        starts_at_s: what its clock shows at first, in seconds.
        awake_at_s: the instants at which the process that is imitated is known to have been awake: timers
            come then, as late as they came there. None for a process that is never late.

    Attributes:
        network: opens a session of the network that programs on this loop join instead of any other; None for theirs.
        ends_at_s: what runs until its clock shows this is ended by an error; None without such a bound.
    """

    network: Callable[[], AbstractAsyncContextManager[Session]] | None = None

    ends_at_s: float | None = None

    def __init__(self, starts_at_s: float = 0.0, awake_at_s: Sequence[float] = ()) -> None:
        self._jumping = _JumpingSelector(starts_at_s, awake_at_s)
        self._numbers = count()
        super().__init__(self._jumping)
        self._clock_resolution = 1e-9

    def time(self) -> float:
        """Return virtual seconds."""
        return self._jumping.now_s

    def _write_to_self(self) -> None:
        """Wake the loop, from a thread or a signal handler: the next select is a real one."""
        super()._write_to_self()  # type: ignore[misc] # known to asyncio's loops, not to their types
        self._jumping.poked = True

    def add_signal_handler(  # type: ignore[override] # as below
        self,
        sig: int,
        callback: Callable[..., object],
        *args: Any,
    ) -> None:
        """Handle a signal: from now on every select is a real one, because a signal writes to the pipe by itself."""
        super().add_signal_handler(sig, callback, *args)
        self._jumping.signalled = True

    def hold(self, threads: int) -> None:
        """Let the clock stand for so many more threads, or for fewer; called on the loop's own thread."""
        self._jumping.held += threads

    @contextmanager
    def rehearsing(self, network: Callable[[], AbstractAsyncContextManager[Session]]) -> Iterator[None]:
        """Let programs on this loop join a network, and those on no other loop of this process join any."""
        self.network = network
        REHEARSALS.add(self)
        try:
            yield
        finally:
            REHEARSALS.discard(self)
            self.network = None

    def hold_up(self, duration_s: float) -> None:
        """Let time pass as if the callback that runs now had taken so long."""
        self._jumping.now_s = _whole_s(self._jumping.now_s + duration_s)

    def arrive_at(self, at_s: float, callback: Callable[[], None]) -> Happening:
        """Have something come from outside: like bytes at a port it goes before timers that are late."""
        arrival = Happening(callback)
        heapq.heappush(self._jumping.arrivals, (max(at_s, self.time()), next(self._numbers), arrival))
        return arrival

    def _process_events(self, event_list: list[tuple[selectors.SelectorKey, int]]) -> None:
        """Take what has come since the loop looked last, before it looks at its timers."""
        super()._process_events(event_list)  # type: ignore[misc] # known to asyncio's loops, not to their types
        if self.ends_at_s is not None and self.time() > self.ends_at_s:
            self.ends_at_s = None  # what is left to be done may take its time
            raise TimeoutError(
                "what was rehearsed has not ended: it waits for what never comes, or runs without an end"
            )
        arrivals = self._jumping.arrivals
        while arrivals and arrivals[0][0] <= self.time():
            _, _, arrival = heapq.heappop(arrivals)
            if arrival.callback:
                self.call_soon(arrival.callback)

    def call_at(  # type: ignore[override] # Python 3.11 has no way to say it as later versions do
        self,
        when: float,
        callback: Callable[..., object],
        *args: Any,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        """Set a timer, at the next whole nanosecond."""
        whole = round(when * NS_PER_S)
        while whole / NS_PER_S < when:  # once, or a little more often in a number that has no room for nanoseconds
            whole += 1
        return super().call_at(whole / NS_PER_S, callback, *args, context=context)

    def run_in_executor(  # type: ignore[override] # as above
        self,
        executor: Executor | None,
        func: Callable[..., Any],
        *args: Any,
    ) -> asyncio.Future[Any]:
        """Run at once: a thread's work takes no virtual time."""
        future: asyncio.Future[Any] = self.create_future()
        try:
            future.set_result(func(*args))
        except BaseException as error:  # noqa: BLE001 - a future carries any exception of its work
            future.set_exception(error)
        return future
