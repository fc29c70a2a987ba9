"""Commands and stops: from a query to its answer, the only place where an exception becomes an error reply.

A command is decoded, admitted (who may, whether again, whether in time), written into the flight recorder of its line,
carried out by its axis, and entered into the ledger. What is not for one axis alone is in rig_commands.py.
"""

import asyncio
import hashlib
import json
from collections.abc import Awaitable, Callable
from functools import partial

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.axis.events import LatchNamed, StopLatch
from ldcnd.axis.kept import LATCHES
from ldcnd.axis.permit import UNCONDITIONAL, Permit, Right
from ldcnd.axis.status import LatchedBy
from ldcnd.config.interlocks import InterlockConfig
from ldcnd.contract.catalogue import BY_VERB, RENAMED
from ldcnd.contract.codec import decode, encode, reply_encoding, to_json, understand
from ldcnd.contract.commands import (
    About,
    AxisCommand,
    BufferMode,
    Command,
    CommandReply,
    Effect,
    Ends,
    Jog,
    Move,
    MoveAbsolute,
    Power,
    QuickStop,
    Stop,
    StopReply,
)
from ldcnd.contract.errors import (
    CommandExpired,
    DuplicateDaemon,
    InternalError,
    LdcndError,
    OutcomeUnknown,
    ShuttingDown,
    TooManyRequests,
    UnknownVerb,
)
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import RIG_ITSELF, CommandAddress, Keys
from ldcnd.contract.leases import Acquire
from ldcnd.contract.samples import Moving
from ldcnd.daemon.interlocks import Interlocks
from ldcnd.daemon.leases import Authority, LeaseWatch
from ldcnd.daemon.ledger import EventLog, Ledger, LedgerEntry, status_of
from ldcnd.daemon.rig import OwnedRig
from ldcnd.daemon.rig_commands import AnswerReload, RigCommands
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.log import LogLimit, get_logger
from ldcnd.net.hand_over import OnQuery, Query
from ldcnd.net.session import Declaration, Session

log = get_logger("requests")

Accept = Callable[[CommandReply], None]
STOP = "@stop"
TOKENS = ("lease", "leases", "replaces")
"""Fields of requests that name leases."""
QUOTED_TOKENS = tuple(f'"{name}"'.encode() for name in TOKENS)
STOPS_AT_ONCE = 8
"""Maximum number of concurrent stops of the same axes; further ones join."""
REPLY_S = 1.0
"""Time left for a drive's acknowledgement and the reply when a command begins; who gets none by then gives up."""
PENDING_REQUESTS = 64
"""Maximum number of concurrent commands; stops are not counted."""


class Journal:
    """Writes the requests of clients into the flight recorders of the lines concerned, between the packets.

    A line of it is `axis/verb {payload}`, or `@stop/axis {}`, with the payload as JSON; requests that concern the whole
    rig are written to all lines. A lease is named by a fingerprint: a reader of a wire log must not be able to command
    with what it contains.
    """

    def __init__(self, rig: OwnedRig) -> None:
        logs = [(line.bus.wire_log, [axis.config.name for axis in line.axes]) for line in rig.buses]
        self._logs = {name: [log] for log, names in logs for name in names}
        self._logs[RIG_ITSELF] = [log for log, _ in logs]

    def asked(self, axis: str, command: Command[Frozen], lease: str | None = None) -> None:
        """Note a command of an axis or of the rig; `lease` is the token that was given in return."""
        payload = to_json(command, exclude_defaults=True)
        if lease or any(name in payload for name in QUOTED_TOKENS):
            fields = json.loads(payload) | ({"lease": lease} if lease else {})
            payload = json.dumps(without_tokens(fields), separators=(",", ":"), ensure_ascii=False).encode()
        self._note(axis, f"{axis}/{command.verb} ".encode() + payload)

    def stopped(self, axis: str | None) -> None:
        """Note a stop of an axis, or of the rig."""
        what = f"{STOP}/{axis}" if axis else STOP
        self._note(axis or RIG_ITSELF, f"{what} {{}}".encode())

    def _note(self, axis: str, line: bytes) -> None:
        now_s = asyncio.get_running_loop().time()
        for wire_log in self._logs[axis]:
            wire_log.add(now_s, WireEvent.COMMAND, line)


def without_tokens(given: object, *, secret: bool = False) -> object:
    """Return fields of a request with a fingerprint in the place of every lease, also in what is nested."""
    if isinstance(given, dict):
        return {name: without_tokens(value, secret=name in TOKENS) for name, value in given.items()}
    if isinstance(given, list):
        return [without_tokens(each, secret=secret) for each in given]
    return fingerprint(given) if secret and isinstance(given, str) else given


def fingerprint(token: str) -> str:
    """Return a name for a lease that does not give it away."""
    return hashlib.sha256(token.encode()).hexdigest()[:16]


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

    def __init__(self, rig: OwnedRig, keys: Keys, group: asyncio.TaskGroup, dispatcher: "Dispatcher") -> None:
        self._rig = rig
        self._dispatcher = dispatcher
        self._keys = keys
        self._group = group
        self._journal = Journal(rig)
        self._pending = 0
        self._stops: dict[tuple[str, ...], list[asyncio.Future[tuple[str, ...]]]] = {}
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
        return kind.effect is Effect.REST or kind is Power

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
            self._refuse(query, ShuttingDown("the daemon is stopping"))
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
            raise complaint.although(f"axis {address.axis}: {command.verb} was carried out, but")
        return reply

    async def _stop(self, query: Query) -> Frozen:
        """Stop even if the payload is nonsense: a stop is always accepted."""
        name = self._keys.parse_stop(query.key)
        names = tuple(self._rig.axes) if name is None else (self._rig.axes[name].config.name,)
        try:
            self._journal.stopped(name)
        except Exception:
            log.exception("stop not recorded", key=query.key)  # it is carried out all the same
        confirmed = await self._stop_once(names, query)
        kept = tuple(each for each in names if self._rig.axes[each].stops.latch_is_kept)
        unstoppable = tuple(each for each in names if not self._rig.axes[each].stops.possible)
        standing = tuple(each for each in unstoppable if self._rig.axes[each].tracker.status.moving is Moving.NO)
        trouble = self._rig.not_kept.get(LATCHES)
        warning = f"The latch is not on the disk ({trouble}): it is lost when the daemon ends." if trouble else ""
        return StopReply.of(
            names, confirmed=confirmed, unstoppable=unstoppable, standing=standing, kept=kept, warning=warning
        )

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
        for axis in (self._rig.axes[name] for name in names):
            if axis.stops.possible:
                axis.tracker.take(StopLatch())  # at once, for requests of this same loop iteration
        loop = asyncio.get_running_loop()
        own: asyncio.Future[tuple[str, ...]] = loop.create_future()
        under_way.append(own)
        loop.call_later(0, self._name_latches, names, query)  # behind the packets, which wait for nothing
        try:
            confirmed = await self._rig.stop(names)
        except BaseException:
            # who has joined it must not wait for ever
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


class Dispatcher:
    """Hands every command to what carries it out, each command id at most once, and keeps the outcomes.

    Attributes:
        authority: the leases of the rig.
        leases: gives control and ends it.
        events: what happens to its commands.
        interlocks: what motions and outputs require.
        rivals: instances of the other daemons that serve the same rig; while there is one, nothing is moved.
    """

    def __init__(
        self,
        rig: OwnedRig,
        authority: Authority,
        ledger: Ledger,
        events: EventLog,
        clock: Clock,
        instance: str,
        interlocks: tuple[InterlockConfig, ...] = (),
    ) -> None:
        self.authority = authority
        self.leases = LeaseWatch(rig, authority, events, clock)
        self.interlocks = Interlocks(interlocks, rig, authority, events)
        self.events = events
        self.rivals: set[str] = set()
        self._journal = Journal(rig)
        self._instance = instance
        self._rig = rig
        self._ledger = ledger
        self._clock = clock
        self._under_way: dict[str, asyncio.Event] = {}
        self._rig_commands = RigCommands(
            rig,
            authority,
            self.leases,
            ledger,
            events,
            clock,
            self.carry_out,
            self._admit_lease,
            interlocks=self.interlocks,
        )

    def serve_reloads(self, answer: AnswerReload) -> None:
        """Let clients have the configuration read again."""
        self._rig_commands.answer_reload = answer

    async def answer(
        self, axis: str, command: Command[Frozen], login: str | None = None, accept: Accept = lambda _: None
    ) -> Frozen:
        """Carry out a command that has just arrived, and return its reply.

        Args:
            axis: which axis, or `RIG_ITSELF`.
            command: the request.
            login: whose link it came over, for the record.
            accept: takes the reply of a command that waits for another one; no caller need wait as long.

        Raises:
            LdcndError: as it was refused.
        """
        if isinstance(command, AxisCommand) or (
            command.effect is not Effect.QUESTION and not isinstance(command, Acquire)
        ):
            try:
                self._journal.asked(axis, command)
            except Exception:
                if not command.takes_energy_out:
                    raise
                log.exception("request not recorded", axis=axis, verb=command.verb)  # it is carried out all the same
        match command:
            case AxisCommand():
                return await self.carry_out(axis, command, login, accept)
            case Acquire():
                lease = self.leases.acquire(command)
                # behind it: only now is there a token to name it by
                self._journal.asked(RIG_ITSELF, command, lease.token)
                return lease.reply()
            case _:
                return await self._rig_commands.answer(axis, command, login)

    async def carry_out(
        self,
        axis_name: str,
        command: AxisCommand[CommandReply],
        login: str | None = None,
        accept: Accept = lambda _: None,
    ) -> CommandReply:
        """Carry out a command of an axis, or answer as the first time when its id is known.

        What takes energy out passes no gate: neither its lease, run, deadline and id nor another daemon are asked.

        Raises:
            LdcndError: as the axis refused it, or because it is not admitted.
        """
        axis = self._rig.axes[axis_name]
        if command.effect is Effect.QUESTION:
            return await axis.execute(command)
        if isinstance(command, Jog) and command.renews is not None:
            # no entry in the ledger: a renewal comes several times a second, and begins nothing
            self._admit(axis_name, command)
            return axis.renew_jog(command, command.renews)
        command_id = command.command_id or self.events.next_command_id()
        client, right, accepted = command.client, UNCONDITIONAL, asyncio.Event()
        if command.takes_energy_out:
            # a stop whose id was used is no repetition: it is sent, under another one
            if self._ledger.is_taken(command.command_id):
                command_id = self.events.next_command_id()
            client = client or self._holder_by(axis_name, command)
        else:
            if entry := self._ledger.repeated(command.command_id, axis_name, command):
                return await self._answer_again(entry)
            # behind the ledger: a repetition has an old sequence, and is answered all the same
            client = self._admit(axis_name, command) or client
            right = self._right(axis_name, command, accepted)
        hold = axis.begin_hold(command_id, command) if isinstance(command, Jog) else None
        if hold:
            right = right.also(lambda: hold.check(self._clock.now_s()))
        permit = axis.permit(command_id, command.verb, right)
        target = command.position if isinstance(command, MoveAbsolute) else None
        self._enter(LedgerEntry(command_id, axis_name, command, client, login, target=target))
        over = self._under_way[command_id] = asyncio.Event()
        try:
            if isinstance(command, Move) and command.buffer_mode is not BufferMode.REFUSE:

                def waits(ahead: str) -> None:
                    # its sender has a reply from here on: only `not_after` bounds how long it may wait
                    accepted.set()
                    accept(self._ledger.waits(command_id, ahead))

                return await axis.succession.carry_out(
                    command, permit, lambda: self._start(axis, command, permit), waits
                )
            return await self._start(axis, command, permit)
        except LdcndError as error:
            self._ledger.answered(command_id, error, status_of(error))
            raise
        except BaseException:
            self._ledger.answered(command_id, OutcomeUnknown("the command was cut short"), CommandStatus.UNKNOWN)
            raise
        finally:
            del self._under_way[command_id]
            over.set()
            # a jog that was refused must not be renewed into life
            if hold and not hold.begun:
                hold.over = True

    def _enter(self, entry: LedgerEntry) -> None:
        """Enter a command that begins.

        Raises:
            TooManyRequests: as `Ledger.open`.
        """
        try:
            self._ledger.open(entry)
        except Exception:
            if not entry.command.takes_energy_out:
                raise
            log.exception("command not entered", axis=entry.axis, verb=entry.verb)  # it is carried out all the same
        if isinstance(entry.command, Stop | QuickStop):  # once it is latched, which is at once
            asyncio.get_running_loop().call_soon(self.name_latches, (entry.axis,), entry.client, entry.login)

    async def _start(self, axis: AxisService, command: AxisCommand[CommandReply], permit: Permit) -> CommandReply:
        reply = await axis.execute(command, permit)
        # a reading may have ended it while its reply was on the way: then its end is entered already
        begun = axis.tracker.status.command
        moving = begun is not None and begun.command_id == permit.command_id
        ends_later = command.ends is Ends.BY_READING and moving
        status = CommandStatus.EXECUTING if ends_later else CommandStatus.DONE
        self._ledger.answered(permit.command_id, reply, status, begun.goal if begun and moving else None)
        return reply

    def stopped(self, names: tuple[str, ...], confirmed: tuple[str, ...], command: Stop, login: str | None) -> None:
        """Enter stops that were carried out already, with their requester: one event for each axis.

        Args:
            names: the axes that were stopped.
            confirmed: those whose drives acknowledged it.
            command: the stop request; only its `client` is used.
            login: whose link it came over, for the record.
        """
        for name in names:
            status, reason = CommandStatus.DONE, None
            if not self._rig.axes[name].stops.possible:
                status, reason = CommandStatus.REFUSED, "its drive cannot be stopped over its line"
            elif name not in confirmed:
                status, reason = (
                    CommandStatus.UNKNOWN,
                    "the drive did not confirm it yet; the axis is latched",
                )
            command_id = self.events.next_command_id()
            self._ledger.open(LedgerEntry(command_id, name, command, command.client, login, status, reason))

    def name_latches(self, names: tuple[str, ...], client: str | None, login: str | None) -> None:
        """Keep with the latches of axes who has stopped them."""
        by = LatchedBy(self._clock.now_ns(), client, login)
        for name in names:
            self._rig.axes[name].tracker.take(LatchNamed(by))

    async def _answer_again(self, entry: LedgerEntry) -> CommandReply:
        """Answer a repeated id as the first time, once there is an answer."""
        under_way = self._under_way.get(entry.command_id)
        if under_way and entry.answer is None:
            await under_way.wait()
            entry = self._ledger.get(entry.command_id)
        if isinstance(entry.answer, CommandReply):
            return entry.answer
        raise entry.answer or OutcomeUnknown(
            f"axis {entry.axis}: the outcome of {entry.verb} is unknown", axis=entry.axis
        )

    def _admit(self, axis: str, command: AxisCommand[CommandReply]) -> str | None:
        """Refuse a command that is stale, late or sent by another client; return its sender, if it names one."""
        self._refuse_rival(axis)
        if command.instance not in (None, self._instance):
            raise CommandExpired(
                f"axis {axis}: {command.verb} is meant for another run of the daemon; this one does nothing of it",
                axis=axis,
                value=command.instance,
                limit=self._instance,
                remedy="look where the axis is, and whether that run has carried it out, then send it to this one",
            )
        # before the lease: what is refused here must use up none of its sequence
        self._refuse_late(axis, command)
        return self.authority.admit(axis, command.lease, command.sequence, self._clock.now_s())

    def _holder_by(self, axis: str, command: AxisCommand[CommandReply]) -> str | None:
        """Return the client under whose lease a command comes that needs none."""
        holder = self.authority.holder(axis)
        return holder.client if holder and holder.token == command.lease else None

    def _admit_lease(self, axis: str, lease: str | None) -> None:
        """Refuse whatever could move an axis to another client than its holder."""
        self._refuse_rival(axis)
        self.authority.admit(axis, lease, None, self._clock.now_s())

    def require_control(self, axis: str, lease: str | None) -> None:
        """Refuse what was admitted under a lease that has ended since.

        Raises:
            RequestRefused: it has, or another daemon has the rig.
        """
        self._refuse_rival(axis)
        self.authority.check_held(axis, lease, self._clock.now_s())

    def _right(self, axis: str, command: AxisCommand[CommandReply], accepted: asyncio.Event) -> Right:
        """Return what must still hold of the sender when a motion of its command begins.

        Args:
            axis: which axis.
            command: the request.
            accepted: set once its sender has the reply that it waits for its turn.
        """
        arrived_s = self._clock.now_s()

        def holds() -> None:
            self.require_control(axis, command.lease)

        def in_time() -> None:
            if command.not_after is not None:
                self._refuse_late(axis, command)
            if not accepted.is_set() and self._clock.now_s() - arrived_s > command.answer_s - REPLY_S:
                raise CommandExpired(
                    f"axis {axis}: the turn of {command.verb} came later than its sender waits for a reply",
                    axis=axis,
                    value=self._clock.now_s() - arrived_s,
                    limit=command.answer_s - REPLY_S,
                    remedy="send it again if it is still wanted",
                )

        return Right(holds, in_time)

    def _refuse_late(self, axis: str, command: AxisCommand[CommandReply]) -> None:
        if command.not_after is not None and self._clock.now_ns() > command.not_after:
            late_s = (self._clock.now_ns() - command.not_after) / 1e9
            raise CommandExpired(
                f"axis {axis}: {command.verb} is {late_s:.3f} s later than its sender allows",
                axis=axis,
                value=command.not_after,
                remedy="send it again if it is still wanted",
            )

    def _refuse_rival(self, axis: str) -> None:
        if self.rivals:
            others = ", ".join(sorted(self.rivals))
            raise DuplicateDaemon(
                f"axis {axis}: rig {self._rig.name} is served by other daemons, too ({others}); nothing is moved",
                axis=axis,
                value=others,
                remedy="end all but one of the daemons",
            )
