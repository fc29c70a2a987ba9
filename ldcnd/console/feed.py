"""Telemetry on its way to pages: those with the same subscription share a channel, and a slow one delays no other."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from typing import Self

import msgpack

from ldcnd.console.latest_values import LatestValues
from ldcnd.contract.errors import MalformedRequest, TooManyRequests, ValueOutOfRange

MOST_NEWS = 200
"""Maximum number of events in a frame; the latest are kept."""

_TRIPLE = b"\x93"


class Batch:
    """The contents of a frame: keys whose values have changed, events, and samples of streams in order.

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


STREAM_HZ = 60.0
"""Frames a second of a page that wants every sample of something."""
RATES_HZ = (1.0, 60.0)
DEFAULT_RATE_HZ = 10.0
MOST_STREAMS = 64
MOST_PAGES = 64
WAITING_FRAMES = 4
"""Maximum number of frames that wait for a page that does not read; then its oldest streams are dropped."""
STREAMED_SAMPLES = 4096
"""Maximum number of streamed samples in a frame; the oldest are dropped."""
SIGN_OF_LIFE_S = 0.5
"""Maximum time between two frames, even with nothing in them, seconds."""


@dataclass(frozen=True, slots=True)
class Subscription:
    """A page's subscription.

    Attributes:
        rigs: these only; none means all.
        rate_hz: rate of the frames with latest values.
        streams: paths of which it wants every sample.
    """

    rigs: frozenset[str]
    rate_hz: float
    streams: frozenset[str]

    def covers(self, path: str) -> bool:
        """Tell whether the latest value of a path is wanted."""
        return not self.rigs or path.partition("/")[0] in self.rigs or path in self.streams


def parse_subscription(rigs: str, rate: str, stream: str) -> Subscription:
    """Return the subscription of a query.

    Raises:
        MalformedRequest: it cannot be read.
        ValueOutOfRange: the rate is not 1 to 60 frames a second, or there are too many streams.
    """
    try:
        rate_hz = float(rate) if rate else DEFAULT_RATE_HZ
    except ValueError:
        raise MalformedRequest(f"rate={rate[:20]} is no number", value=rate[:20]) from None
    lowest, highest = RATES_HZ
    if not lowest <= rate_hz <= highest:
        raise ValueOutOfRange(f"rate={rate_hz:g} is not {lowest:g} to {highest:g} frames a second", value=rate_hz)
    streams = [name.split("/", 2) for name in stream.split(",") if name]
    if len(streams) > MOST_STREAMS:
        raise ValueOutOfRange(f"{len(streams)} streams are more than {MOST_STREAMS}", value=len(streams))
    if any(len(parts) < 3 for parts in streams):  # noqa: PLR2004 - a rig, an axis and an item
        raise MalformedRequest("stream names RIG/AXIS/ITEM, separated by commas", value=stream[:80])
    paths = frozenset(f"{rig}/tele/{axis}/{item}" for rig, axis, item in streams)
    return Subscription(frozenset(name for name in rigs.split(",") if name), rate_hz, paths)


class Page:
    """One open page; made by `Feed.open_page`.

    Attributes:
        dropped: how many frames gave up their streams because it did not read.
    """

    def __init__(self, entry: Callable[[str], bytes], first: Batch, now_ns: Callable[[], int]) -> None:
        self.dropped = 0
        self._now_ns = now_ns
        self._entry = entry
        self._waiting = deque([first])
        self._ready = asyncio.Event()
        self._ready.set()

    def offer(self, batch: Batch) -> None:
        """Take the next frame."""
        if len(self._waiting) == WAITING_FRAMES:
            oldest = self._waiting.popleft()
            self._waiting[0] = self._waiting[0].after(oldest, streams=False)
            self.dropped += 1
        self._waiting.append(batch)
        self._ready.set()

    async def frames(self) -> AsyncIterator[bytes]:
        """Yield frames as they are due, those that have waited meanwhile as one."""
        while True:
            await self._ready.wait()
            self._ready.clear()
            batch = self._waiting.popleft()
            while self._waiting:
                batch = self._waiting.popleft().after(batch, streams=True)
            yield frame(self._now_ns(), self.dropped, batch.body(self._entry))


class FrameChannel:
    """Sends the frames to all pages with one subscription."""

    def __init__(self, values: LatestValues, subscription: Subscription) -> None:
        self.pages: list[Page] = []
        self._values = values
        self._subscription = subscription
        self._changed: set[str] = set()
        self._news: deque[bytes] = deque(maxlen=MOST_NEWS)
        self._stream: deque[bytes] = deque(maxlen=STREAMED_SAMPLES)

    def changed(self, path: str, entry: bytes) -> None:
        """Learn of a value."""
        if path in self._subscription.streams:
            self._stream.append(entry)
        elif self._subscription.covers(path):
            self._changed.add(path)

    def happened(self, path: str, entry: bytes) -> None:
        """Learn of an event."""
        if self._subscription.covers(path):
            self._news.append(entry)

    async def run(self) -> None:
        """Tell the pages until cancelled."""
        loop = asyncio.get_running_loop()
        period_s = 1.0 / (STREAM_HZ if self._subscription.streams else self._subscription.rate_hz)
        due_s = values_due_s = told_s = loop.time()
        while True:
            # a late turn is no reason for a burst of frames
            due_s = max(due_s + period_s, loop.time())
            await asyncio.sleep(due_s - loop.time())
            now_s = loop.time()
            paths: frozenset[str] = frozenset()
            if now_s >= values_due_s:
                values_due_s = max(values_due_s + 1.0 / self._subscription.rate_hz, now_s)
                paths = frozenset(self._changed)
                self._changed.clear()
            if paths or self._news or self._stream or now_s >= told_s + SIGN_OF_LIFE_S:
                told_s = now_s
                self._tell(Batch(paths, tuple(self._news), tuple(self._stream)))

    def _tell(self, batch: Batch) -> None:
        self._news.clear()
        self._stream.clear()
        for page in self.pages:
            page.offer(batch)


class Feed:
    """All open pages.

    Args:
        values: what they show.
        now_ns: the wall clock, UTC in ns since 1970.
    """

    def __init__(self, values: LatestValues, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._values = values
        self._channels: dict[Subscription, tuple[FrameChannel, asyncio.Task[None]]] = {}
        self._group = asyncio.TaskGroup()

    async def __aenter__(self) -> Self:
        await self._group.__aenter__()
        return self

    async def __aexit__(self, *error: object) -> None:
        for _, task in self._channels.values():
            task.cancel()
        await self._group.__aexit__(None, None, None)

    @contextmanager
    def open_page(self, subscription: Subscription) -> Iterator[Page]:
        """Serve a page for as long as the context lasts.

        Raises:
            TooManyRequests: there are too many pages.
        """
        if sum(len(channel.pages) for channel, _ in self._channels.values()) >= MOST_PAGES:
            raise TooManyRequests(f"{MOST_PAGES} pages are open", limit=MOST_PAGES, remedy="close some of them")
        channel, task = self._channels.get(subscription) or self._new_channel(subscription)
        page = Page(self._values.entry, Batch(self._values.names(subscription.covers)), self._now_ns)
        channel.pages.append(page)
        try:
            yield page
        finally:
            channel.pages.remove(page)
            if not channel.pages:
                del self._channels[subscription]
                self._values.watchers.remove(channel)
                task.cancel()

    def _new_channel(self, subscription: Subscription) -> tuple[FrameChannel, asyncio.Task[None]]:
        channel = FrameChannel(self._values, subscription)
        task = self._group.create_task(channel.run(), name=f"channel at {subscription.rate_hz:g} Hz")
        self._values.watchers.append(channel)
        self._channels[subscription] = (channel, task)
        return channel, task
