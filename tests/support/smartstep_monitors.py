"""The words of a SmartStep's status displays."""

from ldcnd.drives.smartstep.monitors import WORDS, Counter, Monitor

_HALVES = (half for counter in Counter for half in (counter.low, counter.high))

MONITORS: tuple[Monitor, ...] = tuple(
    sorted((*(word for word in WORDS.values() if word.label.startswith("Un")), *_HALVES), key=lambda each: each.address)
)
"""In order of address."""
