"""Where commands are admitted and routed: who may, whether again, what became of it; then the axis, then the ledger."""

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping
from functools import partial

from ldcnd.daemon.axis import guards
from ldcnd.daemon.axis.axis import AxisService
from ldcnd.daemon.axis.guards import UNCONDITIONAL, Permit, Right
from ldcnd.daemon.axis.procedures.group import GroupMoveRequest, Meeting, Rendezvous, plans_on_line
from ldcnd.daemon.axis.procedures.path import PathShareRequest, SharedPath
from ldcnd.daemon.capture.flight_recorder import Journal, wire_page
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.command.authority import Authority, Lease
from ldcnd.daemon.command.ledger import Entry, EventLog, Ledger
from ldcnd.daemon.command.loss import LeaseWatch, concerned, rehearse
from ldcnd.daemon.command.why import explain
from ldcnd.daemon.line.line import BusService
from ldcnd.daemon.line.modules import ModuleService
from ldcnd.daemon.line.rig import Rig
from ldcnd.errors import (
    CommandExpired,
    DuplicateDaemon,
    InternalError,
    LdcndError,
    MalformedRequest,
    NotSupported,
    OutcomeUnknown,
    RequestRefused,
)
from ldcnd.log import get_logger
from ldcnd.messaging.keys import RIG_ITSELF
from ldcnd.model.commands import (
    AxisCommand,
    BufferMode,
    Command,
    CommandReply,
    Effect,
    Ends,
    Jog,
    Move,
    MoveAbsolute,
    Preview,
    Stop,
    Why,
    WhyReply,
)
from ldcnd.model.events import CommandOutcome, CommandStatus, ReadEvents, ReadOutcome
from ldcnd.model.frozen import Frozen
from ldcnd.model.leases import Acquire, Holder, HolderList, LeaseReply, ListHolders, Release, Renew
from ldcnd.model.rig_commands import (
    AxisShare,
    GroupMoves,
    LinePath,
    MoveTogether,
    MoveTogetherReply,
    PathReply,
    PreviewTogether,
    PreviewTogetherReply,
    ReadWireLog,
    Rehearse,
    SetIo,
    SetIoTimer,
    SetSpeedOverride,
    Snapshot,
    SpeedOverrideReply,
    WalkPath,
)

log = get_logger("commands")


class Dispatcher:
    """Hands every command to what carries it out, each command id at most once, and keeps the outcomes.

    Attributes:
        authority: the leases of the rig.
        leases: gives control and ends it.
        events: what happens to its commands.
        rival: another daemon that serves the same rig; while there is one, nothing is moved.
    """

    def __init__(
        self,
        rig: Rig,
        authority: Authority,
        ledger: Ledger,
        events: EventLog,
        clock: Clock,
        instance: str,
    ) -> None:
        self.authority = authority
        self.leases = LeaseWatch(rig, authority, events, clock)
        self.events = events
        self.rival: str | None = None
        self._journal = Journal(rig)
        self._instance = instance
        self._rig = rig
        self._ledger = ledger
        self._clock = clock
        self._under_way: dict[str, asyncio.Event] = {}

    async def answer(self, axis: str, command: Command[Frozen], login: str | None = None) -> Frozen:
        """Carry out a command that has just arrived, and return its reply.

        Args:
            axis: which axis, or `RIG_ITSELF`.
            command: the request.
            login: whose link it came over, for the record.

        Raises:
            LdcndError: as it was refused.
        """
        if isinstance(command, AxisCommand) or (
            command.effect is not Effect.QUESTION and not isinstance(command, Acquire)
        ):
            self._journal.asked(axis, command)
        match command:
            case AxisCommand():
                return await self.carry_out(axis, command, login)
            case Why():
                return self.why(self._rig.axis(axis), command)
            case Preview():
                why = self.why(self._rig.axis(axis), Why(absolute=command.position is not None))
                return self._rig.axis(axis).preview(command, tuple(cause.text for cause in why.causes))
            case MoveTogether() | WalkPath():
                return await self._move_together(command, login)
            case SetSpeedOverride():
                return await self._set_speed_override(command)
            case PreviewTogether():
                return preview_together(self._rig, command)
            case Snapshot():
                return await self._rig.line(command.bus).snapshot(self._clock)
            case SetIo():
                module = self._rig.module(command.module)
                return await module.set_io(command, lambda: self._admit_module(module, command))
            case SetIoTimer():
                module = self._rig.module(command.module)
                self._admit_module(module, command)
                return await module.set_timer(command)
            case Rehearse():
                self._admit_rehearsal(command)
                return await rehearse(self._rig, command)
            case _:
                return self._of_rig(command)

    async def carry_out(
        self, axis_name: str, command: AxisCommand[CommandReply], login: str | None = None
    ) -> CommandReply:
        """Carry out a command of an axis, or answer as the first time when its id is known.

        Raises:
            LdcndError: as the axis refused it, or because it is not admitted.
        """
        axis = self._rig.axis(axis_name)
        if command.effect is Effect.QUESTION:
            return await axis.execute(command)
        if isinstance(command, Jog) and command.renews is not None:
            self._admit(axis_name, command)
            return axis.renew_jog(command, command.renews)
        command_id = command.command_id or self.events.next_command_id()
        if entry := self._ledger.repeated(command_id, axis_name, command):
            if command.effect is not Effect.REST:
                return await self._answer_again(entry)
            command_id = self.events.next_command_id()
        client = self._admit(axis_name, command) or command.client
        right = UNCONDITIONAL if command.effect is Effect.REST else self._right(axis_name, command)
        hold = axis.begin_hold(command_id, command) if isinstance(command, Jog) else None
        if hold:
            right = right.also(lambda: hold.check(self._clock.now_s()))
        permit = axis.permit(command_id, command.verb, right)
        self._ledger.open(Entry(command_id, axis_name, command, client, login))
        over = self._under_way[command_id] = asyncio.Event()
        try:
            return await self._execute(axis, command, permit)
        except LdcndError as error:
            self._ledger.answered(command_id, error, _status(error))
            raise
        except BaseException:
            self._ledger.answered(command_id, OutcomeUnknown("the command was cut short"), CommandStatus.UNKNOWN)
            raise
        finally:
            del self._under_way[command_id]
            over.set()
            if hold and not hold.begun:
                hold.over = True

    async def _execute(
        self, axis: AxisService, command: AxisCommand[CommandReply], permit: Permit
    ) -> CommandReply:
        def start() -> Awaitable[CommandReply]:
            return self._start(axis, command, permit)

        if isinstance(command, Move) and command.buffer_mode is not BufferMode.REFUSE:
            return await axis.in_turn(command, permit, start)
        return await start()

    async def _start(
        self, axis: AxisService, command: AxisCommand[CommandReply], permit: Permit
    ) -> CommandReply:
        reply = await axis.execute(command, permit)
        moving = axis.tracker.command is not None and axis.tracker.command.command_id == permit.command_id
        ends_later = command.ends is Ends.BY_READING and moving
        status = CommandStatus.EXECUTING if ends_later else CommandStatus.DONE
        self._ledger.answered(permit.command_id, reply, status)
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
            if not self._rig.axis(name).stoppable:
                status, reason = CommandStatus.REFUSED, "its drive cannot be stopped over its line"
            elif name not in confirmed:
                status, reason = (
                    CommandStatus.UNKNOWN,
                    "the drive did not confirm it yet; the axis is latched",
                )
            command_id = self.events.next_command_id()
            self._ledger.open(Entry(command_id, name, command, command.client, login, status, reason))

    def why(self, axis: AxisService, request: Why) -> WhyReply:
        """Tell why a motion of this axis would be refused now, and what would clear that; no effect."""

        def admit() -> None:
            self._refuse_rival(axis.config.name)
            self.authority.admit(axis.config.name, request.lease, None, self._clock.now_s())

        return explain(axis.tracker, admit, absolute=request.absolute)

    def _admit_rehearsal(self, command: Rehearse) -> None:
        """Refuse a loss played on axes that its sender may not move."""
        for axis in concerned(self._rig, command):
            self._refuse_rival(axis)
            self.authority.admit(axis, command.lease, None, self._clock.now_s())

    def _admit_module(self, module: ModuleService, command: SetIo | SetIoTimer) -> None:
        """Refuse outputs to who may not move the axes of the module's line, and while one of them is stopped.

        What an output switches is not known: it may move something.
        """
        for name in module.axes:
            self._refuse_rival(name)
            holder = self.authority.holder(name)
            own = holder.token if holder and holder.token in command.leases else command.lease
            self.authority.admit(name, own, None, self._clock.now_s())
            guards.check_not_latched(self._rig.axis(name).tracker)

    async def _answer_again(self, entry: Entry) -> CommandReply:
        """Answer a repeated id as the first time, once there is an answer."""
        if under_way := self._under_way.get(entry.command_id):
            await under_way.wait()
            entry = self._ledger.get(entry.command_id)
        if isinstance(entry.answer, CommandReply):
            return entry.answer
        raise entry.answer or OutcomeUnknown(
            f"axis {entry.axis}: the outcome of {entry.verb} is unknown", axis=entry.axis
        )

    def _admit(self, axis: str, command: AxisCommand[CommandReply]) -> str | None:
        """Refuse a command that is stale, late or sent by another client; return its sender, if it names one."""
        if command.effect is Effect.REST:
            return None
        self._refuse_rival(axis)
        if command.instance not in (None, self._instance):
            raise CommandExpired(
                f"axis {axis}: {command.verb} was sent to another run of the daemon;"
                " it is unknown whether it was carried out",
                axis=axis,
                value=command.instance,
                limit=self._instance,
                remedy="look where the axis is, then send a new command to this run",
            )
        self._refuse_late(axis, command)
        return self.authority.admit(axis, command.lease, command.sequence, self._clock.now_s())

    def _right(self, axis: str, command: AxisCommand[CommandReply]) -> Right:
        """Return what must still hold of the sender when a motion of its command begins."""

        def holds() -> None:
            self._refuse_rival(axis)
            self.authority.check_held(axis, command.lease, self._clock.now_s())

        if command.not_after is None:
            return Right(holds)
        return Right(holds, lambda: self._refuse_late(axis, command))

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
        if self.rival:
            raise DuplicateDaemon(
                f"axis {axis}: another daemon ({self.rival}) serves rig {self._rig.name}; nothing is moved",
                axis=axis,
                value=self.rival,
                remedy="end one of the two daemons",
            )

    async def _set_speed_override(self, command: SetSpeedOverride) -> SpeedOverrideReply:
        """Scale the velocities of all axes; to lower them needs no right, as a stop needs none."""
        share = command.percent / 100.0
        axes = [self._rig.axis(name) for name in self._rig.axes]
        if any(share > axis.tracker.speed_share for axis in axes):
            for name in self._rig.axes:
                self._refuse_rival(name)
                holder = self.authority.holder(name)
                own = holder.token if holder and holder.token in command.leases else None
                self.authority.admit(name, own, None, self._clock.now_s())
        log.info("speed override", percent=command.percent, client=command.client)
        changed, halted = [], []

        async def change(axis: AxisService) -> None:
            name = axis.config.name
            try:
                other_speed, at_rest = await axis.set_speed_share(share)
            except LdcndError as error:
                log.warning("motion goes on at its speed", axis=name, reason=error.message)
                return
            if other_speed:
                changed.append(name)
            if at_rest:
                halted.append(name)

        async with asyncio.TaskGroup() as group:
            for axis in axes:
                group.create_task(change(axis), name=f"speed override {axis.config.name}")
        return SpeedOverrideReply(percent=command.percent, changed=tuple(sorted(changed)), halted=tuple(sorted(halted)))

    async def _move_together(
        self, command: MoveTogether | WalkPath, login: str | None
    ) -> MoveTogetherReply | PathReply:
        execute = partial(self.carry_out, login=login)
        reply: MoveTogetherReply | PathReply
        if isinstance(command, WalkPath):
            reply = await walk_path(self._rig, command, execute)
        else:
            straight, deviation = command.path is LinePath.LINEAR, command.max_deviation
            reply = await move_together(
                self._rig, _shares(command), execute, straight=straight, max_deviation=deviation
            )
        share = self._ledger.get(reply.replies[0].command_id).command
        if isinstance(share, (GroupMoveRequest, PathShareRequest)):  # the first time that these ids came
            reply = share.rendezvous.reply(reply.replies)
        return reply

    # -- the rig as a whole; nothing here moves anything -----------------------------------------------------------

    def _of_rig(self, command: Command[Frozen]) -> Frozen:
        now_s = self._clock.now_s()
        match command:
            case Acquire():
                return self._acquire(command)
            case Renew():
                return _reply(self.authority.renew(command.lease, now_s))
            case Release():
                return _reply(self.leases.release(command.lease, leave_running=command.leave_running))
            case ListHolders():
                return self._holders()
            case ReadOutcome():
                return self._outcome(command)
            case ReadEvents():
                return self.events.page(command)
            case ReadWireLog():
                return wire_page(self._rig, command, self._clock)
            case _:
                raise InternalError(f"nothing carries out {command.verb}")

    def _acquire(self, request: Acquire) -> LeaseReply:
        lease = self.leases.acquire(request)
        self._journal.asked(RIG_ITSELF, request, lease.token)
        return _reply(lease)

    def _holders(self) -> HolderList:
        holders = [(axis, self.authority.holder(axis)) for axis in self._rig.axes]
        return HolderList(
            required=self.authority.required,
            holders=tuple(Holder(axis=axis, client=lease.client if lease else None) for axis, lease in holders),
        )

    def _outcome(self, request: ReadOutcome) -> CommandOutcome:
        entry = self._ledger.get(request.command_id)
        arrival = entry.arrival
        return CommandOutcome(
            command_id=entry.command_id,
            axis=entry.axis,
            verb=entry.verb.value,
            status=entry.status,
            reason=entry.reason,
            position=arrival.position if arrival else None,
            following_error=arrival.following_error if arrival else None,
            settled=arrival.settled if arrival else None,
        )


def _status(error: LdcndError) -> CommandStatus:
    match error:
        case OutcomeUnknown():
            return CommandStatus.UNKNOWN
        case RequestRefused():
            return CommandStatus.REFUSED
        case _:
            return CommandStatus.FAILED


def _reply(lease: Lease) -> LeaseReply:
    return LeaseReply(lease=lease.token, client=lease.client, axes=tuple(sorted(lease.axes)), lease_s=lease.duration_s)


Execute = Callable[[str, AxisCommand[CommandReply]], Awaitable[CommandReply]]
"""Carries out a command of an axis, after all checks of the daemon."""


async def move_together(
    rig: Rig,
    moves: Mapping[str, MoveAbsolute],
    execute: Execute,
    *,
    straight: bool = False,
    max_deviation: float | None = None,
) -> MoveTogetherReply:
    """Start absolute moves of several axes together; returns once every drive has proven that it started.

    Args:
        rig: the daemon's.
        moves: by axis name; exactly the members of one configured group.
        execute: how a single command is carried out.
        straight: they keep to a straight line.
        max_deviation: the line is refused if they would leave it by more, in axis units.

    Raises:
        UnknownAxis: there is no such axis.
        NotSupported: the axes are on different lines, or are no group.
        RequestRefused: a member cannot move, or they would leave the line; nothing was started.
        BusError: the line failed; `OutcomeUnknown` when a drive may have started, then all were commanded to stop.
    """
    line = _line_of(rig, moves)
    meeting = Meeting(line.network, frozenset(moves), straight=straight, max_deviation=max_deviation)

    requests = {name: GroupMoveRequest.of(move, meeting) for name, move in moves.items()}
    return meeting.reply(await _all_of(requests, meeting, execute))


async def walk_path(rig: Rig, command: WalkPath, execute: Execute) -> PathReply:
    """Walk axes along a polyline; returns once every drive walks.

    Raises:
        MalformedRequest: an axis is named twice, or the axes have differently many corners.
        UnknownAxis, NotSupported, RequestRefused, BusError: as `move_together`.
    """
    via = {move.axis: move.via for move in command.moves}
    if len({len(corners) for corners in via.values()}) > 1 or len(via) < len(command.moves):
        raise MalformedRequest("a path names each axis once, with equally many corners", remedy="see `via`")
    line = _line_of(rig, via)
    path = SharedPath(line.network, line.bus, frozenset(via), command.speed, command.max_deviation)
    moves = {move.axis: MoveAbsolute(**move.model_dump(exclude={"axis", "via"})) for move in command.moves}

    requests = {name: PathShareRequest.of(move, via[name], path) for name, move in moves.items()}
    return path.reply(await _all_of(requests, path, execute))


async def _all_of(
    requests: Mapping[str, AxisCommand[CommandReply]], rendezvous: Rendezvous, execute: Execute
) -> tuple[CommandReply, ...]:
    """Have each axis carry out its part; returns once all have started, and raises why none did."""

    async def take_part(name: str, request: AxisCommand[CommandReply]) -> CommandReply | LdcndError:
        try:
            return await execute(name, request)
        except LdcndError as error:
            rendezvous.fail(error)
            return error

    async with asyncio.TaskGroup() as group:
        tasks = [
            group.create_task(take_part(name, request), name=f"{request.verb} {name}")
            for name, request in requests.items()
        ]
    replies = []
    for task in tasks:
        result = task.result()
        if isinstance(result, LdcndError):
            raise rendezvous.failure or result
        replies.append(result)
    return tuple(replies)


def preview_together(rig: Rig, request: PreviewTogether) -> PreviewTogetherReply:
    """Plan moves of a group without sending anything.

    Raises:
        UnknownAxis, NotSupported, RequestRefused: as `move_together`, but for what is in the way only now.
    """
    moves = _shares(request)
    _line_of(rig, moves)
    axes = {name: rig.axis(name).planned(move) for name, move in moves.items()}
    plans, deviation = {name: plan for name, (_, plan) in axes.items()}, None
    if request.path is LinePath.LINEAR:
        plans, deviation = plans_on_line(axes, request.max_deviation)
    shares = tuple(
        AxisShare(
            axis=name,
            position=axes[name][0].shown(plan.position) or 0.0,
            velocity=plan.velocity,
            acceleration=plan.acceleration,
            duration_s=plan.duration_s or 0.0,
        )
        for name, plan in plans.items()
    )
    longest_s = max(share.duration_s for share in shares)
    return PreviewTogetherReply(shares=shares, duration_s=longest_s, deviation=deviation)


def _shares(command: GroupMoves) -> dict[str, MoveAbsolute]:
    moves = {move.axis: MoveAbsolute(**move.model_dump(exclude={"axis"})) for move in command.moves}
    if len(moves) < len(command.moves):
        raise MalformedRequest("a group move names each axis once", remedy="send one move for each axis")
    return moves


def _line_of(rig: Rig, names: Iterable[str]) -> BusService:
    """Return the line that all these axes are on.

    Raises:
        UnknownAxis, NotSupported: as `move_together`.
    """
    wanted = list(names)
    lines = {bus for bus in rig.buses for name in wanted if rig.axis(name) in bus.axes}
    if len(lines) != 1:
        raise NotSupported(f"axes {', '.join(wanted)} are not on one line, so they cannot start together")
    (line,) = lines
    return line
