"""Worker threads for calls that may block on the network, kept off the event loop.

Not a ThreadPoolExecutor: its threads are joined when the interpreter exits, and one that is stuck in a foreign library
would keep the process from ending.
"""

import asyncio
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import TypeVar

ResultT = TypeVar("ResultT")

QUEUED_JOBS = 1024
"""`is_full` beyond this; whoever can make any number of jobs must ask."""

Job = Callable[[], None]


class Workers:
    """A few threads that carry out jobs in the order in which they come."""

    def __init__(self, name: str, count: int) -> None:
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._count = count
        self._stopping = False
        self._ended: list[Future[None]] = []
        for number in range(count):
            ended: Future[None] = Future()
            # a running future cannot be cancelled by those who wait for it
            ended.set_running_or_notify_cancel()
            self._ended.append(ended)
            threading.Thread(target=self._work, args=(ended,), name=f"{name} {number}", daemon=True).start()

    @property
    def is_full(self) -> bool:
        """Whether so much waits that avoidable jobs should be dropped."""
        return self._jobs.qsize() >= QUEUED_JOBS

    def submit(self, job: Job) -> None:
        """Have a job done that must not raise. Any thread, never blocks."""
        self._jobs.put(job)

    async def run(self, work: Callable[[], ResultT], timeout_s: float, undo: Callable[[ResultT], None]) -> ResultT:
        """Have work done and return its result.

        Args:
            work: may block, and raise.
            timeout_s: for how long it may.
            undo: takes the result, on a worker, if it comes after the caller has given up.

        Raises:
            TimeoutError: the work is not done in time.
        """
        future: Future[ResultT] = Future()
        self.submit(partial(_carry_out, work, future))
        try:
            async with asyncio.timeout(timeout_s):
                return await asyncio.wrap_future(future)
        except (TimeoutError, asyncio.CancelledError):
            future.add_done_callback(partial(self._undo, undo))
            raise

    async def stop(self, timeout_s: float) -> bool:
        """Finish the jobs there are, take no more, and tell whether that was done in time; safe to call twice."""
        if not self._stopping:
            self._stopping = True
            for _ in range(self._count):
                self._jobs.put(None)
        try:
            async with asyncio.timeout(timeout_s):
                for ended in self._ended:
                    await asyncio.wrap_future(ended)
        except TimeoutError:
            return False
        return True

    def _undo(self, undo: Callable[[ResultT], None], future: Future[ResultT]) -> None:
        if future.cancelled() or future.exception() is not None:
            return
        if self._stopping:
            # nobody takes jobs any more, and this is the worker that has just done the work
            undo(future.result())
        else:
            self.submit(partial(undo, future.result()))

    def _work(self, ended: Future[None]) -> None:
        try:
            while job := self._jobs.get():
                job()
                # what the job holds must not live until the next one comes
                del job
        finally:
            ended.set_result(None)


def _carry_out(work: Callable[[], ResultT], future: Future[ResultT]) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        result = work()
    except BaseException as error:  # noqa: BLE001 - a future carries any exception of its work
        future.set_exception(error)
    else:
        future.set_result(result)
