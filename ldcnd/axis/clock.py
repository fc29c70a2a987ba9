"""Loop time to wall time: the only place that stamps."""

import asyncio
from collections.abc import Callable

from ldcnd.line.exchange import Timing


class Clock:
    """Turns instants of the event loop's clock into UTC nanoseconds.

    Attributes:
        now_ns: returns the wall time, UTC in ns since 1970.
        now_s: returns the loop's time, in seconds.
        started_s: what the loop's clock showed when the daemon was built, in seconds.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self.now_ns = now_ns
        self.now_s = asyncio.get_running_loop().time
        self.started_s = self.now_s()

    def wall_ns(self, at_s: float) -> int:
        """Return the wall time of an instant of the loop's clock."""
        # by the distance from now: the wall clock may be set at any time, the loop's goes on evenly
        return self.now_ns() - round((self.now_s() - at_s) * 1e9)

    def stamp(self, timing: Timing) -> tuple[int, int]:
        """Return when the values of an exchange were true and how far off that can be, both in ns."""
        from_s, until_s = timing.true_from_s, timing.true_until_s
        ago_s = self.now_s() - (from_s + until_s) / 2
        return self.now_ns() - round(ago_s * 1e9), round((until_s - from_s) / 2 * 1e9)

    def stamp_between(self, from_s: float, until_s: float) -> tuple[int, int]:
        """Return the middle of two instants of the loop's clock and how far off it can be, both in ns."""
        return self.wall_ns((from_s + until_s) / 2), round((until_s - from_s) / 2 * 1e9)
