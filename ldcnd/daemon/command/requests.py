"""Queries in, answers out: the only place where an exception becomes an error reply."""

import asyncio
from collections.abc import Awaitable, Callable

from ldcnd.daemon.capture.flight_recorder import Journal
from ldcnd.daemon.command.dispatch import Dispatcher
from ldcnd.daemon.line.rig import Rig
from ldcnd.errors import InternalError, LdcndError, ShuttingDown, TooManyRequests, UnknownVerb
from ldcnd.log import LogLimit, get_logger
from ldcnd.messaging.codec import decode, encode, reply_encoding
from ldcnd.messaging.keys import RIG_ITSELF, CommandAddress, Keys
from ldcnd.messaging.session import Declaration, OnQuery, Query, Session
from ldcnd.model.catalogue import BY_VERB, RENAMED
from ldcnd.model.commands import About, Command, Stop, StopReply
from ldcnd.model.frozen import Frozen

log = get_logger("requests")

STOPS_AT_ONCE = 8
"""Maximum number of concurrent stops of the same axes; further ones join."""
PENDING_REQUESTS = 64
"""Maximum number of concurrent commands; stops are not counted."""


class EarlyStops:
    """Takes stops from the moment on at which clients can connect; they wait until there is a daemon to answer them."""

    def __init__(self) -> None:
        self._declarations: list[Declaration] = []
        self._held: list[Query] = []
        self._take: OnQuery = self._held.append

    async def declare(self, session: Session, keys: Keys) -> None:
        """Serve the stops of a rig."""
        for stop in keys.all_stops:
            self._declarations.append(await session.serve(stop, self._pass_on, complete=True, urgent=True))

    def hand_over(self, take: OnQuery) -> list[Declaration]:
        """Give the stops that wait, and all that come from now on, to a daemon; return what it has to close."""
        self._take = take
        held, self._held = self._held, []
        for query in held:
            take(query)
        return self._declarations

    def _pass_on(self, query: Query) -> None:
        self._take(query)


class Requests:
    """Answers the command and stop queries of one rig, each exactly once."""

    def __init__(self, rig: Rig, keys: Keys, group: asyncio.TaskGroup, dispatcher: Dispatcher) -> None:
        self._rig = rig
        self._dispatcher = dispatcher
        self._keys = keys
        self._group = group
        self._journal = Journal(rig)
        self._pending = 0
        self._stops: dict[tuple[str, ...], list[asyncio.Future[tuple[str, ...]]]] = {}
        self._closing = False
        self._refusals_logged = LogLimit(now_s=asyncio.get_running_loop().time)

    def close(self) -> None:
        """Refuse further commands; stops are still taken."""
        self._closing = True

    def on_command(self, query: Query) -> None:
        """Take a query on `@cmd/**`."""
        self._dispatcher.leases.expire()  # before anything that waited while this process or its client was frozen
        if self._pending >= PENDING_REQUESTS:
            self._refuse(
                query,
                TooManyRequests(
                    f"{PENDING_REQUESTS} commands are under way already; nothing was done",
                    limit=PENDING_REQUESTS,
                    remedy="wait for replies before sending more",
                ),
            )
            return
        self._pending += 1
        task = self._group.create_task(self._answer(query, self._command), name=f"command {query.key}")
        task.add_done_callback(self._done)

    def on_stop(self, query: Query) -> None:
        """Take a query on `@stop` or `@stop/<axis>`."""
        self._group.create_task(self._answer(query, self._stop), name=f"stop {query.key}")

    def _done(self, _task: "asyncio.Task[None]") -> None:
        self._pending -= 1

    async def _answer(self, query: Query, run: Callable[[Query], Awaitable[Frozen]]) -> None:
        try:
            reply = await run(query)
        except LdcndError as error:
            self._refuse(query, error)
        except asyncio.CancelledError:
            self._refuse(query, ShuttingDown("the daemon is stopping"))
            raise
        except Exception:
            log.exception("bug while answering", key=query.key)
            self._refuse(query, InternalError("an error inside ldcnd; its log has the details"))
        else:
            query.reply(*encode(reply, reply_encoding(query.encoding)))

    async def _command(self, query: Query) -> Frozen:
        address = self._keys.parse_command(query.key)
        if self._closing:
            raise ShuttingDown("the daemon is stopping", axis=address.axis)
        if address.axis != RIG_ITSELF:
            self._rig.axis(address.axis)  # an unknown axis is refused before an unknown verb
        kind = _command_class(address)
        command = decode(kind, query.payload, query.encoding)
        return await self._dispatcher.answer(address.axis, command, query.login)

    async def _stop(self, query: Query) -> Frozen:
        """Stop even if the payload is nonsense: a stop is always accepted."""
        name = self._keys.parse_stop(query.key)
        names = tuple(self._rig.axes) if name is None else (self._rig.axis(name).config.name,)
        try:
            self._journal.stopped(name)
        except Exception:
            log.exception("stop not recorded", key=query.key)  # it is carried out all the same
        return StopReply(axes=names, confirmed=await self._stop_once(names, query))

    async def _stop_once(self, names: tuple[str, ...], query: Query) -> tuple[str, ...]:
        """Stop axes and return those that confirmed it; in a flood of stops, join one that is under way.

        Hundreds of clients may request a stop at once, and a few stops serve all. Only a stop whose latches still hold
        is joined: since they were set nothing has begun to move, so there is nothing that it does not stop. What joins
        leaves no event of its own.
        """
        under_way = self._stops.setdefault(names, [])
        if len(under_way) >= STOPS_AT_ONCE and self._are_latched(names):
            confirmed = await asyncio.shield(under_way[-1])
            if self._are_latched(names):
                return confirmed
            # a reset that was under way has taken the latch from this stop
        for axis in (self._rig.axis(name) for name in names):
            if axis.stoppable:
                axis.tracker.latch_stop()  # at once, for requests of this same loop iteration
        own: asyncio.Future[tuple[str, ...]] = asyncio.get_running_loop().create_future()
        under_way.append(own)
        try:
            confirmed = await self._rig.stop(names)
        except BaseException:
            own.set_exception(InternalError("the stop that this one had joined was cut short"))
            own.exception()  # perhaps no other stop has joined
            raise
        else:
            own.set_result(confirmed)
            self._enter_stop(query, names, confirmed)
            return confirmed
        finally:
            under_way.remove(own)

    def _enter_stop(self, query: Query, names: tuple[str, ...], confirmed: tuple[str, ...]) -> None:
        """Record the requester of a stop in the events, as far as that can be read; nothing has waited for this."""
        try:
            request = decode(Stop, query.payload, query.encoding)
        except LdcndError:
            request = Stop()
        try:
            self._dispatcher.stopped(names, confirmed, request, query.login)
        except Exception:
            log.exception("stop not entered into the events", key=query.key)

    def _are_latched(self, names: tuple[str, ...]) -> bool:
        axes = (self._rig.axis(name) for name in names)
        return all(axis.tracker.stop_latched or not axis.stoppable for axis in axes)

    def _refuse(self, query: Query, error: LdcndError) -> None:
        if (fields := self._refusals_logged.admit()) is not None:
            log.info("refused", key=query.key, code=error.code.value, reason=error.message, **fields)
        query.refuse(error)


def _command_class(address: CommandAddress) -> type[Command[Frozen]]:
    """Return what a key stands for.

    Raises:
        UnknownVerb: there is no such command.
    """
    axis = None if address.axis == RIG_ITSELF else address.axis
    known = BY_VERB[About.RIG if axis is None else About.AXIS]
    if command := known.get(address.verb):
        return command
    if now := RENAMED.get(address.verb):
        raise UnknownVerb(
            f"the command {address.verb!r} is called {now!r} now", axis=axis, value=address.verb, remedy=f"send {now}"
        )
    whose = "the rig has" if axis is None else "there is"
    raise UnknownVerb(f"{whose} no command {address.verb!r}, only {', '.join(known)}", axis=axis, value=address.verb)
