"""The session on a real Zenoh network; with `zenoh_config` and `zenoh_values`, the only module that uses zenoh.

Zenoh calls back on its own threads: there, items are handed over to the loop and nothing else happens, because one
blocked callback holds up everything that comes over the same link. What may block on a peer that does not read runs on
worker threads; a publication drops instead of blocking. Answers to stops, to commands and to reads have threads of
their own each, and refusals have a single slow one: a peer that does not read, or sends too much, delays its own kind.

Source: behaviour of eclipse-zenoh 1.10.2, measured.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import Generic, Protocol, TypeVar

import zenoh
from zenoh.handlers import Callback, RingChannel

from ldcnd.contract.codec import Encoding, encode, error_reply
from ldcnd.contract.errors import NotSupported, SessionError, ValueOutOfRange
from ldcnd.log import LogLimit, get_lazy_logger
from ldcnd.net import zenoh_failures
from ldcnd.net.hand_over import (
    Answer,
    Collector,
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
from ldcnd.net.login_probe import refusals, unresolved
from ldcnd.net.reads import ReadIntake, Reads
from ldcnd.net.session import (
    NO_PARAMETERS,
    QUERY_TIMEOUT_S,
    REHEARSALS,
    UNDELIVERED_SAMPLES,
    Declaration,
    OnSample,
    PublishValue,
    Qos,
    Session,
)
from ldcnd.net.workers import Workers
from ldcnd.net.zenoh_config import certificate_in_use, endpoints, root_certificate, share_sockets, zenoh_config
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.net.zenoh_threads import provide_threads
from ldcnd.net.zenoh_values import TRAVEL, Stamps, to_answers, to_sample, to_stamp
from ldcnd.printable import printable

__all__ = ["ZenohSession", "ZenohSettings", "open_zenoh_session"]

log = get_lazy_logger("zenoh")
_LOST_ANSWERS = LogLimit()

OPEN_TIME_S = 10.0
DECLARE_TIME_S = 5.0
DRAIN_TIME_S = 1.0
"""Maximum time for given answers to leave on closing, seconds."""
CLOSE_TIME_S = 1.5
"""Maximum time for Zenoh's close after that, seconds; with a frozen, congested peer it takes 12 s, and is abandoned."""
QUERY_GRACE_S = 0.5
"""Zenoh ends a query at its time-out; after this further time the query counts as lost, seconds."""

ANSWER_THREADS = 64
"""Threads that may wait at the same time for clients that do not take answers to stops, to commands, to reads."""
OTHER_THREADS = 16
"""The same for declarations and questions of this session."""
REFUSALS_WAITING = 4096
"""Maximum number of waiting refusals; beyond this, an excess query ends without an answer."""
REFUSAL_PAUSE_S = 0.001
"""Pause between refusals, seconds; limits the load of a client that repeats a query as soon as it is refused."""


class _Undeclarable(Protocol):
    def undeclare(self) -> None: ...


@asynccontextmanager
async def open_zenoh_session(settings: ZenohSettings) -> AsyncIterator[Session]:
    """Join the network for as long as the context lasts; a loop that brings a network of its own has none other.

    Raises:
        NotSupported: a program is rehearsed in this process, on another loop: this one would reach a real rig.
        ConfigError: Zenoh does not accept a setting or the configuration file.
        SessionError: an endpoint cannot be used; says which and what to do.
    """
    if own := getattr(asyncio.get_running_loop(), "network", None):  # of a rehearsal
        async with own() as session:
            yield session
            return
    if REHEARSALS:
        raise NotSupported(
            "a program is rehearsed in this process, and this would reach a real network",
            remedy="use `rig.client` there, or run a program that blocks by `await rig.run_blocking(program)`",
        )
    config = zenoh_config(settings)
    # before Zenoh reads it: a file that is replaced then counts as the old one
    certificate = certificate_in_use(config)
    listen, connect = endpoints(config, "listen"), endpoints(config, "connect")
    # only who listens serves many: a client that connects keeps Zenoh's single sending thread
    if listen:
        provide_threads()
    workers = Workers("zenoh open", 1)
    try:
        entity = await workers.run(partial(zenoh.open, config), OPEN_TIME_S, zenoh.Session.close)
    except zenoh.ZError as error:
        about_connecting = zenoh_failures.is_about_connecting(str(error))
        if about_connecting and (refused := await refusals(connect, root_certificate(config))):
            raise zenoh_failures.login_refused(refused, certificate, time.time_ns()) from error
        unknown = await unresolved(connect) if about_connecting else ()
        raise zenoh_failures.opening_failed(str(error), listen, connect, unknown) from error
    except TimeoutError:
        raise zenoh_failures.opening_timed_out(OPEN_TIME_S, listen, connect) from None
    finally:
        await workers.stop(DRAIN_TIME_S)
    session = ZenohSession(entity)
    session.certificate = certificate
    try:
        share_sockets(listen)
        yield session
    finally:
        await session.close()


@dataclass(slots=True)
class _Outlet:
    """The way out of one key; its publisher is declared in the background after the first sample."""

    qos: Qos
    encoding: str | None = None
    publisher: zenoh.Publisher | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Declared:
    """Holds references to the declarations, because Zenoh undeclares what is garbage collected."""

    entity: _Undeclarable
    stop: Callable[[], object]


class ZenohSession(Session):
    """One participant; made by `open_zenoh_session`."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._loop = asyncio.get_running_loop()
        self._workers = Workers("zenoh", OTHER_THREADS)
        self._ordered_workers = Workers("zenoh in order", 1)  # a single thread: nothing that it sends is overtaken
        self._urgent_workers = Workers("zenoh stops", ANSWER_THREADS)
        self._command_workers = Workers("zenoh commands", ANSWER_THREADS)
        self._read_workers = Workers("zenoh reads", ANSWER_THREADS)
        self._refusals = Workers("zenoh refusals", 1)
        self._reads = Reads(self._loop)
        self._declared: list[_Declared] = []
        self._outlets: dict[str, _Outlet] = {}
        self._logins: dict[str, str | None] = {}
        self._link_changes: object = None  # the listener, once a login was asked for
        self._stamps = Stamps(session.new_timestamp().get_id())
        # a query or sample does not tell its sender otherwise; the number, which nobody reads, is 0
        self._source_info = zenoh.SourceInfo(session.id, 0)
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
        """Publish; cheaper once the key's publisher is declared, which happens in the background."""
        self._must_be_open()
        timestamp = self._stamps.of(measured_at_ns)
        outlet = self._outlets.get(key) or self._new_outlet(key, qos)
        try:
            # a declared publisher has one quality of service for all that it sends
            declared = outlet.publisher if outlet.qos is qos else None
            put = declared.put if declared else partial(self._session.put, key, **TRAVEL[qos])
            put(payload, encoding=encoding, timestamp=timestamp, attachment=attachment, source_info=self._source_info)
        except zenoh.ZError as error:
            raise SessionError(f"{key}: cannot publish: {error}") from error

    def publisher(self, key: str, *, encoding: str, qos: Qos) -> PublishValue:
        """Return what publishes the values of one key; one call for each, as five belong to every poll."""
        outlet = _Outlet(qos, encoding)
        stamps, session, travel, source_info = self._stamps, self._session, TRAVEL[qos], self._source_info

        def publish(payload: bytes, measured_at_ns: int) -> None:
            if self._closed:
                raise SessionError("the session is closed")
            timestamp = stamps.latest if measured_at_ns == stamps.at_ns else stamps.of(measured_at_ns)
            try:
                if outlet.publisher is not None:
                    outlet.publisher.put(payload, timestamp=timestamp, source_info=source_info)
                    return
                session.put(key, payload, encoding=encoding, timestamp=timestamp, source_info=source_info, **travel)
            except zenoh.ZError as error:
                raise SessionError(f"{key}: cannot publish: {error}") from error
            if key not in self._outlets:
                self._declare_outlet(key, outlet)

        return publish

    def delete(self, key: str) -> None:
        """Say that a key has no value any more, in order with its values."""
        self._must_be_open()
        outlet = self._outlets.get(key)
        try:
            # as its values, because Zenoh keeps the order of one priority only
            self._session.delete(key, source_info=self._source_info, **TRAVEL[outlet.qos if outlet else Qos.EVENT])
        except zenoh.ZError as error:
            raise SessionError(f"{key}: cannot delete: {error}") from error

    async def serve(
        self,
        key: str,
        on_query: OnQuery,
        *,
        complete: bool,
        urgent: bool = False,
        spared: Callable[[str], bool] = no_key,
    ) -> Declaration:
        """Answer queries."""
        workers = self._urgent_workers if urgent else self._command_workers
        intake = Intake(self._loop, on_query, urgent=urgent, spared=spared)
        return await self._serve(key, intake, workers, complete=complete)

    async def serve_reads(self, key: str, on_read: OnRead, *, complete: bool) -> Declaration:
        """Answer queries in steps."""
        return await self._serve(key, ReadIntake(self._reads, on_read), self._read_workers, complete=complete)

    async def _serve(self, key: str, intake: QueryIntake, workers: Workers, *, complete: bool) -> Declaration:
        def take(asked: zenoh.Query) -> None:
            source = asked.source_info
            # any client can put any session here, or none: it bounds and records, and permits nothing
            named = "" if source is None else str(source.source_id.zid)
            key = str(asked.key_expr)
            # first: a query for which there is no room costs this thread no copy of its payload
            admission = intake.admit(named, key)
            if admission is None:
                # beyond the bound the query ends here, which may hold up the links that share this thread
                if self._refusals.waiting < REFUSALS_WAITING:
                    self._refusals.submit(partial(self._refuse, asked, intake, named))
                return
            path = _AnswerPath(asked, workers, self._stamps.stamp_id, admission.leave)
            admission.offer(
                Query(
                    key=key,
                    parameters=dict(asked.parameters),  # type: ignore[call-overload] # its stub has no true iterator
                    payload=b"" if asked.payload is None else asked.payload.to_bytes(),
                    encoding="" if asked.encoding is None else str(asked.encoding),
                    send=path.send,
                    login=partial(self._login_of, named),
                )
            )

        return await self._declare(
            # called on Zenoh's thread: the default starts a thread of Python for each declaration
            lambda: self._session.declare_queryable(key, Callback(take, indirect=False), complete=complete),
            intake.close,
            intake.load,
        )

    def _refuse(self, asked: zenoh.Query, intake: QueryIntake, source: str) -> None:
        """Refuse a query that was not admitted; on the thread for refusals, one after the other."""
        path = _AnswerPath(asked, self._refusals, self._stamps.stamp_id, lambda: None)
        key = str(asked.key_expr)
        path.answer((Answer(key, *encode(error_reply(intake.refusal(key, source)), Encoding.JSON), is_error=True),))
        # not on closing: thousands may wait, and they have `DRAIN_TIME_S` in all
        if not self._closed:
            time.sleep(REFUSAL_PAUSE_S)

    async def subscribe(
        self, key: str, on_sample: OnSample, kept: int = UNDELIVERED_SAMPLES, *, linger_s: float = 0.0
    ) -> Declaration:
        """Take samples."""
        if linger_s:
            return await self._sweep(key, on_sample, kept, linger_s)
        samples = HandOver(self._loop, on_sample, kept)

        def take(sample: zenoh.Sample) -> None:
            samples.offer(to_sample(sample))

        return await self._declare(
            lambda: self._session.declare_subscriber(key, Callback(take, indirect=False)),
            samples.close,
            samples.load,
        )

    async def _sweep(self, key: str, on_sample: OnSample, kept: int, period_s: float) -> Declaration:
        """Poll for samples periodically: Zenoh's threads then need not run any Python."""
        found: list[zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]] = []

        def declare() -> _Undeclarable:
            # a ring drops its oldest; a full FIFO would block Zenoh's thread, and what comes behind it on the same link
            found.append(self._session.declare_subscriber(key, RingChannel(kept)))
            return found[0]

        sweep = Sweep[zenoh.Sample](self._loop, lambda sample: on_sample(to_sample(sample)), period_s, kept)
        declaration = await self._declare(declare, sweep.close)
        sweep.begin(found[0].try_recv)
        return Declaration(partial(sweep.end, declaration.close))

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
        """Send a query, to one complete queryable or to all the others, or to everyone; repeated answers are kept."""
        self._must_be_open()
        if timeout_s <= 0:
            raise ValueOutOfRange(f"{key}: a query needs time; {timeout_s:g} s is none", value=timeout_s, limit=0)
        collector = Collector[zenoh.Reply](self._loop)
        token = zenoh.CancellationToken()
        workers = self._urgent_workers if urgent else self._ordered_workers if in_order else self._workers

        def ask() -> None:
            self._session.get(
                zenoh.Selector(key, dict(parameters)),
                Callback(collector.take, collector.end, indirect=False),
                # BEST_MATCHING asks one complete queryable only: of two daemons by mistake one carries a command out
                target=zenoh.QueryTarget.ALL if everyone else zenoh.QueryTarget.BEST_MATCHING,
                # Zenoh's default keeps one reply for each key: that of another daemon would be hidden
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                priority=zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.INTERACTIVE_HIGH,
                # "not batched during transmission, in order to reduce latency" (zenoh, `Sample.express`)
                express=True,
                payload=payload if payload or encoding else None,
                encoding=encoding or None,
                cancellation_token=token,
                source_info=self._source_info,
            )

        try:
            async with asyncio.timeout(timeout_s + QUERY_GRACE_S):
                # on a worker: a query that the link cannot take blocks, it is never dropped
                await workers.run(ask, timeout_s, lambda _: None)
                await collector.done.wait()
        except zenoh.ZError as error:
            raise SessionError(f"{key}: cannot query: {error}") from error
        except TimeoutError:
            if not collector.items:
                raise zenoh_failures.no_answer(key, timeout_s) from None
        finally:
            if not collector.done.is_set():
                # waits for a callback that is running, so not here
                workers.submit(token.cancel)
        return to_answers(key, collector.items, timeout_s)

    async def declare_token(self, key: str) -> Declaration:
        """Show a token."""
        return await self._declare(lambda: self._session.liveliness().declare_token(key), lambda: None)

    async def watch_tokens(self, key: str, on_token: OnToken) -> Declaration:
        """Learn of tokens."""
        changes = TokenChanges(self._loop, on_token)

        def take(sample: zenoh.Sample) -> None:
            changes.offer(str(sample.key_expr), alive=sample.kind == zenoh.SampleKind.PUT)

        return await self._declare(
            lambda: self._session.liveliness().declare_subscriber(key, Callback(take, indirect=False), history=True),
            changes.close,
            changes.load,
        )

    async def close(self) -> None:
        """Refuse what was not begun, send the answers there are, leave; what Zenoh cannot finish is left to itself."""
        # with the session all its declarations have gone
        if self._closed:
            return
        self._closed = True
        # first: what was not begun is refused, and the refusals still find their workers
        for declared in self._declared:
            declared.stop()
        closer = Workers("zenoh close", 1)
        try:
            async with asyncio.TaskGroup() as group:
                answering = (self._urgent_workers, self._command_workers, self._read_workers, self._refusals)
                for workers in (*answering, self._workers, self._ordered_workers):
                    group.create_task(workers.stop(DRAIN_TIME_S), name="drain")
        finally:
            try:
                await closer.run(self._session.close, CLOSE_TIME_S, lambda _: None)
            except (TimeoutError, zenoh.ZError) as error:
                log.warning("left the network without a goodbye", reason=str(error) or "a peer takes nothing")
            finally:
                self._declared.clear()
                self._link_changes = None
                await closer.stop(DRAIN_TIME_S / 10)

    async def _declare(
        self, make: Callable[[], _Undeclarable], stop: Callable[[], object], load: Callable[[], Load] = Load
    ) -> Declaration:
        self._must_be_open()
        try:
            # one that comes into being too late is nobody's, and would go on being served
            entity = await self._workers.run(make, DECLARE_TIME_S, lambda late: late.undeclare())
        except zenoh.ZError as error:
            raise SessionError(f"cannot declare: {error}") from error
        except TimeoutError:
            raise SessionError(f"cannot declare within {DECLARE_TIME_S:g} s: a peer takes nothing") from None
        self._declared.append(declared := _Declared(entity, stop))
        return Declaration(partial(self._undeclare, declared), load)

    async def _undeclare(self, declared: _Declared) -> None:
        """Take a declaration back, then stop its callback: what arrives in between is still served."""
        if self._closed:
            return
        self._declared.remove(declared)
        try:
            await self._workers.run(declared.entity.undeclare, DECLARE_TIME_S, lambda _: None)
        except (TimeoutError, zenoh.ZError) as error:
            log.warning("declaration not undeclared", reason=str(error) or "a peer takes nothing")
        finally:
            declared.stop()

    def _login_of(self, source: str) -> str | None:
        """Return who is at the other end of the link to the session that a query names.

        A command waits for this, and Zenoh takes longer to list its links than the command to be decoded: what they
        show is kept until one of them comes or goes.
        """
        if source in self._logins:
            return self._logins[source]
        if not source or self._closed:
            return None
        if self._link_changes is None:  # before the links are listed, so that no change is missed
            forget = Callback(self._forget_logins, indirect=False)
            self._link_changes = self._session.info.declare_link_events_listener(forget)
        for link in self._session.info.links():
            login = link.auth_identifier
            self._logins[str(link.zid)] = login if login is None else printable(login)
        return self._logins.get(source)

    def _forget_logins(self, _: zenoh.LinkEvent) -> None:
        self._logins.clear()

    def _new_outlet(self, key: str, qos: Qos) -> _Outlet:
        return self._declare_outlet(key, _Outlet(qos))

    def _declare_outlet(self, key: str, outlet: _Outlet) -> _Outlet:
        self._outlets[key] = outlet

        def declare() -> None:
            try:
                outlet.publisher = self._session.declare_publisher(key, encoding=outlet.encoding, **TRAVEL[outlet.qos])
            except zenoh.ZError as error:
                log.debug("publisher not declared", key=key, reason=str(error))

        # a declaration can block on a peer that takes nothing; until it is made, values go by `Session.put`
        self._workers.submit(declare)
        return outlet

    def _must_be_open(self) -> None:
        if self._closed:
            raise SessionError("the session is closed")


@dataclass(frozen=True, slots=True)
class _AnswerPath:
    """The way of the answers to one query: from the loop to a worker, and from there to Zenoh."""

    asked: zenoh.Query
    workers: Workers
    stamp_id: zenoh.TimestampId
    on_gone: Callable[[], None]

    def send(self, answers: tuple[Answer, ...]) -> None:
        self.workers.submit(partial(self.answer, answers))

    def answer(self, answers: tuple[Answer, ...]) -> None:
        """Answer and end the query; takes as long as the client needs to read, until Zenoh closes its link."""
        asked = self.asked
        try:
            for answer in answers:
                if answer.is_error:
                    # with no quality of service: Zenoh ignores it here, a reply travels as its query did
                    asked.reply_err(answer.payload, encoding=answer.encoding)
                else:
                    stamp = to_stamp(answer.measured_at_ns, self.stamp_id)
                    asked.reply(answer.key, answer.payload, encoding=answer.encoding, timestamp=stamp)
            # the client waits until the query is dropped, and Python may keep it for longer than this
            asked.drop()  # type: ignore[no-untyped-call] # the stub leaves its result open
        except zenoh.ZError as error:
            if (fields := _LOST_ANSWERS.admit()) is not None:
                log.warning("answer lost", reason=str(error), **fields)
        finally:
            self.on_gone()


ItemT = TypeVar("ItemT")


class Sweep(Generic[ItemT]):
    """Empties a queue periodically, on the loop.

    Args:
        loop: the loop.
        deliver: takes each item.
        period_s: how often the queue is emptied.
        most: maximum number of items at a time; the rest comes next time, so that others get their turn.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, deliver: Callable[[ItemT], None], period_s: float, most: int
    ) -> None:
        self._loop = loop
        self._deliver = deliver
        self._period_s = period_s
        self._most = most
        self._timer: asyncio.TimerHandle | None = None

    def begin(self, take: Callable[[], ItemT | None]) -> None:
        """Empty the queue of which `take` returns the next item, or None when there is none."""
        self._timer = self._loop.call_later(self._period_s, self._empty, take)

    def close(self) -> None:
        """Deliver no more."""
        if self._timer:
            self._timer.cancel()

    async def end(self, take_back: Callable[[], Awaitable[None]]) -> None:
        """Deliver no more, then undeclare the queue: one that is gone cannot be read."""
        self.close()
        await take_back()

    def _empty(self, take: Callable[[], ItemT | None]) -> None:
        self.begin(take)  # first, because `deliver` may close
        for _ in range(self._most):
            item = take()
            if item is None:
                return
            self._deliver(item)
