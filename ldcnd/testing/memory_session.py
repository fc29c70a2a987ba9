"""Sessions inside one process, for tests in virtual time: the broker stands in for the whole network.

Keys match, queries are routed and tokens appear as with Zenoh; there is no latency and no loss but what the bounded
hand-over loses. Not modelled: access control, network faults, and the default choice of the nearest queryable.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count

from ldcnd.contract.errors import OutcomeUnknown, SessionError
from ldcnd.contract.keys import matches
from ldcnd.net.hand_over import (
    Admission,
    Answer,
    HandOver,
    Intake,
    Load,
    OnQuery,
    OnRead,
    OnToken,
    Query,
    QueryIntake,
    TokenChanges,
    no_key,
)
from ldcnd.net.reads import ReadIntake, Reads
from ldcnd.net.session import (
    NO_PARAMETERS,
    QUERY_TIMEOUT_S,
    UNDELIVERED_SAMPLES,
    Declaration,
    OnSample,
    Publication,
    PublishValue,
    Qos,
    SampleKind,
    Session,
)


@dataclass(eq=False, slots=True)
class _Queryable:
    key: str
    intake: QueryIntake
    complete: bool
    source: str


@dataclass(eq=False, slots=True)
class _Subscription:
    key: str
    samples: HandOver[Publication]


@dataclass(eq=False, slots=True)
class _TokenWatch:
    key: str
    changes: TokenChanges


@dataclass(eq=False, slots=True)
class _Pending:
    """A query under way: the answers of its queryables."""

    awaited: int
    done: asyncio.Future[None]
    answers: list[Answer] = field(default_factory=list)

    def take(self, answers: tuple[Answer, ...]) -> None:
        self.answers.extend(answers)
        self.awaited -= 1
        if not self.awaited and not self.done.done():
            self.done.set_result(None)


class MemoryBroker:
    """The network that its sessions share."""

    def __init__(self) -> None:
        self.queryables: list[_Queryable] = []
        self.subscriptions: list[_Subscription] = []
        self.watches: list[_TokenWatch] = []
        self.tokens: list[str] = []
        self.numbers = count(1)

    @asynccontextmanager
    async def session(
        self, login: str | None = None, *, overhear: OnSample | None = None
    ) -> AsyncIterator["MemorySession"]:
        """Join the network for as long as the context lasts.

        Args:
            login: stands in for a certificate.
            overhear: gets every sample that the session publishes, at once and without losing any.
        """
        session = MemorySession(self, login, overhear)
        try:
            yield session
        finally:
            await session.close()

    def asked(self, key: str, *, everyone: bool = False) -> list[_Queryable]:
        """Return who is to answer a query: one complete queryable if there is any, otherwise all that match.

        A complete queryable answers alone only for a key without wildcards; what it covers of others is not worked out.
        """
        found = [queryable for queryable in self.queryables if matches(queryable.key, key)]
        complete = [queryable for queryable in found if queryable.complete and "*" not in key and not everyone]
        return complete[:1] or found

    def show_token(self, key: str) -> None:
        """Tell the watches of a token, unless another session shows the same."""
        if key not in self.tokens:
            self._tell(key, alive=True)
        self.tokens.append(key)

    def withdraw_token(self, key: str) -> None:
        """Tell the watches that a token is gone, unless another session shows the same."""
        self.tokens.remove(key)
        if key not in self.tokens:
            self._tell(key, alive=False)

    def _tell(self, key: str, *, alive: bool) -> None:
        for watch in self.watches:
            if matches(watch.key, key):
                watch.changes.offer(key, alive=alive)


class MemorySession(Session):
    """One participant; made by `MemoryBroker.session`."""

    def __init__(self, broker: MemoryBroker, login: str | None = None, overhear: OnSample | None = None) -> None:
        self._broker = broker
        self._login = login
        self._overhear = overhear
        self._loop = asyncio.get_running_loop()
        self._declarations: list[Declaration] = []
        self._reads = Reads(self._loop)
        self._name = f"session {next(broker.numbers)}"  # as with Zenoh none is used again
        self._closed = False

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
        """Offer the sample to every subscription that matches; quality of service makes no difference here."""
        del qos, attachment
        if self._closed or self._broker.subscriptions or self._overhear:
            self._offer(Publication(key, payload, encoding, SampleKind.PUT, measured_at_ns, self._name))

    def publisher(self, key: str, *, encoding: str, qos: Qos) -> PublishValue:
        """Return what publishes the values of one key."""
        del qos
        broker = self._broker

        def publish(payload: bytes, measured_at_ns: int) -> None:
            if self._closed or broker.subscriptions or self._overhear:
                self._offer(Publication(key, payload, encoding, SampleKind.PUT, measured_at_ns, self._name))

        return publish

    def delete(self, key: str) -> None:
        """Offer the deletion to every subscription that matches."""
        self._offer(Publication(key, b"", "", SampleKind.DELETE, None, self._name))

    async def serve(
        self,
        key: str,
        on_query: OnQuery,
        *,
        complete: bool,
        urgent: bool = False,
        spared: Callable[[str], bool] = no_key,
    ) -> Declaration:
        """Answer queries; nothing is in the way of an answer here, so urgent only means not to be refused."""
        return self._serve(key, Intake(self._loop, on_query, urgent=urgent, spared=spared), complete=complete)

    async def serve_reads(self, key: str, on_read: OnRead, *, complete: bool) -> Declaration:
        """Answer queries in steps."""
        return self._serve(key, ReadIntake(self._reads, on_read), complete=complete)

    def _serve(self, key: str, intake: QueryIntake, *, complete: bool) -> Declaration:
        self._must_be_open()
        queryable = _Queryable(key, intake, complete, self._name)

        def undeclare() -> None:
            self._broker.queryables.remove(queryable)
            queryable.intake.close()

        self._broker.queryables.append(queryable)
        return self._declared(undeclare, queryable.intake.load)

    async def subscribe(
        self, key: str, on_sample: OnSample, kept: int = UNDELIVERED_SAMPLES, *, linger_s: float = 0.0
    ) -> Declaration:
        """Take samples, at once however long they may linger."""
        del linger_s
        self._must_be_open()
        samples = HandOver(self._loop, on_sample, kept)
        subscription = _Subscription(key, samples)

        def undeclare() -> None:
            self._broker.subscriptions.remove(subscription)
            samples.close()

        self._broker.subscriptions.append(subscription)
        return self._declared(undeclare, samples.load)

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
        """Query the queryables of the key; nothing is overtaken, because nothing waits on its way."""
        del urgent, in_order
        self._must_be_open()
        asked = self._broker.asked(key, everyone=everyone)
        if not asked:
            return []
        pending = _Pending(len(asked), self._loop.create_future())
        for queryable in asked:
            if admission := queryable.intake.admit(self._name, key):
                send = partial(_answer, pending, admission, queryable.source)
                admission.offer(Query(key, parameters, payload, encoding, send, lambda: self._login))
            else:
                refusal = queryable.intake.refusal(key, self._name)
                Query(key, parameters, payload, encoding, pending.take).refuse(refusal)
        try:
            async with asyncio.timeout(timeout_s):
                await pending.done
        except TimeoutError:
            if not pending.answers:
                raise OutcomeUnknown(
                    f"{key}: no answer within {timeout_s:g} s; it may be carried out all the same"
                ) from None
        return list(pending.answers)

    async def declare_token(self, key: str) -> Declaration:
        """Show a token."""
        self._must_be_open()
        self._broker.show_token(key)
        return self._declared(partial(self._broker.withdraw_token, key))

    async def watch_tokens(self, key: str, on_token: OnToken) -> Declaration:
        """Learn of tokens."""
        self._must_be_open()
        watch = _TokenWatch(key, TokenChanges(self._loop, on_token))

        def undeclare() -> None:
            self._broker.watches.remove(watch)
            watch.changes.close()

        self._broker.watches.append(watch)
        for token in dict.fromkeys(self._broker.tokens):
            if matches(key, token):
                watch.changes.offer(token, alive=True)
        return self._declared(undeclare, watch.changes.load)

    async def close(self) -> None:
        """Leave the network."""
        self._closed = True
        for declaration in tuple(self._declarations):
            await declaration.close()

    def _offer(self, sample: Publication) -> None:
        if self._closed:
            raise SessionError("the session is closed")
        if self._overhear and sample.kind is SampleKind.PUT:
            self._overhear(sample)
        for subscription in self._broker.subscriptions:
            if matches(subscription.key, sample.key):
                subscription.samples.offer(sample)

    def _declared(self, undeclare: Callable[[], None], load: Callable[[], Load] = Load) -> Declaration:
        async def take_back() -> None:
            self._declarations.remove(declaration)
            undeclare()

        declaration = Declaration(take_back, load)
        self._declarations.append(declaration)
        return declaration

    def _must_be_open(self) -> None:
        if self._closed:
            raise SessionError("the session is closed")


def _answer(pending: _Pending, admission: Admission, source: str, answers: tuple[Answer, ...]) -> None:
    admission.leave()
    pending.take(tuple(replace(answer, source=source) for answer in answers))
