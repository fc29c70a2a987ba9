"""The last value of every key of every rig, ready to be spliced into frames for pages.

A path is a key without its root: `sim/tele/x/position`. An entry is the msgpack array of rig, topic and sample;
samples stay the bytes that the daemon has sent.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import msgpack

from ldcnd.client.network import Publication, SampleKind
from ldcnd.contract.codec import Encoding
from ldcnd.contract.keys import ROOT

RIG_TOPIC = "rig"
RUN_TOPIC = "run"
"""Topics of what the console itself tells of a rig: how it is, and how far a sequence is."""
"""Stands in the place of a topic where an entry tells of the rig itself."""
MOST_PATHS = 20_000
"""More keys than any rigs have; what comes on others is left out."""

_TRIPLE = b"\x93"
_NIL = b"\xc0"
_MAPS = frozenset({*range(0x80, 0x90), 0xDE, 0xDF})
"""First bytes of msgpack maps."""


class Watcher(Protocol):
    """Receives changes; must not block."""

    def changed(self, path: str, entry: bytes) -> None:
        """Learn that a key has another value, or none any more."""

    def happened(self, path: str, entry: bytes) -> None:
        """Learn of an event."""


class _Kind(Enum):
    """The content of a path."""

    VALUE = "value"
    EVENT = "event"
    LEFT_OUT = "left out"


@dataclass(frozen=True, slots=True)
class _Path:
    """The fixed properties of a path.

    Attributes:
        name: the path.
        rig: its first chunk.
        start: how its entries begin.
    """

    name: str
    rig: str
    start: bytes
    kind: _Kind


class LatestValues:
    """The values that pages show.

    Attributes:
        watchers: called with every change, in order.
    """

    def __init__(self) -> None:
        self.watchers: list[Watcher] = []
        self._entries: dict[str, bytes] = {}
        self._paths: dict[str, _Path] = {}
        self._newer: dict[str, set[str]] = {}

    def take(self, sample: Publication) -> None:
        """Take a published sample; samples of traces are left out, pages fetch them."""
        path = self._paths.get(sample.key) or self._new_path(sample.key)
        if path.kind is _Kind.LEFT_OUT:
            return
        if sample.kind is SampleKind.DELETE:
            self._remove(path)
            return
        payload = as_msgpack(sample.payload, sample.encoding)
        if payload is None:
            return
        if path.kind is _Kind.VALUE:
            self._put(path, payload)
            return
        for watcher in self.watchers:
            watcher.happened(path.name, path.start + payload)

    def tell_of_rig(self, rig: str, told: Mapping[str, object], topic: str = RIG_TOPIC) -> None:
        """Replace what the console tells of a rig itself."""
        key = f"{ROOT}/{rig}/{topic}"
        self._put(self._paths.get(key) or self._new_path(key), msgpack.packb(told))

    def begin_again(self, rig: str) -> None:
        """Note which values of a rig come from now on; see `settle`."""
        self._newer[rig] = set()

    def settle(self, rig: str, answers: Sequence[Publication]) -> None:
        """Put a rig's values in order after it has come back, given the values that it answered.

        What has come since `begin_again` is newer than an answer; what has neither come nor was answered is no more.
        """
        newer = self._newer.pop(rig, set())
        for answer in answers:
            if answer.key not in newer:
                self.take(answer)
        kept = (
            newer | {answer.key for answer in answers} | {f"{ROOT}/{rig}/{topic}" for topic in (RIG_TOPIC, RUN_TOPIC)}
        )
        for key, path in self._paths.items():
            if path.rig == rig and key not in kept:
                self._remove(path)

    def names(self, wanted: Callable[[str], bool]) -> frozenset[str]:
        """Return the wanted ones of the paths that have a value."""
        return frozenset(name for name in self._entries if wanted(name))

    def entry(self, name: str) -> bytes:
        """Return the present entry of a path for pages."""
        return self._entries.get(name) or self._paths[f"{ROOT}/{name}"].start + _NIL

    def _put(self, path: _Path, payload: bytes) -> None:
        entry = self._entries[path.name] = path.start + payload
        if self._newer and path.rig in self._newer:
            self._newer[path.rig].add(f"{ROOT}/{path.name}")
        for watcher in self.watchers:
            watcher.changed(path.name, entry)

    def _remove(self, path: _Path) -> None:
        if self._entries.pop(path.name, None):
            for watcher in self.watchers:
                watcher.changed(path.name, path.start + _NIL)

    def _new_path(self, key: str) -> _Path:
        name = key[len(ROOT) + 1 :]
        rig, _, topic = name.partition("/")
        start = _TRIPLE + msgpack.packb(rig) + msgpack.packb(topic)
        if len(self._paths) >= MOST_PATHS:
            return _Path(name, rig, start, _Kind.LEFT_OUT)
        path = self._paths[key] = _Path(name, rig, start, _kind(topic.split("/")))
        return path


def _kind(topic: list[str]) -> _Kind:
    match topic:
        case ["tele", _, "event"]:
            return _Kind.EVENT
        case ["tele", _, "trace", _]:
            return _Kind.LEFT_OUT
    return _Kind.VALUE


def as_msgpack(payload: bytes, encoding: str) -> bytes | None:
    """Return a published model as msgpack; None for what is none."""
    if encoding.startswith(Encoding.MSGPACK):
        return payload if payload and payload[0] in _MAPS else None
    try:
        model = json.loads(payload)
        return msgpack.packb(model) if isinstance(model, dict) else None
    except (ValueError, OverflowError, RecursionError):
        return None
