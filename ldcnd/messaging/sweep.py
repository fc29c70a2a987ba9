"""Samples taken from a queue now and then, for those who take very many: waking up the loop for each costs far more."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar

ItemT = TypeVar("ItemT")


class Sweep(Generic[ItemT]):
    """Empties a queue periodically, on the loop.

    Args:
        loop: the loop.
        deliver: takes each item.
        period_s: how often the queue is emptied.
        most: so many items at a time; what is left comes next time, so that others get their turn.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, deliver: Callable[[ItemT], None], period_s: float, most: int
    ) -> None:
        self._loop = loop
        self._deliver = deliver
        self._period_s = period_s
        self._most = most
        self._timer: asyncio.TimerHandle | None = None

    def begin(self, take: Callable[[], ItemT | None]) -> None:
        """Empty the queue of which `take` returns the next item, or None when there is none."""
        self._timer = self._loop.call_later(self._period_s, self._empty, take)

    def close(self) -> None:
        """Deliver no more."""
        if self._timer:
            self._timer.cancel()

    async def end(self, take_back: Callable[[], Awaitable[None]]) -> None:
        """Deliver no more, then take the queue back: one that is gone cannot be asked."""
        self.close()
        await take_back()

    def _empty(self, take: Callable[[], ItemT | None]) -> None:
        self.begin(take)  # first, because `deliver` may close
        for _ in range(self._most):
            item = take()
            if item is None:
                return
            self._deliver(item)
