"""Holds the status of one axis: takes events, and tells those who look on what has changed."""

import math
from collections.abc import Callable

from ldcnd.axis.events import AxisEvent, ReadingTaken
from ldcnd.axis.reading_step import take_reading
from ldcnd.axis.status import AxisStatus
from ldcnd.axis.step import STEPS
from ldcnd.contract.errors import WrongState
from ldcnd.drives.driver import AxisReading
from ldcnd.line.exchange import Timing
from ldcnd.line.proof import Proof

OnChange = Callable[[AxisStatus, AxisStatus], None]
"""Takes the status before a change and the one after it."""


class AxisTracker:
    """The status of one axis, changed only by events.

    Attributes:
        name: of the axis.
        status: as of now.
        reading: the latest; None before the first.
        read_at_s: when it was requested, in loop time; of one in pieces the latest of them.
        earlier: the reading before it, and when that was requested.
        proof: that who answers is its drive.
    """

    def __init__(self, status: AxisStatus, proof: Proof) -> None:
        self.name = status.name
        self.status = status
        self.reading: AxisReading | None = None
        self.read_at_s = -math.inf
        self.earlier: tuple[AxisReading | None, float] = (None, -math.inf)
        self.proof = proof
        self._watching: tuple[tuple[str, OnChange], ...] = ()

    @property
    def proven_at_s(self) -> float:
        """When the oldest was requested of what tells state and rest in the latest reading, in loop time."""
        pieces = self.reading.pieces if self.reading else None
        return self.read_at_s - pieces.behind_s if pieces else self.read_at_s

    def watch(self, on_change: OnChange, *fields: str) -> None:
        """Have a function called for each of these fields of the status that has changed."""
        self._watching = (*self._watching, *((name, on_change) for name in fields))

    def take(self, event: AxisEvent) -> AxisStatus:
        """Take an event; return the status after it."""
        before = self.status
        after = STEPS[type(event)](before, event)
        if after is not before:
            self._change(before, after)
        return after

    def observe(self, reading: AxisReading, timing: Timing, now_ns: int) -> AxisStatus:
        """Take a reading that was accepted; return the status after it.

        Args:
            reading: what the drive shows.
            timing: of its exchange.
            now_ns: when it was true, UTC.
        """
        self.earlier = self.reading, self.read_at_s
        self.reading, self.read_at_s, before = reading, timing.sent_at_s, self.status
        after = take_reading(before, ReadingTaken(reading, timing.sent_at_s, now_ns, timing.true_until_s))
        if after is not before:  # most readings change nothing
            self._change(before, after)
        return after

    def _change(self, before: AxisStatus, after: AxisStatus) -> None:
        self.status = after
        for name, on_change in self._watching:
            if getattr(after, name) is not getattr(before, name):
                on_change(before, after)

    def latest(self) -> AxisReading:
        """Return the latest reading.

        Raises:
            WrongState: there is none yet.
        """
        if self.reading is None:
            raise WrongState(
                f"axis {self.name}: its position has not been read yet", axis=self.name, remedy="wait a moment"
            )
        return self.reading
