"""Events of what goes away and comes back: a line, an I/O module, a drive."""

import asyncio
from collections.abc import Callable

from ldcnd.contract.events import LINK_BACK, LINK_LOST, CommandStatus

Note = Callable[[str, CommandStatus, str, str | None], None]
"""Takes an event of it: verb, status, reason and code."""
STAYS_S = 1.0
"""Time for which it must answer before that is said, seconds; twice as long each time that it is soon lost again."""
LONGEST_S = 60.0
"""The longest such time: so a link that flaps for hours gives two events a minute at most."""


class LinkEvents:
    """Tells the loss and the return of one thing, once each however often its link flaps in between.

    Args:
        note: takes its events.
        what: it is, in the words of an event.
        code: of the page about its loss; None where a fault of its own tells that.
    """

    def __init__(self, note: Note, what: str, code: str | None) -> None:
        self._note = note
        self._what, self._code = what, code
        self._lost_at_s: float | None = None
        self._back_at_s = 0.0
        self._said_at_s = -LONGEST_S  # the first loss of all follows none
        self._stays_s = STAYS_S
        self._times = 0
        self._besides: dict[str, None] = {}
        self._due: asyncio.TimerHandle | None = None

    def lost(self, why: str = "") -> None:
        """Take note that it has stopped answering."""
        if self._lost_at_s is not None:
            if self._due:
                # it did not stay: its return is told once, with how often it was lost
                self._due.cancel()
                self._due, self._times = None, self._times + 1
            return
        now_s = asyncio.get_running_loop().time()
        again = now_s - self._said_at_s < LONGEST_S
        self._stays_s = min(2 * self._stays_s, LONGEST_S) if again else STAYS_S
        self._lost_at_s, self._times, self._besides = now_s, 1, {}
        if self._code:
            self._note(LINK_LOST, CommandStatus.FAILED, why or f"{self._what} does not answer", self._code)

    def back(self) -> None:
        """Take note that it answers; if it was lost, that is told once it has gone on to."""
        if self._lost_at_s is None or self._due:
            return
        loop = asyncio.get_running_loop()
        self._back_at_s = loop.time()
        self._due = loop.call_later(self._stays_s, self._say)

    def add(self, what: str) -> None:
        """Have something said with the return."""
        self._besides[what] = None

    def _say(self) -> None:
        now_s, lost_at_s = asyncio.get_running_loop().time(), self._lost_at_s or 0.0
        self._lost_at_s, self._due, self._said_at_s = None, None, now_s
        times = f", lost {self._times} times meanwhile" if self._times > 1 else ""
        reason = f"{self._what} answers again, {self._back_at_s - lost_at_s:.1f} s after its loss{times}"
        self._note(LINK_BACK, CommandStatus.DONE, "; ".join((reason, *self._besides)), None)
