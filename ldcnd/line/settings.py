"""Settings of a bus, complete before it opens its line."""

from dataclasses import dataclass

from ldcnd.line.flight_recorder import KEPT_BYTES, KEPT_S

LINGER_S = 0.001
"""Extra time that the line waits for the true reply to a packet that must not be repeated, seconds: adapters pass bytes
on a little late."""

HOST_LATE_S = 0.001
"""Maximum delay between writing a packet and its first bit on the wire, seconds, also through an adapter on USB."""


@dataclass(frozen=True, slots=True)
class ServoCycle:
    """Servo cycle of drives that reply at the end of a cycle; the cycles of the drives are not synchronised.

    Attributes:
        length_s: nominal length, in seconds.
        stretch: duration of the bytes of a reply, as a multiple of that at the line's nominal rate.
    """

    length_s: float
    stretch: float = 1.0


@dataclass(frozen=True, slots=True)
class BusSettings:
    """Settings of one line.

    Attributes:
        name: as in the configuration.
        baud: rate at opening.
        bits_per_byte: 10 for 8N1 and for 7E1.
        margin_s: added to every reply's deadline: host scheduling and adapter latency.
        attempts: how often a repeatable command is sent in all.
        coalesce_s: how long the reply to a poll may wait to be processed together with those after it, while the line
            is busy with polls; 0 to process each at once.
        echo: the adapter returns our own bytes before the reply.
        paced: bytes take real time on this line, so that bytes that come too early are foreign; false only for
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
    coalesce_s: float = 0.0
    echo: bool = False
    paced: bool = True
    cycle: ServoCycle | None = None
    recorded_s: float = KEPT_S
    recorded_bytes: int = KEPT_BYTES
