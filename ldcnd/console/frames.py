"""Frames for pages: what has changed, encoded once for all who want the same.

A frame is the msgpack array `[sent_ns, dropped, [[rig, topic, sample]…]]`.
"""

from collections.abc import Callable
from itertools import chain

import msgpack

MOST_NEWS = 200
"""A frame carries so many events at most, the latest."""

_TRIPLE = b"\x93"


class Batch:
    """What a frame tells: keys whose values have changed, events, and samples of streams in order.

    Attributes:
        paths: whose latest values it carries, as they are when it is encoded.
        news: entries of events.
        stream: entries of samples.
    """

    def __init__(self, paths: frozenset[str], news: tuple[bytes, ...] = (), stream: tuple[bytes, ...] = ()) -> None:
        self.paths = paths
        self.news = news
        self.stream = stream
        self._body: bytes | None = None

    def after(self, older: "Batch", *, streams: bool) -> "Batch":
        """Return this and what came before it as one; without the older streams if they are to be dropped."""
        return Batch(
            self.paths | older.paths,
            (older.news + self.news)[-MOST_NEWS:],
            older.stream + self.stream if streams else self.stream,
        )

    def body(self, entry: Callable[[str], bytes]) -> bytes:
        """Return its entries as one msgpack array, made at the first call."""
        if self._body is None:
            self._body = _array(tuple(chain(self.stream, self.news, map(entry, self.paths))))
        return self._body


def frame(sent_ns: int, dropped: int, body: bytes) -> bytes:
    """Return a frame."""
    return b"".join((_TRIPLE, msgpack.packb(sent_ns), msgpack.packb(dropped), body))


def _array(entries: tuple[bytes, ...]) -> bytes:
    return msgpack.Packer().pack_array_header(len(entries)) + b"".join(entries)
