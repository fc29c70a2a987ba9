"""The contract between a line and the bus that it serves."""

from typing import Protocol

from ldcnd.bus.turn import Turn


class Users(Protocol):
    """Whom the line serves: the bus, with its queue and its knowledge of the nodes."""

    def take(self, now_s: float) -> Turn | None:
        """Remove and return the next turn, or None when nothing is due."""

    def sent(self, turn: Turn) -> None:
        """Note that a turn that was taken is on the wire."""

    def look_ahead(self, turn: Turn, asked_at_s: float) -> None:
        """Make ready what can be made ready of the next turn, while there is time.

        Args:
            turn: on the wire.
            asked_at_s: when the last bit of its request leaves, in loop time.
        """

    def next_due_s(self) -> float:
        """Return when something will be due, in loop time."""

    def stop_waits(self) -> bool:
        """Tell whether a stop is queued."""

    def failing(self) -> set[int]:
        """Return the nodes that left their last exchange unanswered."""

    def answered(self, turn: Turn) -> None:
        """Note that the turn's node replied, or that no reply was due."""

    def missed(self, turn: Turn, now_s: float) -> None:
        """Note that the turn's node did not reply, before the turn learns of it."""

    def again(self, turn: Turn) -> None:
        """Give the turn back to the front of its lane."""

    def line_lost(self, reason: str) -> None:
        """Learn, once, that the line is gone and every turn that was on it has heard of it."""
