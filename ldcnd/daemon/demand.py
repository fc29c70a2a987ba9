"""What of one axis somebody takes, and how often each item is asked for because of it. Pure."""

import math
from collections.abc import Mapping

from ldcnd.model.samples import TelemetryItem

DEMANDED_ITEMS = (TelemetryItem.POSITION, TelemetryItem.VELOCITY, TelemetryItem.ADC)
"""What may be polled at its idle rate. State and faults are not here: they keep their rate, whoever listens."""
LINGER_S = 2.0
"""So long an item counts as taken after its last subscriber has gone: one that comes back finds no gap."""


class Demand:
    """Remembers which items of one axis have subscribers, and which had some until a moment ago."""

    def __init__(self) -> None:
        self._taken_until_s: dict[TelemetryItem, float] = {}

    def subscribed(self, item: TelemetryItem, now_s: float, *, present: bool) -> None:
        """Take note that somebody subscribes to an item, or nobody any more."""
        if present:
            self._taken_until_s[item] = math.inf
        elif item in self._taken_until_s:
            self._taken_until_s[item] = now_s + LINGER_S

    def asked_hz(
        self, rates_hz: Mapping[TelemetryItem, float], idle_hz: float, now_s: float
    ) -> Mapping[TelemetryItem, float]:
        """Return how often each item is asked for now.

        Args:
            rates_hz: how often when somebody takes it.
            idle_hz: how often when nobody does; never more often than that.
            now_s: the loop's time.
        """
        idle = {item for item in DEMANDED_ITEMS if self._taken_until_s.get(item, -math.inf) <= now_s}
        return {item: min(rate, idle_hz) if item in idle else rate for item, rate in rates_hz.items()}
