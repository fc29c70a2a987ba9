"""Reads are answered in the time that nothing else needs: one step for each turn of the loop, clients in turn.

A daemon's description of itself is hundreds of kilobytes, and any client may query it at any rate. A stop or a command
that arrives meanwhile waits for one step, not for the reads that came before it.
"""

import asyncio
import contextlib
import threading
from collections import Counter, deque
from collections.abc import Iterator

from ldcnd.contract.errors import ShuttingDown, TooManyRequests
from ldcnd.net.hand_over import Admission, HandOver, Load, OnRead, Query

READS_OF_A_CLIENT = 64
"""Maximum number of unanswered reads of a named client session; the next is refused with too_many_requests."""

READS_OF_UNNAMED = 256
"""The same for all clients together that do not name their sessions: Zenoh does not tell whose query it is."""

READS_UNANSWERED = 1024
"""The same for all clients together."""

LEAVING_AT_ONCE = 2
"""Maximum number of answers being sent at a time: more threads would only take the interpreter from the loop."""
BLOCKED_S = 0.02
"""An answer that takes longer to leave waits for its client; others need not wait for it."""


class _Read:
    """One read from its admission until its answer has left; an `Admission`."""

    __slots__ = ("intake", "query", "source", "steps")

    def __init__(self, source: str, intake: "ReadIntake") -> None:
        self.source = source
        self.intake = intake
        self.query: Query | None = None
        self.steps: Iterator[None] = iter(())

    def offer(self, query: Query) -> None:
        """Hand the query to its queryable."""
        self.query = query
        self.intake.reads.offer(self)

    def leave(self) -> None:
        """Count the query out."""
        self.intake.left(self)

    def end(self) -> None:
        """Release the query; without an answer by now, it has an internal error."""
        query, self.query, self.steps = self.query, None, iter(())
        if query:
            query.abandon()


class Reads:
    """Answers the reads of one session; its queryables take turns with each other."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._unanswered: Counter[str] = Counter()
        # re-entrant: an abandoned query may be collected, and so leave, while this very thread counts
        self._lock = threading.RLock()
        # admission bounds it, so nothing ever gives way
        self._arrived = HandOver(loop, self._queue, READS_UNANSWERED)
        self._waiting: dict[str, deque[_Read]] = {}
        self._current: _Read | None = None
        self._leaving: set[_Read] = set()
        self._woken = False

    def admit(self, source: str) -> bool:
        """Count a read in, if there is room for one more of its client. Any thread, never blocks."""
        with self._lock:
            if self._unanswered.total() >= READS_UNANSWERED or self._unanswered[source] >= bound_of(source):
                return False
            self._unanswered[source] += 1
            return True

    def offer(self, read: _Read) -> None:
        """Take an admitted read. Any thread, never blocks."""
        self._arrived.offer(read)

    def left(self, read: _Read) -> None:
        """Count a read out. Any thread, never blocks."""
        with self._lock:
            self._unanswered[read.source] -= 1
            if not self._unanswered[read.source]:
                del self._unanswered[read.source]
        with contextlib.suppress(RuntimeError):  # the loop has ended before the thread that answers
            self._loop.call_soon_threadsafe(self._make_room, read)

    def withdraw(self, intake: "ReadIntake") -> list[_Read]:
        """Answer nothing of a queryable any more; return its reads."""
        withdrawn = [read for queue in self._waiting.values() for read in queue if read.intake is intake]
        for read in withdrawn:
            self._waiting[read.source].remove(read)
        if self._current and self._current.intake is intake:
            withdrawn.append(self._current)
            self._current = None
        return withdrawn

    def _queue(self, read: _Read) -> None:
        if read.intake.closed:
            read.intake.refuse(read)
            return
        self._waiting.setdefault(read.source, deque()).append(read)
        self._wake()

    def _make_room(self, read: _Read) -> None:
        self._leaving.discard(read)
        self._wake()

    def _wake(self) -> None:
        if not self._woken:
            self._woken = True
            self._loop.call_soon(self._step)

    def _step(self) -> None:
        """Make one step of one read."""
        self._woken = False
        read = self._current = self._current or self._next()
        if read is None:
            return
        # first: the others get their turns even if this step raises
        self._wake()
        try:
            next(read.steps)
        except StopIteration:
            self._current = None
            self._leaving.add(read)
            self._loop.call_later(BLOCKED_S, self._make_room, read)
            read.end()
        except BaseException:
            self._current = None
            read.end()
            raise

    def _next(self) -> _Read | None:
        """Return the first read of the client whose turn it is, if one may begin."""
        if len(self._leaving) >= LEAVING_AT_ONCE:
            return None
        while self._waiting:
            source, queue = next(iter(self._waiting.items()))
            del self._waiting[source]
            if queue:
                read = queue.popleft()
                self._waiting[source] = queue  # behind the others
                read.intake.begin(read)
                return read
        return None


class ReadIntake:
    """The admission to a queryable that is only read; a `QueryIntake`.

    Attributes:
        reads: of its session.
        closed: nothing is answered any more.
    """

    def __init__(self, reads: Reads, on_read: OnRead) -> None:
        self.reads = reads
        self.closed = False
        self._on_read = on_read
        self._pending: set[_Read] = set()
        self._refused = 0

    def admit(self, source: str, key: str = "") -> Admission | None:  # noqa: ARG002 - of the protocol
        """Count a read in."""
        if not self.reads.admit(source):
            self._refused += 1
            return None
        read = _Read(source, self)
        self._pending.add(read)
        return read

    def refusal(self, key: str, source: str) -> TooManyRequests:
        """Return the error for a read that was not admitted."""
        whose = "of this client" if source else "of clients that do not name their sessions"
        return TooManyRequests(
            f"{key}: {bound_of(source)} reads {whose}, or {READS_UNANSWERED} in all, are unanswered already",
            limit=bound_of(source),
            remedy="wait for answers before asking more, or subscribe",
        )

    def load(self) -> Load:
        """Return how many reads are unanswered, and how many were not admitted."""
        return Load(len(self._pending), self._refused)

    def begin(self, read: _Read) -> None:
        """Prepare the steps of a read."""
        if read.query:
            read.steps = self._on_read(read.query)

    def left(self, read: _Read) -> None:
        """Count a read out. Any thread, never blocks."""
        self._pending.discard(read)
        self.reads.left(read)

    def close(self) -> None:
        """Answer no more reads."""
        self.closed = True
        for read in self.reads.withdraw(self):
            self.refuse(read)

    def refuse(self, read: _Read) -> None:
        """Refuse a read because its queryable is closed."""
        if read.query:
            read.query.refuse(ShuttingDown(f"{read.query.key}: not served any more"))
        read.end()


def bound_of(source: str) -> int:
    """Return how many reads of a client may be unanswered."""
    return READS_OF_A_CLIENT if source else READS_OF_UNNAMED
