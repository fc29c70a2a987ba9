"""An event loop in a thread of its own, for programs that wait and for those that have another loop already."""

import asyncio
import concurrent.futures
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import AbstractAsyncContextManager, ExitStack, contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar, TypeVarTuple

ResultT = TypeVar("ResultT")
ArgumentsT = TypeVarTuple("ArgumentsT")


class LoopThread:
    """An event loop that runs in a thread; made by `loop_thread`. Every method may be called from any other thread."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._left_open = ExitStack()

    # Any: what a coroutine yields and is sent concerns the loop only
    def start(self, work: Coroutine[Any, Any, ResultT]) -> concurrent.futures.Future[ResultT]:
        """Run a coroutine without waiting for it; cancelling the future cancels it."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def call(self, callback: Callable[[*ArgumentsT], object], *args: *ArgumentsT) -> None:
        """Call a function on the loop, soon, without waiting for it."""
        self._loop.call_soon_threadsafe(callback, *args)

    def run(self, work: Coroutine[Any, Any, ResultT]) -> ResultT:
        """Run a coroutine to its end; an interrupted wait cancels it.

        Raises:
            RuntimeError: this is the loop's own thread, which would wait for itself.
        """
        if self.is_here():
            work.close()
            raise RuntimeError("this thread would wait for itself: what is called by the client cannot wait for it")
        future = self.start(work)
        try:
            self.wait(future)
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def is_here(self) -> bool:
        """Tell whether this is the loop's own thread, which can wait for nothing that runs on it."""
        try:
            return asyncio.get_running_loop() is self._loop
        except RuntimeError:
            return False

    def wait(self, *futures: concurrent.futures.Future[Any]) -> None:
        """Wait until one of them is done."""
        concurrent.futures.wait(futures, return_when=concurrent.futures.FIRST_COMPLETED)

    def close_later(self, close: Callable[[], object]) -> None:
        """Call something when the program ends to which this loop is lent."""
        self._left_open.callback(close)

    def close(self) -> None:
        """Close what the program has left open."""
        self._left_open.close()

    @contextmanager
    def inside(self, context: AbstractAsyncContextManager[ResultT]) -> Iterator[ResultT]:
        """Stay inside an asyncio context; one task enters and leaves it, as task groups want it.

        An exception that leaves this one leaves the other as an interrupt does, whatever it is: an asyncio program is
        interrupted by being cancelled, and a loop outlives neither KeyboardInterrupt nor SystemExit.
        """
        entered: concurrent.futures.Future[ResultT] = concurrent.futures.Future()
        leaving, interrupted = asyncio.Event(), False

        async def stay() -> None:
            async with context as value:
                entered.set_result(value)
                await leaving.wait()
                if interrupted:
                    raise asyncio.CancelledError

        staying = asyncio.run_coroutine_threadsafe(stay(), self._loop)
        try:
            self.wait(entered, staying)
            if not entered.done():
                staying.result()  # raises why it could not be entered
            yield entered.result()
        except BaseException:
            interrupted = True
            raise
        finally:
            self._loop.call_soon_threadsafe(leaving.set)
            self.wait(staying)
            if not (interrupted and staying.cancelled()):
                staying.result()

    def each(self, items: AsyncIterator[ResultT]) -> Iterator[ResultT]:
        """Yield what an asyncio iterator yields."""

        async def following() -> tuple[ResultT, ...]:
            async for item in items:
                return (item,)
            return ()

        while item := self.run(following()):
            yield item[0]


LENT: ContextVar[LoopThread | None] = ContextVar("LENT", default=None)
"""A loop that runs already, and that this program uses in place of one of its own: a rehearsal lends its own."""


@contextmanager
def loop_thread() -> Iterator[LoopThread]:
    """Run an event loop in a thread for as long as the context lasts, or use the one that is lent.

    Raises:
        OSError: there can be no loop, such as without a file descriptor left.
    """
    if lent := LENT.get():
        yield lent
        return
    running: concurrent.futures.Future[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = concurrent.futures.Future()

    async def stay() -> None:
        ending = asyncio.Event()
        running.set_result((asyncio.get_running_loop(), ending))
        await ending.wait()

    def live() -> None:
        try:
            with asyncio.Runner() as runner:
                runner.get_loop()  # before there is a coroutine that would never run
                runner.run(stay())
        except BaseException as error:
            if running.done():
                raise
            running.set_exception(error)

    # a daemon: the end of a program that has left it open waits for no thread but closes it, see `blocking.Opened`
    thread = threading.Thread(target=live, name="ldcnd client", daemon=True)
    thread.start()
    loop, ending = running.result()
    try:
        yield LoopThread(loop)
    finally:
        loop.call_soon_threadsafe(ending.set)
        thread.join()
