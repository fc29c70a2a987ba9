"""Programs without an event loop on the jumping clock: in a thread, whose waits jump with the clock of the rig.

The clock stands while the thread computes and goes on while it waits for the client or in `time.sleep`, so that such a
program is as repeatable as one of asyncio. What it gives to `asyncio.run` runs on the rig's own loop. What it waits for
by other means takes real time, and none on the rig.
"""

import asyncio
import concurrent.futures
import contextvars
import runpy
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ParamSpec, SupportsIndex, TypeVar, cast

from typing_extensions import override

from ldcnd.client.loop_thread import LENT, LoopThread
from ldcnd.testing.jumping_loop import JumpingLoop

P = ParamSpec("P")
ResultT = TypeVar("ResultT")


class ProgramFailed(Exception):
    """A rehearsed program has ended with a status that says so."""


class PacedLoop(LoopThread):
    """The rig's loop as a program in another thread sees it: while the program waits, and only then, time passes."""

    def __init__(self, loop: JumpingLoop) -> None:
        super().__init__(loop)
        self._clock = loop

    @override
    def wait(self, *futures: concurrent.futures.Future[Any]) -> None:
        """Wait until one of them is done; the clock stands again from that very instant on."""
        over = threading.Event()

        def end(_: concurrent.futures.Future[Any]) -> None:
            if not over.is_set():
                self._clock.hold(+1)
                over.set()

        def begin() -> None:  # on the loop, where the work ends as well: neither passes the other by
            self._clock.hold(-1)
            for future in futures:
                future.add_done_callback(end)

        self.call(begin)
        over.wait()

    def now_s(self) -> float:
        """Return what the clock shows, in seconds."""
        return self._clock.time()


@dataclass(frozen=True, slots=True)
class RigClock:
    """What `time` shows in a thread whose program is rehearsed.

    Attributes:
        monotonic: seconds of the rig's clock.
        wall: seconds since 1970 on the rig.
        sleep: lets so many seconds pass.
        loop: on which `asyncio.run` runs what it gets; None where a loop runs already.
    """

    monotonic: Callable[[], float]
    wall: Callable[[], float]
    sleep: Callable[[float], object]
    loop: PacedLoop | None = None


_sleep, _monotonic, _time, _run = time.sleep, time.monotonic, time.time, asyncio.run
_clocks: dict[int, RigClock] = {}
"""Of the threads whose programs are rehearsed now."""
_changing = threading.Lock()


def _sleep_here(seconds: float | SupportsIndex) -> None:
    clock = _clocks.get(threading.get_ident())
    if clock is None:
        _sleep(seconds)
    else:
        clock.sleep(float(seconds))


def _monotonic_here() -> float:
    clock = _clocks.get(threading.get_ident())
    return clock.monotonic() if clock else _monotonic()


def _time_here() -> float:
    clock = _clocks.get(threading.get_ident())
    return clock.wall() if clock else _time()


# Any: as asyncio declares it
def _run_here(
    main: Coroutine[Any, Any, ResultT], *, debug: bool | None = None, loop_factory: Callable[[], Any] | None = None
) -> ResultT:
    clock = _clocks.get(threading.get_ident())
    if clock and clock.loop:
        return clock.loop.run(main)
    with asyncio.Runner(debug=debug, loop_factory=loop_factory) as runner:
        return runner.run(main)


@contextmanager
def on_clock(clock: RigClock) -> Iterator[None]:
    """Show the clock of a rig in this thread: `time.time`, `time.monotonic`, `time.sleep`; others keep theirs."""
    me = threading.get_ident()
    with _changing:
        before = _clocks.get(me)
        _clocks[me] = clock
        time.sleep, time.monotonic, time.time = _sleep_here, _monotonic_here, _time_here
        asyncio.run = _run_here
    try:
        yield
    finally:
        with _changing:
            if before:
                _clocks[me] = before
            else:
                del _clocks[me]
            if not _clocks:
                time.sleep, time.monotonic, time.time, asyncio.run = _sleep, _monotonic, _time, _run


async def run_in_thread(
    loop: JumpingLoop, wall_s: Callable[[], float], program: Callable[P, ResultT], *args: P.args, **kwargs: P.kwargs
) -> ResultT:
    """Run a program without an event loop to its end; see `SimulatedRig.run_blocking`.

    Args:
        loop: the rig's.
        wall_s: the rig's wall clock, seconds since 1970.
        program: what is run.
        args: of the program.
        kwargs: of the program.
    """
    paced, ended = PacedLoop(loop), cast("asyncio.Future[ResultT]", loop.create_future())
    context = contextvars.copy_context()
    context.run(LENT.set, paced)

    def end(outcome: Callable[[], None]) -> None:
        loop.hold(-1)
        if not ended.done():
            outcome()

    def live() -> None:
        with on_clock(RigClock(paced.now_s, wall_s, lambda seconds: paced.run(asyncio.sleep(seconds)), paced)):
            try:
                outcome = partial(ended.set_result, context.run(program, *args, **kwargs))
            except BaseException as error:  # noqa: BLE001 - it is raised where the program is waited for
                outcome = partial(ended.set_exception, error)
            finally:
                paced.close()
        paced.call(end, outcome)

    loop.hold(+1)
    # a daemon: a program that waits for what never comes does not keep pytest from ending
    threading.Thread(target=live, name="blocking program", daemon=True).start()
    return await ended


def run_file(file: Path, arguments: Sequence[str]) -> None:
    """Run a Python program as `python FILE ARGUMENTS` does, in this process.

    Args:
        file: of the program.
        arguments: of its command line.

    Raises:
        ProgramFailed: it exited with another status than 0; other exceptions of it pass.
    """
    before, sys.argv = sys.argv, [str(file), *arguments]
    sys.path.insert(0, str(file.parent))  # its neighbours are there, as for Python itself
    try:
        runpy.run_path(str(file), run_name="__main__")
    except SystemExit as error:  # asyncio would end the whole process
        if error.code not in (None, 0):
            raise ProgramFailed(f"{file} exited with {error.code}") from error
    finally:
        sys.argv = before
        sys.path.remove(str(file.parent))
