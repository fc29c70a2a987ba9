"""How old what a daemon has published is, by its own clock: those of two hosts differ, and who looks on comes later."""


class DaemonClock:
    """The clock of one daemon, as late as its news are here; times of this host are those of one clock, in seconds."""

    def __init__(self) -> None:
        self._newest_ns = 0
        self._at_s = 0.0

    def note(self, t: int, at_s: float) -> None:
        """Learn that an instant, UTC in ns since 1970, had come when this came here: a sample's, or a report's."""
        if t > self._newest_ns:
            self._newest_ns, self._at_s = t, at_s

    def age_s(self, t: int, now_s: float) -> float:
        """Return how old an instant is now, in seconds."""
        return (self._newest_ns - t) / 1e9 + now_s - self._at_s
