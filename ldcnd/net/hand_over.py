"""A query from any thread to the event loop, and its answer: bounded, in order, answered exactly once.

What else comes from other threads, changes of liveliness tokens and collected answers, is handed over the same way,
with one wake-up for a batch.
"""

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from ldcnd.contract.codec import Encoding, encode, error_reply
from ldcnd.contract.errors import InternalError, LdcndError, ShuttingDown, TooManyRequests

ItemT = TypeVar("ItemT")

PENDING_QUERIES = 64
"""Maximum number of unanswered queries of a queryable; the next is refused with too_many_requests."""

PENDING_URGENT_QUERIES = 4096
"""The same for an urgent queryable: a bound on memory, not on clients; a stop is not refused for being one of many."""

UNDELIVERED_TOKENS = 1024
"""Maximum number of changes that a token watch keeps for its callback; the oldest is dropped."""

COMMANDS_PER_TURN = 4
"""Maximum number of commands that begin in one loop iteration; all stops that have arrived do."""

COLLECTED_ITEMS = 4096
"""Maximum number of answers that one query collects."""


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer to a query; an error answer carries an `ErrorReply`.

    Attributes:
        source: the session that has answered, as the asking one sees it; empty where the network does not say.
    """

    key: str
    payload: bytes
    encoding: str
    measured_at_ns: int | None = None
    is_error: bool = False
    source: str = field(default="", compare=False)


def _no_login() -> str | None:
    return None


def no_key(_key: str) -> bool:
    """Spare no query."""
    return False


Send = Callable[[tuple[Answer, ...]], None]
"""Takes all answers to one query, once, from any thread, without blocking."""


class Query:
    """A question to be answered exactly once, on the event loop, now or later.

    Either one `reply` without a key, or one `refuse` or `reply_error`, or any number of `reply` with a key each and
    then `finish`. A query that is dropped without an answer is answered with an internal error.

    Attributes:
        key: of the query; may be an expression with wildcards.
        parameters: what followed the `?` of the selector, not percent-decoded.
        payload: empty when there was none.
        encoding: of the payload, as the client named it; empty when it did not.
    """

    __slots__ = ("_answered", "_answers", "_login", "_send", "encoding", "key", "parameters", "payload")

    def __init__(
        self,
        key: str,
        parameters: Mapping[str, str],
        payload: bytes,
        encoding: str,
        send: Send,
        login: Callable[[], str | None] = _no_login,
    ) -> None:
        self.key = key
        self._login = login
        self.parameters = parameters
        self.payload = payload
        self.encoding = encoding
        self._send = send
        self._answers: list[Answer] = []
        self._answered = False

    @property
    def login(self) -> str | None:
        """The certificate of the link that its sender says it comes from, by common name; for the record only.

        None when the sender does not say, when it is behind a router, and on links without certificates. A login that
        may command can name another one's session, so this finds mistakes, not forgers.
        """
        return self._login()

    @property
    def answered(self) -> bool:
        """Whether it has its answer."""
        return self._answered

    def reply(self, payload: bytes, encoding: str, key: str | None = None, measured_at_ns: int | None = None) -> None:
        """Answer; finally without a key, with one value of several when a key is given.

        Args:
            payload: the value.
            encoding: of the payload.
            key: the key that has this value; must match the query's. `finish` ends the answer.
            measured_at_ns: when the value was true, UTC in ns since 1970.

        Raises:
            InternalError: the query was answered already.
        """
        self._refuse_second_answer()
        self._answers.append(Answer(key or self.key, payload, encoding, measured_at_ns))
        if key is None:
            self.finish()

    def reply_error(self, payload: bytes, encoding: str) -> None:
        """Answer finally with an encoded `ErrorReply`; values given before are not sent.

        Raises:
            InternalError: the query was answered already.
        """
        self._refuse_second_answer()
        self._answers = [Answer(self.key, payload, encoding, is_error=True)]
        self.finish()

    def refuse(self, error: LdcndError) -> None:
        """Answer finally with an error, as JSON.

        Raises:
            InternalError: the query was answered already.
        """
        self.reply_error(*encode(error_reply(error), Encoding.JSON))

    def finish(self) -> None:
        """End an answer of several values, or of none.

        Raises:
            InternalError: the query was answered already.
        """
        self._refuse_second_answer()
        # before it is sent: if that fails, `__del__` must not answer a second time
        self._answered = True
        self._send(tuple(self._answers))

    def abandon(self) -> None:
        """Answer with an internal error unless the query was answered; for a caller that gives a query up."""
        if not self._answered:
            self.refuse(InternalError(f"{self.key}: the query was dropped without an answer; the log has more"))

    def _refuse_second_answer(self) -> None:
        if self._answered:
            raise InternalError(f"{self.key}: the query was answered already")

    def __del__(self) -> None:
        """Leave no client waiting for a query that was abandoned."""
        # attributes are missing when the constructor failed
        if not getattr(self, "_answered", True):
            self.abandon()


OnQuery = Callable[[Query], None]
OnRead = Callable[[Query], Iterator[None]]
"""Answers a query in steps: each makes at most one payload, and between two of them the loop does other work."""
OnToken = Callable[[str, bool], None]
"""Learns that the token of a key has appeared (True) or vanished (False)."""


@dataclass(frozen=True, slots=True)
class Load:
    """How a declaration keeps up with what arrives.

    Attributes:
        waiting: queries that have no answer yet; samples and tokens that the callback has not had.
        lost: queries refused for being too many, samples and tokens that were dropped, since the declaration.
    """

    waiting: int = 0
    lost: int = 0


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
            # one wake-up serves a batch: each of them is a system call
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
                # also when a callback has raised: it is not the fault of those that wait behind it
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

    def admit(self, source: str, key: str = "") -> Admission | None:
        """Count a query with a key in, None if there is no room; `source` is the session that it names, or empty."""

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

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        on_query: OnQuery,
        *,
        urgent: bool = False,
        spared: Callable[[str], bool] = no_key,
    ) -> None:
        self._on_query = on_query
        self._spared = spared
        self._capacity = PENDING_URGENT_QUERIES if urgent else PENDING_QUERIES
        self._pending = 0
        self._refused = 0
        # re-entrant: an abandoned query may be collected, and so leave, while this very thread counts
        self._lock = threading.RLock()
        # admission bounds it, so nothing ever gives way
        self._queries = HandOver(loop, self._deliver, PENDING_URGENT_QUERIES, None if urgent else COMMANDS_PER_TURN)

    def admit(self, source: str, key: str = "") -> Admission | None:
        """Count a query in."""
        del source
        with self._lock:
            capacity = self._capacity
            # asked only then, since it parses the key, on Zenoh's thread
            if self._pending >= capacity and self._spared(key):
                capacity = PENDING_URGENT_QUERIES
            if self._pending >= capacity:
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
