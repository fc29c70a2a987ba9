"""Threads for calls that may hang, in a driver or on a disk: one for each of those who must not wait for each other.

Not a ThreadPoolExecutor: its threads are joined when the interpreter exits, and those of the loop's own pool when the
loop ends, so that one call that hangs would keep the process from ending.
"""

import asyncio
import queue
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any, ParamSpec, TypeVar

from typing_extensions import override

P = ParamSpec("P")
ResultT = TypeVar("ResultT")

Calls = queue.SimpleQueue[Callable[[], None] | None]


class OwnThread(Executor):
    """One thread that carries out calls in the order in which they come; it ends when nobody refers to this any more.

    Args:
        name: of the thread.
    """

    def __init__(self, name: str) -> None:
        self._calls: Calls = queue.SimpleQueue()
        # it knows the queue alone, so that it keeps nothing alive
        threading.Thread(target=_serve, args=(self._calls,), name=name, daemon=True).start()
        weakref.finalize(self, self._calls.put, None)

    @override
    def submit(self, fn: Callable[P, ResultT], /, *args: P.args, **kwargs: P.kwargs) -> Future[ResultT]:
        """Have a call carried out behind those before it."""
        future: Future[ResultT] = Future()
        self._calls.put(partial(_carry_out, future, partial(fn, *args, **kwargs)))
        return future

    async def run(self, work: Callable[[], ResultT], within_s: float) -> ResultT:
        """Have work done and return its result.

        Raises:
            TimeoutError: it is not done within so many seconds; a thread cannot be cancelled, so it goes on, and what
                comes later is done behind it.
        """
        future = asyncio.get_running_loop().run_in_executor(self, work)
        async with asyncio.timeout(within_s):
            return await asyncio.shield(future)


def _serve(calls: Calls) -> None:
    while call := calls.get():
        call()
        del call  # what it holds must not live until the next one comes


def _carry_out(future: Future[Any], call: Callable[[], Any]) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        result = call()
    except BaseException as error:  # noqa: BLE001 - a future carries any exception of its work
        future.set_exception(error)
    else:
        future.set_result(result)
