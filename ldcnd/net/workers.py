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

Job = Callable[[], None]


class Workers:
    """Threads that carry out jobs in the order in which they come.

    A job that blocks keeps its thread; the next one has another thread, so jobs wait for blocked ones only when there
    are as many of these as there may be threads.

    Args:
        name: of the threads.
        most: how many threads there may be; each is started for the first job that finds none idle.
    """

    def __init__(self, name: str, most: int) -> None:
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._name = name
        self._most = most
        self._free = 0
        """Threads for which no job waits."""
        self._backlog = 0
        """Jobs that wait for any thread to come free."""
        self._stopping = False
        self._ended: list[Future[None]] = []
        # re-entrant: what is collected while this thread counts may submit a job
        self._lock = threading.RLock()

    @property
    def waiting(self) -> int:
        """How many jobs no thread has begun."""
        return self._jobs.qsize()

    def submit(self, job: Job) -> None:
        """Have a job done that must not raise. Any thread, never blocks."""
        ended: Future[None] | None = None
        with self._lock:
            # in the lock, so that `stop` puts its marks behind every job that was taken
            self._jobs.put(job)
            if self._free:
                self._free -= 1
            elif len(self._ended) < self._most and not self._stopping:
                ended = Future()
                # a running future cannot be cancelled by those who wait for it
                ended.set_running_or_notify_cancel()
                self._ended.append(ended)
            else:
                self._backlog += 1
        if ended:
            try:
                threading.Thread(target=self._work, args=(ended,), name=self._name, daemon=True).start()
            except RuntimeError:  # no memory for one more: another one takes the job, or the next that starts
                with self._lock:
                    self._ended.remove(ended)
                    self._backlog += 1

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
        # also of a caller that was cancelled: what comes into being meanwhile would be nobody's
        except (TimeoutError, asyncio.CancelledError):
            future.add_done_callback(partial(self._undo, undo))
            raise

    async def stop(self, timeout_s: float) -> bool:
        """Finish the jobs there are, take no more, and tell whether that was done in time; safe to call twice."""
        with self._lock:
            if not self._stopping:
                self._stopping = True
                for _ in self._ended:
                    # one for each thread: who has taken its own takes nothing more
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
            # no worker takes jobs any more, and this is the worker that has just done the work
            undo(future.result())
        else:
            self.submit(partial(undo, future.result()))

    def _work(self, ended: Future[None]) -> None:
        try:
            while job := self._jobs.get():
                try:
                    job()
                except BaseException:  # noqa: BLE001 - a panic in Zenoh is no Exception; who waits is not to blame for it
                    from ldcnd.log import get_logger  # noqa: PLC0415 - what only asks loads no log

                    get_logger("workers").exception("bug on a worker thread", thread=self._name)
                # what the job holds must not live until the next one comes
                del job
                with self._lock:
                    if self._backlog:
                        self._backlog -= 1
                    else:
                        self._free += 1
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
