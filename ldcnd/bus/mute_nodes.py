"""Nodes that do not answer: how much each has missed, and when it is worth asking it again. Pure.

A lost poll costs the line many times what an answered one does, so all mute nodes together get a small share of its
time.
"""

MISSES_BEFORE_BACKOFF = 3
MUTE_SHARE = 0.005
"""Of the line's time, for polls that nobody answers."""
FIRST_BACKOFF_S = 0.05
LONGEST_BACKOFF_S = 5.0
"""A mute node is asked at least that often, whatever share of the line it takes."""


class MuteNodes:
    """Exchanges in a row that were not answered, by node."""

    def __init__(self) -> None:
        self._misses: dict[int, int] = {}
        self._backed_off: set[int] = set()

    def misses(self, node: int) -> int:
        """Return how many exchanges in a row this node has left unanswered."""
        return self._misses.get(node, 0)

    def failing(self) -> set[int]:
        """Return the nodes that left their last exchange unanswered."""
        return set(self._misses)

    def missed(self, node: int) -> None:
        """Note an exchange without an answer."""
        self._misses[node] = self._misses.get(node, 0) + 1

    def pause_s(self, node: int, lost_s: float) -> float:
        """Return for how long to leave a node alone, whose poll has just been lost.

        Args:
            node: its miss was noted.
            lost_s: what a poll that it does not answer costs the line.
        """
        beyond = self.misses(node) - MISSES_BEFORE_BACKOFF
        if beyond < 0:
            return 0.0
        self._backed_off.add(node)
        many = len(self._backed_off)
        doubled_s = many * FIRST_BACKOFF_S * 2.0 ** min(10, beyond)
        return min(doubled_s, many * lost_s / MUTE_SHARE, LONGEST_BACKOFF_S)

    def answered(self, node: int) -> int | None:
        """Note an answer; return another node that is now worth asking at once, if this one had been given up.

        What made several nodes mute, a connector or the supply of one of them, often ends for all of them together.
        """
        if self._misses.pop(node, None) is None or node not in self._backed_off:
            return None
        self._backed_off.discard(node)
        return min(self._backed_off, key=lambda other: (other < node, other), default=None)  # the chain, once round

    def forget(self) -> None:
        """Begin anew: the line was opened."""
        self._misses.clear()
        self._backed_off.clear()
