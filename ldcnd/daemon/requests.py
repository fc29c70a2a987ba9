"""Queries of clients, each of which is answered exactly once; here alone an exception becomes an error reply.

A command goes to the dispatcher, which admits it and has its axis carry it out. A stop waits for no admission: its
latches are set before its packets are sent, and its requester is entered behind them.
"""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from functools import partial

from ldcnd.axis.events import StopLatch
from ldcnd.axis.kept import LATCHES
from ldcnd.axis.stopping import OwnStop
from ldcnd.contract.catalogue import BY_VERB, RENAMED
from ldcnd.contract.codec import decode, encode, reply_encoding, understand
from ldcnd.contract.commands import (
    About,
    Command,
    Stop,
    StopReply,
)
from ldcnd.contract.errors import (
    InternalError,
    LdcndError,
    OutcomeUnknown,
    ShuttingDown,
    TooManyRequests,
    UnknownVerb,
)
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import RIG_ITSELF, CommandAddress, Keys
from ldcnd.contract.samples import Moving
from ldcnd.daemon.dispatch import Dispatcher
from ldcnd.daemon.journal import Journal
from ldcnd.daemon.rig import OwnedRig
from ldcnd.log import LogLimit, get_logger
from ldcnd.net.hand_over import OnQuery, Query
from ldcnd.net.session import Declaration, Session

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

    def __init__(self, rig: OwnedRig, keys: Keys, group: asyncio.TaskGroup, dispatcher: Dispatcher) -> None:
        self._rig = rig
        self._dispatcher = dispatcher
        self._keys = keys
        self._group = group
        self._journal = Journal(rig)
        self._pending = 0
        self._stops: dict[tuple[str, ...], list[asyncio.Future[dict[str, OwnStop]]]] = {}
        self._closing = self._over = False
        self._refusals_logged = LogLimit(now_s=asyncio.get_running_loop().time)

    def close(self) -> None:
        """Refuse further commands; stops are still taken."""
        self._closing = True

    def finish(self) -> None:
        """Refuse stops, too: the lines close."""
        self._closing = self._over = True

    def on_command(self, query: Query) -> None:
        """Take a query on `@cmd/**`."""
        self._dispatcher.leases.expire()  # before anything that waited while this process or its client was frozen
        # counted first: to decode a request takes longer, and only a flood needs to know what it asks for
        if self._pending >= PENDING_REQUESTS and not self._takes_energy_out(query):
            self._refuse(
                query,
                TooManyRequests(
                    f"{PENDING_REQUESTS} commands are under way already; nothing was done",
                    limit=PENDING_REQUESTS,
                    remedy="wait for replies before sending more",
                ),
            )
            return
        if self._over:
            self._refuse(query, ShuttingDown("the daemon is stopping"))
            return
        self._pending += 1
        task = self._group.create_task(self._answer(query, self._command), name=f"command {query.key}")
        task.add_done_callback(self._done)

    def may_take_energy_out(self, key: str) -> bool:
        """Tell whether a query with a key may be to bring an axis to rest; any thread may ask."""
        try:
            kind = _command_class(self._keys.parse_command(key))
        except LdcndError:
            return False
        return kind.may_take_energy_out()

    def _takes_energy_out(self, query: Query) -> bool:
        """Tell whether a query is to bring an axis to rest, which no flood of others may keep from being sent."""
        try:
            return self._understood(query)[1].takes_energy_out
        except LdcndError:
            return False

    def _understood(self, query: Query) -> tuple[CommandAddress, Command[Frozen], LdcndError | None]:
        """Return whom a query is for, what it asks for, and what is wrong with it all the same; see `understand`."""
        address = self._keys.parse_command(query.key)
        if address.axis != RIG_ITSELF:
            _ = self._rig.axes[address.axis]  # an unknown axis is refused before an unknown verb
        command, complaint = understand(_command_class(address), query.payload, query.encoding)
        return address, command, complaint

    def on_stop(self, query: Query) -> None:
        """Take a query on `@stop` or `@stop/<axis>`."""
        if self._over:
            self._refuse(query, ShuttingDown("the daemon has ended: its lines are closed, no stop goes out"))
            return
        self._group.create_task(self._answer(query, self._stop), name=f"stop {query.key}")

    def _done(self, _task: "asyncio.Task[None]") -> None:
        self._pending -= 1

    async def _answer(self, query: Query, run: Callable[[Query], Awaitable[Frozen]]) -> None:
        try:
            reply = await run(query)
        except LdcndError as error:
            self._refuse(query, error)
        except asyncio.CancelledError:
            said = "the daemon ended before this was answered: it may have been carried out"
            self._refuse(query, OutcomeUnknown(said, remedy="read the axis states before anything else"))
            raise
        except Exception:
            log.exception("bug while answering", key=query.key)
            self._refuse(query, InternalError("an error inside ldcnd; its log has the details"))
        else:
            self._reply(query, reply)

    @staticmethod
    def _reply(query: Query, reply: Frozen) -> None:
        """Answer unless it was answered when the command came to wait; events say how it went on."""
        if not query.answered:
            query.reply(*encode(reply, reply_encoding(query.encoding)))

    async def _command(self, query: Query) -> Frozen:
        address, command, complaint = self._understood(query)
        if self._closing and not command.takes_energy_out:
            raise ShuttingDown("the daemon is stopping", axis=address.axis)
        reply = await self._dispatcher.answer(address.axis, command, query.login, partial(self._reply, query))
        # only now: what is wrong with the request of a stop keeps no stop back
        if complaint is not None:
            whose = "" if address.axis == RIG_ITSELF else f"axis {address.axis}: "
            raise complaint.although(f"{whose}{command.verb} was carried out, but")
        return reply

    async def _stop(self, query: Query) -> Frozen:
        """Stop even if the payload is nonsense: a stop is always accepted."""
        name = self._keys.parse_stop(query.key)
        names = tuple(self._rig.axes) if name is None else (self._rig.axes[name].config.name,)
        try:
            self._journal.stopped(name)
        except Exception:
            log.exception("stop not recorded", key=query.key)  # it is carried out all the same
        own = await self._stop_once(names, query)
        kept = tuple(each for each in names if self._rig.axes[each].stops.latch_is_kept)
        unstoppable = tuple(each for each in names if not self._rig.axes[each].stops.possible)
        standing = tuple(each for each in unstoppable if self._rig.axes[each].tracker.status.moving is Moving.NO)
        trouble = self._rig.not_kept.get(LATCHES)
        warning = f"The latch is not on the disk ({trouble}): it is lost when the daemon ends." if trouble else ""
        return StopReply.of(
            names,
            confirmed=_confirmed(own),
            unstoppable=unstoppable,
            standing=standing,
            kept=kept,
            stops={name: each.count for name, each in own.items()},
            warning=warning,
        )

    async def _stop_once(self, names: tuple[str, ...], query: Query) -> dict[str, OwnStop]:
        """Stop axes and return what became of it; in a flood of stops, join one that is under way.

        Hundreds of clients may request a stop at once, and a few stops serve all. Only a stop whose latches still hold
        is joined: since they were set nothing has begun to move, so there is nothing that it does not stop. What joins
        leaves no event of its own.
        """
        under_way = self._stops.setdefault(names, [])
        if len(under_way) >= STOPS_AT_ONCE and self._are_latched(names):
            before = {name: self._rig.axes[name].tracker.status.stops for name in names}
            joined = await asyncio.shield(under_way[-1])
            if self._are_latched(names):
                return {name: replace(each, count=max(each.count, before[name])) for name, each in joined.items()}
            # a reset that was under way has taken the latch from this stop
        for axis in (self._rig.axes[name] for name in names):
            if axis.stops.possible:
                axis.tracker.take(StopLatch())  # at once, for requests of this same loop iteration
        loop = asyncio.get_running_loop()
        over: asyncio.Future[dict[str, OwnStop]] = loop.create_future()
        under_way.append(over)
        loop.call_later(0, self._name_latches, names, query)  # behind the packets, which wait for nothing
        try:
            own = await self._rig.stop(names)
        except BaseException:
            # who has joined it must not wait for ever
            over.set_exception(InternalError("the stop that this one had joined was cut short"))
            over.exception()  # perhaps no other stop has joined
            raise
        else:
            over.set_result(own)
            self._enter_stop(query, names, _confirmed(own))
            return own
        finally:
            under_way.remove(over)

    def _enter_stop(self, query: Query, names: tuple[str, ...], confirmed: tuple[str, ...]) -> None:
        """Record the requester of a stop in the events, as far as that can be read; nothing has waited for this."""
        try:
            self._dispatcher.stopped(names, confirmed, _request_of(query), query.login)
        except Exception:
            log.exception("stop not entered into the events", key=query.key)

    def _name_latches(self, names: tuple[str, ...], query: Query) -> None:
        """Keep the requester of a stop with its latches."""
        self._dispatcher.name_latches(names, _request_of(query).client, query.login)

    def _are_latched(self, names: tuple[str, ...]) -> bool:
        axes = (self._rig.axes[name] for name in names)
        return all(axis.tracker.status.stop_latched or not axis.stops.possible for axis in axes)

    def _refuse(self, query: Query, error: LdcndError) -> None:
        if query.answered:
            return
        if (fields := self._refusals_logged.admit()) is not None:
            log.info("refused", key=query.key, code=error.code.value, reason=error.message, **fields)
        query.refuse(error)


def _confirmed(stops: Mapping[str, OwnStop]) -> tuple[str, ...]:
    return tuple(name for name, own in stops.items() if own.confirmed)


def _request_of(query: Query) -> Stop:
    """Return what a stop says of itself; nothing where that cannot be read."""
    try:
        return decode(Stop, query.payload, query.encoding)
    except LdcndError:
        return Stop()


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
