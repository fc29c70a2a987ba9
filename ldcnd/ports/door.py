"""Where a program comes in to a port: what its terminal and its TCP address have in common."""

from collections.abc import Callable
from typing import Protocol

FLOOD_PAUSE_S = 0.02
"""How long a program that sends more than its line carries is not read from, seconds."""


class Door(Protocol):
    """Where a program comes in.

    Attributes:
        take: called with what it has sent, and the rate at which it sends; None for the rate that its modules have.
            Returns how many bytes were taken: the others are handed over again after `FLOOD_PAUSE_S`, and the program
            is not read from meanwhile, as a serial driver lets a program wait that sends more than its line carries.
        closed: called when it has gone, with what it had sent and was not taken yet, and its rate: nothing begins by
            that any more, and a stop in it is a stop.
    """

    take: Callable[[bytes, int | None], int]
    closed: Callable[[bytes, int | None], None]

    def write(self, data: bytes) -> None:
        """Send to the program; what it does not read is lost."""

    def leave(self) -> None:
        """Hang up on the program.

        Raises:
            OSError: it cannot be done; the program stays.
        """
