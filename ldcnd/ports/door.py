"""Where a program comes in to a port: what its terminal and its TCP address have in common."""

from collections.abc import Callable
from typing import Protocol


class Door(Protocol):
    """Where a program comes in.

    Attributes:
        take: called with what it has sent, and the rate at which it sends; None for the rate that its modules have.
        closed: called when it has gone.
    """

    take: Callable[[bytes, int | None], None]
    closed: Callable[[], None]

    def write(self, data: bytes) -> None:
        """Send to the program; what it does not read is lost."""

    def leave(self) -> None:
        """Have the program leave, where that can be done."""
