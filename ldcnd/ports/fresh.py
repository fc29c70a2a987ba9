"""Readings that others have just made, for guests that may have them instead of one of their own."""

import asyncio
import math
from collections.abc import Iterator
from typing import Any

from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, PacketEffect, Timing

MS_PER_S = 1000.0
MOST_KEPT = 64
"""Packets of which the latest reply is kept, for each node; those that came longest ago are dropped."""


class FreshReplies:
    """The latest reply to each packet that reads, by the node that sent it.

    Args:
        bus: the line.
        fresh_ms: what is older, in milliseconds, is no answer; 0 keeps nothing.
    """

    def __init__(self, bus: Bus, fresh_ms: float) -> None:
        self._bus, self._fresh_s = bus, fresh_ms / MS_PER_S
        self._loop = asyncio.get_running_loop()
        self._latest: dict[int, dict[bytes, tuple[bytes, float]]] = {}
        self._changed_s: dict[int, float] = {}
        if fresh_ms:
            bus.listeners.append(self._take)

    def close(self) -> None:
        """Take nothing more."""
        if self._take in self._bus.listeners:
            self._bus.listeners.remove(self._take)

    def changed(self, node: int) -> None:
        """Take note that the guest has changed something there: no earlier reading shows it."""
        self._changed_s[node] = self._loop.time()

    def of(self, node: int) -> Iterator[tuple[bytes, bytes]]:
        """Yield the packets of which there is a fresh reply of a node, each with the reply."""
        since_s = max(self._loop.time() - self._fresh_s, self._changed_s.get(node, -math.inf))
        for request, (reply, true_from_s) in self._latest.get(node, {}).items():
            if true_from_s >= since_s:
                yield request, reply

    def _take(self, exchange: Exchange[Any], reply: bytes, timing: Timing) -> None:
        if exchange.effect is not PacketEffect.READS:
            return
        latest = self._latest.setdefault(exchange.node, {})
        latest.pop(exchange.request, None)
        latest[exchange.request] = (reply, timing.true_from_s)
        if len(latest) > MOST_KEPT:
            del latest[next(iter(latest))]
