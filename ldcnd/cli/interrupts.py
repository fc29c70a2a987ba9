"""Ctrl-C while a command has work to do: each one cancels that, and none breaks into what it does at its end."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from ldcnd.parts import on_signals

ResultT = TypeVar("ResultT")


def run(work: Callable[[], Coroutine[Any, Any, ResultT]]) -> ResultT:
    """Run the work of a command on a loop of its own, as `asyncio.run`, whose second Ctrl-C would fail the loop itself.

    Here each one cancels the work once more; what has to be finished goes on behind that, such as a halt.

    Raises:
        KeyboardInterrupt: it was interrupted, and did not end otherwise.
    """
    interrupted = False

    async def within() -> ResultT:
        task = asyncio.current_task()
        assert task is not None  # noqa: S101 - a coroutine that runs is a task's

        def interrupt() -> None:
            nonlocal interrupted
            interrupted = True
            if not task.cancel():  # it has ended, and what is left may be a thread that does not
                raise KeyboardInterrupt

        on_signals(interrupt, "SIGINT")
        return await work()

    try:
        return asyncio.run(within())
    except asyncio.CancelledError:
        if interrupted:
            raise KeyboardInterrupt from None
        raise
