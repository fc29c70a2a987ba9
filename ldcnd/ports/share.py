"""The share of a line's time that a guest has: what asks without a pause leaves the rest to others."""

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

LINE_SHARE = 0.2
"""A guest that asks without a pause has so much of the line; others keep at least 0.7 of their polls."""


class LineShare:
    """Gives one guest its turns, one after another.

    Args:
        unpaused_s: time of the line that a guest which has paused may use without a pause, seconds.
        used_s: returns how much of the line's time its exchanges have taken, seconds; see `Bus.guests_s`.
    """

    def __init__(self, unpaused_s: float, used_s: Callable[[], float]) -> None:
        self._unpaused_s, self._used_s = unpaused_s, used_s
        self._loop = asyncio.get_running_loop()
        self._line, self._free_at_s = asyncio.Lock(), -math.inf

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait for the guest's turn; the context is what it does with the line."""
        async with self._line:
            await asyncio.sleep(max(0.0, self._free_at_s - self._loop.time()))
            before_s = self._used_s()
            try:
                yield
            finally:
                earned_s = max(self._free_at_s, self._loop.time() - self._unpaused_s / LINE_SHARE)
                self._free_at_s = earned_s + (self._used_s() - before_s) / LINE_SHARE
