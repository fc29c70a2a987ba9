"""One deadline of a line that is moved later for each exchange, at the cost of an assignment."""

import asyncio
from collections.abc import Callable

from ldcnd.line.exchange import NEVER_S


class Watchdog:
    """Calls back once the deadline has passed.

    Moving the deadline later costs an assignment: the timer fires at the old time, compares, and is set again. So a
    line that answers in time creates a few timers a second, not one per exchange.
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
            self._timer = self._loop.call_at(at_s, self._check_deadline)

    def cancel(self) -> None:
        """Cancel the deadline and the timer."""
        self._deadline_s = self._timer_at_s = NEVER_S
        if self._timer:
            self._timer.cancel()
            self._timer = None

    def _check_deadline(self) -> None:
        self._timer, self._timer_at_s = None, NEVER_S
        now_s = self._loop.time()
        if now_s >= self._deadline_s:
            self._deadline_s = NEVER_S
            self._expired(now_s)
        elif self._deadline_s < NEVER_S:
            self.set(self._deadline_s)
