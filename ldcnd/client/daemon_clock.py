"""How old what a daemon has published is, by its own clock: those of two hosts differ, and who looks on comes later."""


class DaemonClock:
    """The clock of one run of a daemon, as late as its news are here; times of this host are of one clock, in seconds.

    That of the next run may be another: a host without a battery begins hours behind. A run is named by its session or
    its instance; an empty text, where the network does not tell, is the run that is followed.
    """

    def __init__(self) -> None:
        self._run = ""
        self._newest_ns = 0
        self._at_s = 0.0

    def follow(self, run: str) -> bool:
        """Follow the clock of a run from now on; return whether it is a new one: what others said is over."""
        if self.follows(run):
            return False
        self._run, self._newest_ns, self._at_s = run, 0, 0.0
        return True

    def follows(self, run: str) -> bool:
        """Tell whether this is the run that is followed."""
        return run in (self._run, "")

    def note(self, t: int, at_s: float) -> None:
        """Learn that an instant, UTC in ns since 1970, had come when this came here: a sample's, or a report's."""
        if t > self._newest_ns:
            self._newest_ns, self._at_s = t, at_s

    def age_s(self, t: int, now_s: float) -> float:
        """Return how old an instant is now, in seconds."""
        return (self._newest_ns - t) / 1e9 + now_s - self._at_s
