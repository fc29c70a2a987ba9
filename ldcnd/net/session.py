"""The contract of a messaging session: what daemon and client need of Zenoh, and nothing else.

Callbacks run on the event loop, one after the other, and must not block. What arrives faster than the loop takes it is
bounded: a subscription keeps its newest samples, a queryable refuses what is too much.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple

from ldcnd.contract.health import CertificateHealth
from ldcnd.net.hand_over import Answer, Load, OnQuery, OnRead, OnToken, no_key

UNDELIVERED_SAMPLES = 64
"""Maximum number of samples that a subscription keeps for its callback; the oldest is dropped."""

QUERY_TIMEOUT_S = 2.0
"""Default time that a client waits for the answers to a query, seconds."""

REHEARSALS: set[asyncio.AbstractEventLoop] = set()
"""Loops of this process on which a program is rehearsed: while there is one, no other loop reaches a real network."""
NO_PARAMETERS: Mapping[str, str] = MappingProxyType({})


class Qos(StrEnum):
    """How a sample travels; none of them ever makes the publisher wait."""

    TELEMETRY = "telemetry"
    """Periodic values: dropped when the network is full, the next one is on its way."""
    EVENT = "event"
    """State changes and faults: overtake telemetry."""
    BULK = "bulk"
    """Traces: only what bandwidth is left."""


class SampleKind(StrEnum):
    """The kind of a change of a key."""

    PUT = "put"
    DELETE = "delete"


class Publication(NamedTuple):
    """A value that was published, or the deletion of a key; a tuple, as recorders take 50,000 a second."""

    key: str
    payload: bytes
    encoding: str
    kind: SampleKind
    measured_at_ns: int | None
    """When the value was true, UTC in ns since 1970; when it was sent if not given; None without a time stamp."""
    source: str = ""
    """The session that has published it, as in the `source` of an `Answer`; empty when it does not say."""


OnSample = Callable[[Publication], None]
PublishValue = Callable[[bytes, int], None]
"""Publishes a payload, true at that instant, UTC in ns since 1970."""


class Declaration:
    """Something that a session has made known to the network; made by its session."""

    def __init__(self, undeclare: Callable[[], Awaitable[None]], load: Callable[[], Load] = Load) -> None:
        self._undeclare = undeclare
        self._load = load
        self._closed = False

    @property
    def load(self) -> Load:
        """How it keeps up."""
        return self._load()

    async def close(self) -> None:
        """Take it back; safe to call twice. No callback runs afterwards, undelivered queries are refused."""
        if not self._closed:
            self._closed = True
            await self._undeclare()


class Session(ABC):
    """One participant in the network. Closing it undeclares everything that it has declared.

    After `close` every other method raises `SessionError`.

    Attributes:
        certificate: the one that it was opened with and that ends first; None where it uses none.
    """

    certificate: CertificateHealth | None = None

    @abstractmethod
    def publish(
        self,
        key: str,
        payload: bytes,
        *,
        encoding: str,
        qos: Qos,
        measured_at_ns: int | None = None,
        attachment: bytes | None = None,
    ) -> None:
        """Publish a value without waiting; what the network cannot take is dropped.

        Args:
            key: a concrete key.
            payload: the value.
            encoding: of the payload.
            qos: how it travels; one for all values of a key keeps them in order.
            measured_at_ns: when the value was true, UTC in ns since 1970; the time of sending when missing.
            attachment: what accompanies it, for other systems that need that.
        """

    @abstractmethod
    def publisher(self, key: str, *, encoding: str, qos: Qos) -> PublishValue:
        """Return what publishes the values of one key without waiting, for keys that get many.

        Args:
            key: a concrete key.
            encoding: of every payload.
            qos: as of `publish`.
        """

    @abstractmethod
    def delete(self, key: str) -> None:
        """Say, without waiting, that a key has no value any more."""

    @abstractmethod
    async def serve(
        self,
        key: str,
        on_query: OnQuery,
        *,
        complete: bool,
        urgent: bool = False,
        spared: Callable[[str], bool] = no_key,
    ) -> Declaration:
        """Answer the queries that match a key expression.

        Args:
            key: the expression.
            on_query: takes a query; if it raises, the query is answered with an internal error.
            complete: this session alone can answer everything below the key, so only one such session is queried.
            urgent: answers do not queue behind the answers of other declarations, and the number of queries that may be
                unanswered is so large that none is refused in practice.
            spared: tells of a query's key, on any thread, whether it is refused as late as an urgent one.
        """

    @abstractmethod
    async def serve_reads(self, key: str, on_read: OnRead, *, complete: bool) -> Declaration:
        """Answer queries that only read, in steps, whenever the loop has nothing else to do.

        One step is made for each turn of the loop, for one client after the other: reading delays a command or a stop
        by one step at most, however much is read. Answers leave on threads of their own: a client that does not take
        them holds up no command.

        Args:
            key: the expression.
            on_read: answers a query; if it raises, the query is answered with an internal error.
            complete: as for `serve`.
        """

    @abstractmethod
    async def subscribe(
        self, key: str, on_sample: OnSample, kept: int = UNDELIVERED_SAMPLES, *, linger_s: float = 0.0
    ) -> Declaration:
        """Take the samples that match a key expression; the oldest are lost when the loop is too slow.

        Args:
            key: the expression.
            on_sample: takes a sample.
            kept: maximum number of samples that wait for the loop.
            linger_s: how long a sample may wait for others; for subscriptions with very many samples.
        """

    @abstractmethod
    async def query(
        self,
        key: str,
        payload: bytes = b"",
        *,
        encoding: str = "",
        parameters: Mapping[str, str] = NO_PARAMETERS,
        timeout_s: float = QUERY_TIMEOUT_S,
        urgent: bool = False,
        everyone: bool = False,
        in_order: bool = False,
    ) -> list[Answer]:
        """Send a query, and return all answers; none when there is no queryable or access control forbids it.

        Args:
            key: a key or an expression with wildcards.
            payload: the request.
            encoding: of the payload.
            parameters: of the selector; neither `;` nor `=` nor `|` in names and values.
            timeout_s: how long to wait for the last answer; what has arrived by then is returned.
            urgent: overtakes everything else on its way, for stops.
            everyone: ask all that match, also where one of them can answer everything.
            in_order: overtakes none of those that were asked before and are in order, too.

        Raises:
            OutcomeUnknown: no answer came in time; the query may be carried out all the same, even later.
        """

    @abstractmethod
    async def declare_token(self, key: str) -> Declaration:
        """Show a liveliness token; it vanishes with its declaration, with the session and with the process."""

    @abstractmethod
    async def watch_tokens(self, key: str, on_token: OnToken) -> Declaration:
        """Learn of the tokens that match a key expression, first of those that are there, this session's included."""

    @abstractmethod
    async def close(self) -> None:
        """Leave the network within 3 s, whatever the others do; safe to call twice."""
