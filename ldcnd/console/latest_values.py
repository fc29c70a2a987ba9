"""The last value of every key of every rig, ready to be spliced into frames for pages.

A path is a key below `ldcn/`: `sim/tele/x/position`. An entry is the msgpack array of rig, topic and sample; samples
stay the bytes that the daemon has sent.
"""

import json
from collections.abc import Callable, Iterable
from typing import Protocol

import msgpack

from ldcnd.messaging.codec import Encoding
from ldcnd.messaging.keys import ROOT
from ldcnd.messaging.session import Sample, SampleKind

RIG_TOPIC = "rig"
"""Stands in the place of a topic where an entry tells of the rig itself."""
MOST_PATHS = 20_000
"""More keys than any rigs have; what comes on others is left out."""

_BELOW_ROOT = len(ROOT) + 1
_TRIPLE = b"\x93"
_NIL = b"\xc0"
_MAPS = frozenset({*range(0x80, 0x90), 0xDE, 0xDF})
"""First bytes of msgpack maps."""


class Watcher(Protocol):
    """Who wants to know what has changed; must not block."""

    def changed(self, path: str, entry: bytes) -> None:
        """Learn that a key has another value, or none any more."""

    def happened(self, path: str, entry: bytes) -> None:
        """Learn of an event."""


class LatestValues:
    """What pages show.

    Attributes:
        watchers: told of every change, in order.
    """

    def __init__(self) -> None:
        self.watchers: list[Watcher] = []
        self._entries: dict[str, bytes] = {}
        self._starts: dict[str, bytes] = {}
        self._touched: dict[str, set[str]] = {}

    def take(self, sample: Sample) -> None:
        """Take what a daemon has published; samples of traces are left out, pages ask for them."""
        path = sample.key[_BELOW_ROOT:]
        kind = path.split("/", 4)[3:]
        if sample.kind is SampleKind.DELETE:
            self._put(path, None)
        elif kind == ["event"]:
            payload = as_msgpack(sample.payload, sample.encoding)
            if payload and (start := self._start(path)):
                for watcher in self.watchers:
                    watcher.happened(path, start + payload)
        elif len(kind) == 1 or kind[:1] != ["trace"]:
            self._put(path, as_msgpack(sample.payload, sample.encoding))

    def tell_of_rig(self, rig: str, told: object) -> None:
        """Replace what pages know about a rig itself; `told` is made of what msgpack takes."""
        self._put(f"{rig}/{RIG_TOPIC}", msgpack.packb(told))

    def begin_again(self, rig: str) -> None:
        """Note which values of a rig come from now on; see `settle`."""
        self._touched[rig] = set()

    def settle(self, rig: str, samples: Iterable[Sample]) -> None:
        """Put a rig's values in order after it has come back, given what it answered.

        What has come since `begin_again` is newer than an answer; what has neither come nor was answered is no more.
        """
        newer = self._touched.pop(rig, set())
        answered = {sample.key[_BELOW_ROOT:]: sample for sample in samples}
        for path, sample in answered.items():
            if path not in newer:
                self.take(sample)
        below = f"{rig}/"
        for path in [path for path in self._entries if path.startswith(below) and path != below + RIG_TOPIC]:
            if path not in newer and path not in answered:
                self._put(path, None)

    def paths(self, wanted: Callable[[str], bool]) -> frozenset[str]:
        """Return the paths that have a value."""
        return frozenset(path for path in self._entries if wanted(path))

    def entry(self, path: str) -> bytes:
        """Return what pages are told of a path now."""
        return self._entries.get(path) or self._starts[path] + _NIL

    def _put(self, path: str, sample: bytes | None) -> None:
        start = self._start(path)
        if start is None or (sample is None and path not in self._entries):
            return
        entry = start + (sample or _NIL)
        if sample is None:
            del self._entries[path]
        else:
            self._entries[path] = entry
        if self._touched:
            touched = self._touched.get(path.partition("/")[0])
            if touched is not None:
                touched.add(path)
        for watcher in self.watchers:
            watcher.changed(path, entry)

    def _start(self, path: str) -> bytes | None:
        """Return how the entries of a path begin."""
        start = self._starts.get(path)
        if start is None and len(self._starts) < MOST_PATHS:
            rig, _, topic = path.partition("/")
            start = self._starts[path] = _TRIPLE + msgpack.packb(rig) + msgpack.packb(topic)
        return start


def as_msgpack(payload: bytes, encoding: str) -> bytes | None:
    """Return a published model as msgpack; None for what is none."""
    if encoding.startswith(Encoding.MSGPACK):
        return payload if payload and payload[0] in _MAPS else None
    try:
        model = json.loads(payload)
        return msgpack.packb(model) if isinstance(model, dict) else None
    except (ValueError, OverflowError, RecursionError):
        return None
