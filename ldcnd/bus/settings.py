"""What a bus must know of its line before it opens it."""

from dataclasses import dataclass

from ldcnd.wirelog.recorder import KEPT_BYTES, KEPT_S

LINGER_S = 0.001
"""The line stays with a packet that must not be repeated for as long as its true reply can come, and so much longer:
adapters pass bytes on a little late."""

HOST_LATE_S = 0.001
"""By so much later than it should have a packet has left the host at most, also through an adapter on USB."""


@dataclass(frozen=True, slots=True)
class ServoCycle:
    """What decides when drives answer that do so at the end of a cycle, each of its own.

    Attributes:
        length_s: nominal.
        stretch: by how much the bytes of a reply take longer than at the line's nominal rate.
    """

    length_s: float
    stretch: float = 1.0


@dataclass(frozen=True, slots=True)
class BusSettings:
    """What the bus must know of its line.

    Attributes:
        name: as in the configuration.
        baud: rate at opening.
        bits_per_byte: 10 for 8N1 and for 7E1.
        margin_s: added to every reply's deadline: host scheduling and adapter latency.
        attempts: how often a repeatable command is sent in all.
        echo: the adapter returns our own bytes before the reply.
        paced: bytes take real time on this line, so that what comes too early is foreign; false only for
            far ends that answer faster than the baud rate allows.
        cycle: of the drives, to order polls by; None when they have none, or when polls are not to be ordered by it.
        recorded_s: how far back the flight recorder reaches.
        recorded_bytes: how much memory it may take.
    """

    name: str
    baud: int
    bits_per_byte: int = 10
    margin_s: float = 0.005
    attempts: int = 3
    echo: bool = False
    paced: bool = True
    cycle: ServoCycle | None = None
    recorded_s: float = KEPT_S
    recorded_bytes: int = KEPT_BYTES
