"""Where commands are admitted and routed: who may, whether again, what became of it; then the axis, then the ledger."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass

from ldcnd.daemon.axis.axis import AxisService
from ldcnd.daemon.axis.permit import UNCONDITIONAL, Permit, Right
from ldcnd.daemon.axis.procedures.group import GroupMoveRequest, Meeting
from ldcnd.daemon.capture.flight_recorder import Journal, wire_page
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.command.authority import Authority, Lease, random_token
from ldcnd.daemon.command.events import EventLog
from ldcnd.daemon.command.ledger import Entry, Ledger
from ldcnd.daemon.command.why import explain
from ldcnd.daemon.line.rig import Rig
from ldcnd.errors import (
    CommandExpired,
    DuplicateDaemon,
    LdcndError,
    NotSupported,
    OutcomeUnknown,
    RequestRefused,
    UnknownVerb,
)
from ldcnd.log import get_logger
from ldcnd.messaging.codec import decode
from ldcnd.messaging.keys import RIG_ITSELF
from ldcnd.model import verbs
from ldcnd.model.commands import AxisCommand, BufferMode, CommandReply, Move, MoveAbsolute, Stop, Verb, Why, WhyReply
from ldcnd.model.events import CommandOutcome, CommandStatus, EventList, ReadEvents, ReadOutcome
from ldcnd.model.frozen import Frozen
from ldcnd.model.rig_commands import (
    Acquire,
    Holder,
    HolderList,
    LeaseReply,
    LeaseRequest,
    ListHolders,
    ReadWireLog,
    WireLogReply,
)

log = get_logger("authority")


AT_ONCE = frozenset({Verb.POWER, Verb.RESET, Verb.SET_POSITION, Verb.SET_GAINS, Verb.STOP, Verb.QUICK_STOP})
"""Done as soon as the drive has acknowledged them; the others end when a reading says so."""
FREE = frozenset({Verb.STOP, Verb.QUICK_STOP, Verb.HALT})
"""Whatever brings an axis to rest needs no lease, is never late and is carried out as often as it is asked."""
QUESTIONS = frozenset(
    {Verb.LIST_PARAMETERS, Verb.READ_PARAMETER, Verb.READ_ALL_PARAMETERS, Verb.READ_ALARMS, Verb.READ_PROFILE}
)
"""What changes nothing needs no lease and leaves no trace in the events."""


class CommandDesk:
    """Admits commands, each id at most once, and keeps their outcomes.

    Attributes:
        rival: another daemon that serves the same rig; while there is one, nothing is moved.
    """

    def __init__(
        self,
        rig: Rig,
        authority: Authority,
        ledger: Ledger,
        clock: Clock,
        next_command_id: Callable[[], str],
        instance: str,
    ) -> None:
        self.rival: str | None = None
        self._instance = instance
        self._rig = rig
        self._authority = authority
        self._ledger = ledger
        self._clock = clock
        self._next_command_id = next_command_id
        self._under_way: dict[str, asyncio.Event] = {}

    async def carry_out(
        self, axis_name: str, verb: Verb, request: AxisCommand[CommandReply], login: str | None = None
    ) -> CommandReply:
        """Carry out a command that has just arrived, or answer as the first time when its id is known.

        Args:
            axis_name: which axis.
            verb: what to do.
            request: with which values.
            login: whose link it came over, for the record.

        Raises:
            LdcndError: as the axis refused it, or because it must not be looked at.
        """
        axis = self._rig.axis(axis_name)
        if verb in QUESTIONS:
            return await axis.execute(verb, request)
        command_id = request.command_id or self._next_command_id()
        if entry := self._ledger.repeated(command_id, axis_name, verb, request):
            if verb not in FREE:
                return await self._answer_again(entry)
            command_id = self._next_command_id()
        client = self._admit(axis_name, verb, request) or request.client
        permit = axis.permit(verb, UNCONDITIONAL if verb in FREE else self._right(axis_name, verb, request))
        self._ledger.open(Entry(command_id, axis_name, verb, request, client, login))
        over = self._under_way[command_id] = asyncio.Event()
        try:
            return await self._execute(axis, verb, request, command_id, permit)
        except LdcndError as error:
            self._ledger.answered(command_id, error, _status(error))
            raise
        except BaseException:
            self._ledger.answered(command_id, OutcomeUnknown("the command was cut short"), CommandStatus.UNKNOWN)
            raise
        finally:
            del self._under_way[command_id]
            over.set()

    async def _execute(
        self, axis: AxisService, verb: Verb, request: AxisCommand[CommandReply], command_id: str, permit: Permit
    ) -> CommandReply:
        def start() -> Awaitable[CommandReply]:
            return self._start(axis, verb, request, command_id, permit)

        if isinstance(request, Move) and request.buffer_mode is not BufferMode.REFUSE:
            return await axis.in_turn(request, permit, start)
        return await start()

    async def _start(
        self, axis: AxisService, verb: Verb, request: AxisCommand[CommandReply], command_id: str, permit: Permit
    ) -> CommandReply:
        reply = await axis.execute(verb, request, command_id, permit)
        moving = axis.tracker.command is not None and axis.tracker.command.command_id == command_id
        status = CommandStatus.DONE if verb in AT_ONCE or not moving else CommandStatus.EXECUTING
        self._ledger.answered(command_id, reply, status)
        return reply

    def stopped(self, names: tuple[str, ...], confirmed: tuple[str, ...], request: Stop, login: str | None) -> None:
        """Enter stops that were carried out already, with who has asked for them: one event for each axis.

        Args:
            names: the axes that were stopped.
            confirmed: those whose drives acknowledged it.
            request: what came with the stop; nothing but its `client` is looked at.
            login: whose link it came over, for the record.
        """
        for name in names:
            status, reason = CommandStatus.DONE, None
            if not self._rig.axis(name).stoppable:
                status, reason = CommandStatus.REFUSED, "its drive cannot be stopped over its line"
            elif name not in confirmed:
                status, reason = CommandStatus.UNKNOWN, "the drive did not confirm it; the axis is latched"
            command_id = self._next_command_id()
            self._ledger.open(Entry(command_id, name, Verb.STOP, request, request.client, login, status, reason))

    def why(self, axis: AxisService, request: Why) -> WhyReply:
        """Tell why a motion of this axis would be refused now, and what would clear that; no effect."""

        def admit() -> None:
            self._refuse_rival(axis.config.name)
            self._authority.admit(axis.config.name, request.lease, None, self._clock.now_s())

        return explain(axis.tracker, admit, absolute=request.absolute)

    async def _answer_again(self, entry: Entry) -> CommandReply:
        """Answer a repeated id as the first time, once there is an answer."""
        if under_way := self._under_way.get(entry.command_id):
            await under_way.wait()
            entry = self._ledger.get(entry.command_id)
        if isinstance(entry.answer, CommandReply):
            return entry.answer
        raise entry.answer or OutcomeUnknown(f"axis {entry.axis}: nobody knows how {entry.verb} went", axis=entry.axis)

    def _admit(self, axis: str, verb: Verb, request: AxisCommand[CommandReply]) -> str | None:
        """Refuse what is stale, late or somebody else's; return who sends it, if it says so."""
        if verb in FREE:
            return None
        self._refuse_rival(axis)
        if request.instance not in (None, self._instance):
            raise CommandExpired(
                f"axis {axis}: {verb} was sent to another run of the daemon; nobody knows whether it was carried out",
                axis=axis,
                value=request.instance,
                limit=self._instance,
                remedy="look where the axis is, then send a new command to this run",
            )
        self._refuse_late(axis, verb, request)
        return self._authority.admit(axis, request.lease, request.sequence, self._clock.now_s())

    def _right(self, axis: str, verb: Verb, request: AxisCommand[CommandReply]) -> Right:
        """Return what must still hold of the sender when a motion of its command begins."""

        def holds() -> None:
            self._refuse_rival(axis)
            self._authority.check_held(axis, request.lease, self._clock.now_s())

        return Right(holds, lambda: self._refuse_late(axis, verb, request))

    def _refuse_late(self, axis: str, verb: Verb, request: AxisCommand[CommandReply]) -> None:
        if request.not_after is not None and self._clock.now_ns() > request.not_after:
            late_s = (self._clock.now_ns() - request.not_after) / 1e9
            raise CommandExpired(
                f"axis {axis}: {verb} is {late_s:.3f} s later than its sender allows",
                axis=axis,
                value=request.not_after,
                remedy="send it again if it is still wanted",
            )

    def _refuse_rival(self, axis: str) -> None:
        if self.rival:
            raise DuplicateDaemon(
                f"axis {axis}: another daemon ({self.rival}) serves rig {self._rig.name}; nothing is moved",
                axis=axis,
                value=self.rival,
                remedy="end one of the two daemons",
            )


def _status(error: LdcndError) -> CommandStatus:
    match error:
        case OutcomeUnknown():
            return CommandStatus.UNKNOWN
        case RequestRefused():
            return CommandStatus.REFUSED
        case _:
            return CommandStatus.FAILED


class RigDesk:
    """Answers the queries on `@cmd/_/<verb>`."""

    def __init__(self, rig: Rig, authority: Authority, ledger: Ledger, events: EventLog, clock: Clock) -> None:
        self._rig = rig
        self._authority = authority
        self._ledger = ledger
        self._events = events
        self._clock = clock
        self._journal = Journal(rig)
        self._handlers: Mapping[str, Callable[[bytes, str], Frozen]] = {
            verbs.ACQUIRE: self._acquire,
            verbs.RENEW: self._renew,
            verbs.RELEASE: self._release,
            verbs.HOLDERS: self._holders,
            verbs.OUTCOME: self._outcome,
            verbs.EVENTS: self._latest,
            verbs.WIRE_LOG: self._wire_log,
        }

    def answer(self, verb: str, payload: bytes, encoding: str) -> Frozen:
        """Carry out one verb.

        Raises:
            UnknownVerb: there is none of that name.
            RequestRefused: as the verb says.
        """
        handler = self._handlers.get(verb)
        if handler is None:
            raise UnknownVerb(f"the rig has no command {verb!r}; it has {', '.join(verbs.RIG_VERBS)}", value=verb)
        return handler(payload, encoding)

    def _acquire(self, payload: bytes, encoding: str) -> LeaseReply:
        request = decode(Acquire, payload, encoding)
        lease, displaced = self._authority.acquire(
            request.client, self._rig.members(request.axes), request.lease_s, self._clock.now_s(), force=request.force
        )
        for other in displaced:
            if other.client != lease.client:
                log.warning("control taken over", axes=sorted(other.axes), from_client=other.client, by=lease.client)
        self._journal.asked(RIG_ITSELF, verbs.ACQUIRE, request, lease.token)
        log.info("control acquired", client=lease.client, axes=sorted(lease.axes))
        return _reply(lease)

    def _renew(self, payload: bytes, encoding: str) -> LeaseReply:
        request = decode(LeaseRequest, payload, encoding)
        self._journal.asked(RIG_ITSELF, verbs.RENEW, request)
        return _reply(self._authority.renew(request.lease, self._clock.now_s()))

    def _release(self, payload: bytes, encoding: str) -> LeaseReply:
        request = decode(LeaseRequest, payload, encoding)
        self._journal.asked(RIG_ITSELF, verbs.RELEASE, request)
        lease = self._authority.release(request.lease, self._clock.now_s())
        log.info("control released", client=lease.client, axes=sorted(lease.axes))
        return _reply(lease)

    def _holders(self, payload: bytes, encoding: str) -> HolderList:
        decode(ListHolders, payload, encoding)
        holders = [(axis, self._authority.holder(axis)) for axis in self._rig.axes]
        return HolderList(
            required=self._authority.required,
            holders=tuple(Holder(axis=axis, client=lease.client if lease else None) for axis, lease in holders),
        )

    def _outcome(self, payload: bytes, encoding: str) -> CommandOutcome:
        entry = self._ledger.get(decode(ReadOutcome, payload, encoding).command_id)
        return CommandOutcome(
            command_id=entry.command_id,
            axis=entry.axis,
            verb=entry.verb.value,
            status=entry.status,
            reason=entry.reason,
        )

    def _latest(self, payload: bytes, encoding: str) -> EventList:
        return self._events.page(decode(ReadEvents, payload, encoding))

    def _wire_log(self, payload: bytes, encoding: str) -> WireLogReply:
        return wire_page(self._rig, decode(ReadWireLog, payload, encoding), self._clock)


def _reply(lease: Lease) -> LeaseReply:
    return LeaseReply(lease=lease.token, client=lease.client, axes=tuple(sorted(lease.axes)), lease_s=lease.duration_s)


Execute = Callable[[str, Verb, AxisCommand[CommandReply]], Awaitable[CommandReply]]
"""Carries out a command of an axis, with whatever the daemon asks before it does."""


async def move_together(rig: Rig, moves: Mapping[str, MoveAbsolute], execute: Execute) -> tuple[CommandReply, ...]:
    """Start absolute moves of several axes together; returns once every drive has proven that it started.

    Args:
        rig: the daemon's.
        moves: by axis name; exactly the members of one configured group.
        execute: how a single command is carried out.

    Raises:
        UnknownAxis: there is no such axis.
        NotSupported: the axes are on different lines, or are no group.
        RequestRefused: a member cannot move; nothing was started.
        BusError: the line failed; `OutcomeUnknown` when a drive may have started, then all were told to stop.
    """
    lines = {bus for bus in rig.buses for name in moves if rig.axis(name) in bus.axes}
    if len(lines) != 1:
        raise NotSupported(f"axes {', '.join(moves)} are not on one line, so they cannot start together")
    (line,) = lines
    meeting = Meeting(line.network, frozenset(moves))

    async def take_part(name: str, move: MoveAbsolute) -> CommandReply | LdcndError:
        try:
            return await execute(name, Verb.MOVE_ABSOLUTE, GroupMoveRequest.of(move, meeting))
        except LdcndError as error:
            meeting.fail(error)
            return error

    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(take_part(name, move), name=f"group move {name}") for name, move in moves.items()]
    replies = []
    for task in tasks:
        result = task.result()
        if isinstance(result, LdcndError):
            raise meeting.failure or result
        replies.append(result)
    return tuple(replies)


@dataclass(frozen=True, slots=True)
class Control:
    """The desks of one rig and their books."""

    authority: Authority
    commands: CommandDesk
    rig: RigDesk
    events: EventLog


def build_control(
    rig: Rig,
    ledger: Ledger,
    events: EventLog,
    clock: Clock,
    next_command_id: Callable[[], str],
    *,
    instance: str,
    leased: bool,
    next_token: Callable[[], str] = random_token,
) -> Control:
    """Set up the desks of a rig whose axes report to this ledger already."""
    authority = Authority(rig.axes, required=leased, next_token=next_token)
    return Control(
        authority,
        CommandDesk(rig, authority, ledger, clock, next_command_id, instance),
        RigDesk(rig, authority, ledger, events, clock),
        events,
    )
