"""Whether a line is in step, and its way back: silence, a flush, and a reply that is known beforehand."""

from collections.abc import Set as AbstractSet

from ldcnd.bus.resync import Probe, Resync

PROBE_ROUNDS = 3
LONGEST_FENCE = 20
"""A line that never falls silent is flushed after so many quiet times all the same."""


class Fence:
    """What must happen before a line is used again."""

    def __init__(self, resync: Resync) -> None:
        self._resync = resync
        self._rounds_left = 0
        self._since_s = 0.0

    @property
    def in_step(self) -> bool:
        """Whether nothing has happened since the last proof that makes it doubtful whose a reply is."""
        return self._rounds_left == 0

    def doubt(self) -> None:
        """Something has happened: the line must prove that it is in step."""
        self._rounds_left = PROBE_ROUNDS

    def proven(self) -> None:
        """The known reply has come."""
        self._rounds_left = 0

    def raised(self, now_s: float) -> float:
        """Begin to wait for silence; return until when, if no byte comes."""
        self._since_s = now_s
        return now_s + self._resync.quiet_s

    def disturbed(self, now_s: float) -> float:
        """Note bytes in the silence; return until when to wait now."""
        quiet_s = self._resync.quiet_s
        return min(now_s + quiet_s, self._since_s + LONGEST_FENCE * quiet_s)

    def probe(self, avoid: AbstractSet[int], now_s: float) -> Probe | None:
        """Return the next proof to attempt; None when none is needed, or when no node is known that could give one."""
        if self.in_step:
            return None
        exchange = self._resync.probe(avoid)
        self._rounds_left = self._rounds_left - 1 if exchange else 0
        return Probe(exchange, now_s) if exchange else None
