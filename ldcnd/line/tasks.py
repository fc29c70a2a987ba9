"""Tasks of which one that fails does not cancel the others: what stops one axis must not leave another one running."""

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, TypeVar

from typing_extensions import override

ResultT = TypeVar("ResultT")
Guarded = Callable[[Coroutine[Any, Any, Any]], Coroutine[Any, Any, None]]
"""Does the work of a task, and sees to what it raises."""


class GuardedGroup(asyncio.TaskGroup):
    """Tasks of which one that fails does not cancel the others."""

    def __init__(self, guarded: Guarded) -> None:
        """Begin without tasks.

        Args:
            guarded: does the work of a task; sees to what it raises.
        """
        super().__init__()
        self._guarded = guarded

    @override
    def create_task(  # type: ignore[override] # its stub names what differs between versions of Python
        self, coro: Coroutine[Any, Any, Any], **kwargs: Any
    ) -> "asyncio.Task[Any]":
        task = super().create_task(self._guarded(coro), **kwargs)
        task.add_done_callback(lambda _: coro.close())  # of one that is cancelled before it begins nothing is awaited
        return task


async def each(works: Mapping[str, Coroutine[Any, Any, ResultT]]) -> dict[str, ResultT]:
    """Carry out several pieces of work at once, begun in their order; return their results by the same names.

    Raises:
        BaseException: what the first one that failed has raised, once all of them are over.
    """
    results, failures = dict[str, ResultT](), list[BaseException]()

    async def done(name: str, work: Coroutine[Any, Any, ResultT]) -> None:
        try:
            results[name] = await work
        except (asyncio.CancelledError, GeneratorExit, KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # noqa: BLE001 - a panic is no Exception
            failures.append(error)

    async with asyncio.TaskGroup() as group:
        for name, work in works.items():
            group.create_task(done(name, work), name=name)
    if failures:
        raise failures[0]
    return results
