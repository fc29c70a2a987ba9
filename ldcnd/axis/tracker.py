"""Holds the status of one axis: takes events, and tells those who look on what has changed."""

from collections.abc import Callable

from ldcnd.axis.events import AxisEvent, ReadingTaken
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
        status: as of now.
        reading: the latest; None before the first.
        proof: that who answers is its drive.
    """

    def __init__(self, status: AxisStatus, proof: Proof) -> None:
        self.status = status
        self.reading: AxisReading | None = None
        self.proof = proof
        self._watching: tuple[tuple[tuple[str, ...], OnChange], ...] = ()

    @property
    def name(self) -> str:
        """The name of the axis."""
        return self.status.name

    def watch(self, on_change: OnChange, *fields: str) -> None:
        """Have changes of these fields of the status told, to one listener after the other."""
        self._watching = (*self._watching, (fields, on_change))

    def take(self, event: AxisEvent) -> AxisStatus:
        """Take an event; return the status after it."""
        before = self.status
        after = STEPS[type(event)](before, event)
        if after is not before:
            self.status = after
            for fields, on_change in self._watching:
                if any(getattr(after, name) is not getattr(before, name) for name in fields):
                    on_change(before, after)
        return after

    def observe(self, reading: AxisReading, timing: Timing, now_ns: int) -> AxisStatus:
        """Take a reading that was accepted; return the status after it.

        Args:
            reading: what the drive shows.
            timing: of its exchange.
            now_ns: when it was true, UTC.
        """
        self.reading = reading
        return self.take(ReadingTaken(reading, timing.sent_at_s, now_ns))

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
