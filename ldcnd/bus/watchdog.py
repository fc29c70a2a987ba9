"""One deadline that moves all the time, watched by one timer that rarely does."""

import asyncio
from collections.abc import Callable

NEVER_S = float("inf")


class Watchdog:
    """Calls back once the deadline has passed.

    Moving the deadline later costs an assignment: the timer fires at the old time, looks, and sleeps on. So a line
    that answers in time creates a few timers a second, not one per exchange.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, expired: Callable[[float], None]) -> None:
        self._loop = loop
        self._expired = expired
        self._deadline_s = NEVER_S
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at_s = NEVER_S

    @property
    def deadline_s(self) -> float:
        """The deadline, in loop time; infinity when there is none."""
        return self._deadline_s

    def set(self, at_s: float) -> None:
        """Move the deadline, in loop time; infinity for none."""
        self._deadline_s = at_s
        if at_s < self._timer_at_s:
            if self._timer:
                self._timer.cancel()
            self._timer_at_s = at_s
            self._timer = self._loop.call_at(at_s, self._look)

    def cancel(self) -> None:
        """Forget the deadline and the timer."""
        self._deadline_s = self._timer_at_s = NEVER_S
        if self._timer:
            self._timer.cancel()
            self._timer = None

    def _look(self) -> None:
        self._timer, self._timer_at_s = None, NEVER_S
        now_s = self._loop.time()
        if now_s >= self._deadline_s:
            self._deadline_s = NEVER_S
            self._expired(now_s)
        elif self._deadline_s < NEVER_S:
            self.set(self._deadline_s)
