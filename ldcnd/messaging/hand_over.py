"""Hand-over from any thread to the event loop: bounded, in order, with one wake-up for a batch."""

import asyncio
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from ldcnd.errors import ShuttingDown, TooManyRequests
from ldcnd.messaging.session import (
    PENDING_QUERIES,
    PENDING_URGENT_QUERIES,
    UNDELIVERED_TOKENS,
    Load,
    OnQuery,
    OnToken,
    Query,
)

ItemT = TypeVar("ItemT")

COMMANDS_PER_TURN = 4
"""Maximum number of commands that begin in one loop iteration; all stops that have arrived do."""

COLLECTED_ITEMS = 4096
"""Maximum number of answers that one query collects."""


class HandOver(Generic[ItemT]):
    """Keeps the newest items until the loop has called back with them, in order.

    Args:
        loop: the loop.
        deliver: takes an item.
        capacity: maximum number of waiting items.
        per_turn: number of items delivered in one loop iteration; all that wait, if missing.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        deliver: Callable[[ItemT], None],
        capacity: int,
        per_turn: int | None = None,
    ) -> None:
        self._per_turn = per_turn or capacity
        self._lost = 0
        self._loop = loop
        self._deliver = deliver
        self._capacity = capacity
        self._items: deque[ItemT] = deque()
        self._woken = False
        self._closed = False
        # held for an append only: the threads that offer must never wait for the loop
        self._lock = threading.Lock()

    def offer(self, item: ItemT) -> None:
        """Take an item; the oldest one gives way when there are too many. Any thread, never blocks."""
        with self._lock:
            if self._closed:
                return
            if len(self._items) >= self._capacity:
                self._items.popleft()
                self._lost += 1
            self._items.append(item)
            if self._woken:
                return
            self._woken = True
        self._loop.call_soon_threadsafe(self._drain)

    def load(self) -> Load:
        """Return how many items wait, and how many gave way to newer ones."""
        return Load(len(self._items), self._lost)

    def close(self) -> list[ItemT]:
        """Call back no more; return what was not delivered."""
        with self._lock:
            self._closed = True
            left = list(self._items)
            self._items.clear()
        return left

    def _drain(self) -> None:
        """Deliver what was there on waking; later items wait for the next turn, so that others get theirs."""
        with self._lock:
            batch = min(len(self._items), self._per_turn)
        try:
            for _ in range(batch):
                with self._lock:
                    if not self._items:
                        break
                    item = self._items.popleft()
                self._deliver(item)
        finally:
            with self._lock:
                self._woken = bool(self._items)
            if self._woken:
                self._loop.call_soon(self._drain)


class Admission(Protocol):
    """A query that was counted in; neither method blocks, and any thread may call them."""

    def offer(self, query: Query) -> None:
        """Hand the query to its queryable."""

    def leave(self) -> None:
        """Count the query out: its answer has left."""


class QueryIntake(Protocol):
    """The admission to one queryable; no method blocks, and any thread may call all but `close`."""

    def admit(self, source: str) -> Admission | None:
        """Count a query in, None if there is no room; `source` is the session that it names, empty if it names none."""

    def refusal(self, key: str, source: str) -> TooManyRequests:
        """Return the error for a query that was not admitted."""

    def load(self) -> Load:
        """Return how many queries are unanswered, and how many were not admitted."""

    def close(self) -> None:
        """Call back no more; refuse the queries that the callback has not had."""


class Intake:
    """Hands the queries of one queryable to its callback, up to a maximum number at a time.

    A query counts from its arrival until its answer has left.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, on_query: OnQuery, *, urgent: bool = False) -> None:
        self._on_query = on_query
        self._capacity = PENDING_URGENT_QUERIES if urgent else PENDING_QUERIES
        self._pending = 0
        self._refused = 0
        # re-entrant: an abandoned query may be collected, and so leave, while this very thread counts
        self._lock = threading.RLock()
        # admission bounds it, so nothing ever gives way
        self._queries = HandOver(loop, self._deliver, self._capacity, None if urgent else COMMANDS_PER_TURN)

    def admit(self, source: str) -> Admission | None:
        """Count a query in."""
        del source
        with self._lock:
            if self._pending >= self._capacity:
                self._refused += 1
                return None
            self._pending += 1
            return self

    def refusal(self, key: str, source: str) -> TooManyRequests:
        """Return the error for a query that was not admitted."""
        del source
        return TooManyRequests(
            f"{key}: {self._capacity} queries are unanswered already; nothing was done",
            limit=self._capacity,
            remedy="wait for answers before asking more",
        )

    def load(self) -> Load:
        """Return how many queries are unanswered, and how many were not admitted."""
        return Load(self._pending, self._refused)

    def leave(self) -> None:
        """Count a query out."""
        with self._lock:
            self._pending -= 1

    def offer(self, query: Query) -> None:
        """Take an admitted query."""
        self._queries.offer(query)

    def close(self) -> None:
        """Call back no more; refuse the queries that the callback has not had."""
        for query in self._queries.close():
            query.refuse(ShuttingDown(f"{query.key}: not served any more"))

    def _deliver(self, query: Query) -> None:
        try:
            self._on_query(query)
        except BaseException:
            query.abandon()
            raise


class TokenChanges:
    """Hands the changes of liveliness tokens to a callback, each once, however often they are reported."""

    def __init__(self, loop: asyncio.AbstractEventLoop, on_token: OnToken) -> None:
        self._on_token = on_token
        self._alive: set[str] = set()
        self._changes = HandOver(loop, self._deliver, UNDELIVERED_TOKENS)

    def offer(self, key: str, *, alive: bool) -> None:
        """Take a report. Any thread, never blocks."""
        self._changes.offer((key, alive))

    def load(self) -> Load:
        """Return how many changes wait, and how many gave way to newer ones."""
        return self._changes.load()

    def close(self) -> None:
        """Call back no more."""
        self._changes.close()

    def _deliver(self, change: tuple[str, bool]) -> None:
        key, alive = change
        if alive is not (key in self._alive):
            (self._alive.add if alive else self._alive.discard)(key)
            self._on_token(key, alive)


class Collector(Generic[ItemT]):
    """Collects items from any thread until their end, for one who waits on the loop.

    Attributes:
        items: the items received; beyond `COLLECTED_ITEMS`, nothing more is kept.
        done: set when no more will come.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.items: list[ItemT] = []
        self.done = asyncio.Event()
        self._loop = loop

    def take(self, item: ItemT) -> None:
        """Take an item. Any thread, never blocks."""
        if len(self.items) < COLLECTED_ITEMS:
            self.items.append(item)

    def end(self) -> None:
        """Learn that there will be no more. Any thread, never blocks."""
        self._loop.call_soon_threadsafe(self.done.set)
