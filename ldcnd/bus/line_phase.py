"""What a line is doing."""

from enum import Enum


class Phase(Enum):
    """What the line is doing."""

    IDLE = "idle"
    REPLY = "reply"
    LINGER = "linger"
    """A packet that must not be repeated has its reply; a second one would prove that the first was not its own."""
    QUIET = "quiet"
    """After a request that draws no reply."""
    FENCE = "fence"
    """Waiting for late bytes to stop."""
    SETTLE = "settle"
    """The flush is on its way."""
    CLOSED = "closed"
