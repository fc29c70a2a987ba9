"""Commands of several axes, of a module or of the rig as a whole, and questions: what is not for one axis alone."""

import asyncio
import math
from collections import defaultdict
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import replace

from ldcnd.axis import guards
from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.axis.obstacles import NO_COMMAND_HELPS
from ldcnd.axis.permit import Right
from ldcnd.axis.procedures.group import GroupMoveRequest
from ldcnd.axis.procedures.path import PathShareRequest
from ldcnd.contract.catalogue import AXIS_COMMANDS, verbs_for
from ldcnd.contract.codec import remedy_steps
from ldcnd.contract.commands import AxisCommand, Capability, Command, CommandReply, Effect, Verb
from ldcnd.contract.errors import (
    InternalError,
    LdcndError,
    NotSupported,
    WrongState,
)
from ldcnd.contract.events import CommandOutcome, CommandStatus, ReadEvents, ReadOutcome
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import RIG_ITSELF
from ldcnd.contract.leases import GuestSentAway, Holder, HolderList, ListHolders, Release, Renew, SendGuestAway
from ldcnd.contract.questions import Cause, Hindered, Preview, ReportShadow, ShadowReply, Why, WhyReply
from ldcnd.contract.rig_commands import (
    IoReply,
    LinePath,
    MoveTogether,
    MoveTogetherReply,
    OverrideInterlock,
    PathReply,
    PreviewTogether,
    ReadWireLog,
    Rehearsal,
    RehearsalReply,
    Rehearse,
    Reload,
    ReloadReply,
    SetIo,
    SetIoTimer,
    SetSpeedOverride,
    Snapshot,
    SpeedOverrideReply,
    WalkPath,
    WireLogReply,
)
from ldcnd.daemon.group_moves import move_together, preview_together, shares_of, walk_path
from ldcnd.daemon.in_time import check_allowed, check_awaited
from ldcnd.daemon.interlocks import Interlocks
from ldcnd.daemon.leases import Authority, LeaseWatch, apply_policy
from ldcnd.daemon.ledger import EventLog, Ledger, status_of
from ldcnd.daemon.line import BusService
from ldcnd.daemon.modules import ModuleService
from ldcnd.daemon.rig import OwnedRig
from ldcnd.line.flight_recorder import WireRecord
from ldcnd.log import get_logger

log = get_logger("commands")

NOT_CONFIRMED = "NOT confirmed by {}: it may move on"
NO_STOP = "NOT stopped: {}; the drive takes no stop over its line"
PAGE_BYTES = 12_000
"""Text in one reply: with its other fields it stays below what a payload may have."""
LONGEST_DATA_BYTES = 2_000
"""Of a longer burst, such as noise on a broken line, only the beginning is shown."""
BACK_WITHIN_S = 20.0
"""Time for a line to come up again whose loss was rehearsed, seconds."""
SAME_OUTPUTS_AFTER_S = 10.0
"""Pause between two events of the same outputs that the same client sets to the same levels again, seconds."""
LINE_OVERHEAD_BYTES = 3
"""Quotation marks and comma in JSON."""


ExecuteFor = Callable[[str, AxisCommand[CommandReply], str | None], Awaitable[CommandReply]]
"""The same for a login."""
Admit = Callable[[str, str | None], None]
"""Raises when nothing may be moved on an axis under a lease, or without one."""


AnswerReload = Callable[[Reload, Callable[[], Mapping[str, str]]], Awaitable[ReloadReply]]
"""Has the configuration read again; the second argument returns the axes that other clients control, and who does."""


async def refuse_reload(command: Reload, _held: Callable[[], Mapping[str, str]]) -> ReloadReply:
    """Refuse a reload of a daemon that was not started from a file."""
    raise NotSupported(f"{command.verb}: this daemon has no file that it could read again", remedy="restart it")


class RigCommands:
    """Carries out what concerns several axes, a module or the rig, and answers questions.

    Attributes:
        answer_reload: has the configuration read again.
    """

    def __init__(
        self,
        rig: OwnedRig,
        authority: Authority,
        leases: LeaseWatch,
        ledger: Ledger,
        events: EventLog,
        clock: Clock,
        execute: ExecuteFor,
        admit: Admit,
        *,
        interlocks: Interlocks,
    ) -> None:
        """Take what the daemon consists of.

        Args:
            rig: all lines and axes.
            authority: the leases.
            leases: gives control and ends it.
            ledger: the outcomes of commands.
            events: what has happened to them.
            clock: of the daemon.
            execute: how a command of one axis is carried out.
            admit: raises when the holder of a lease, or who has none, may not move an axis.
            interlocks: of the rig.
        """
        self._rig = rig
        self._authority = authority
        self._leases = leases
        self._ledger = ledger
        self._events = events
        self._clock = clock
        self._execute = execute
        self._admit = admit
        self._interlocks = interlocks
        self.answer_reload: AnswerReload = refuse_reload
        self._outputs_noted: dict[str, tuple[object, float]] = {}
        self._turns: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)  # by line, see `set_speed_share`

    async def answer(self, axis: str, command: Command[Frozen], login: str | None) -> Frozen:
        """Carry out a command that is not for one axis, or answer a question; see `Dispatcher.answer`.

        Raises:
            LdcndError: as it was refused.
        """
        match command:
            case MoveTogether() | WalkPath():
                return await self._move_together(command, login)
            case SetSpeedOverride():
                return await self._set_speed_override(command)
            case Snapshot():
                return await self._rig.lines[command.bus].snapshot(self._clock)
            case SetIo() | SetIoTimer():
                return await self._set_module(command, login)
            case OverrideInterlock():
                return self._interlocks.override(command)
            case SendGuestAway():
                return await self._send_guest_away(command, login)
            case Reload():
                return await self.answer_reload(command, lambda: self._held_by_others(command.leases))
            case Rehearse():
                for name in concerned(self._rig, command):
                    self._admit(name, command.lease)
                return await rehearse(self._rig, command)
            case Renew():
                return self._authority.renew(command.lease, self._clock.now_s()).reply()
            case Release():
                return self._leases.release(command.lease, leave_running=command.leave_running).reply()
            case _:
                return self._answer_at_once(axis, command)

    async def _set_module(self, command: SetIo | SetIoTimer, login: str | None) -> IoReply:
        if isinstance(command, SetIo):
            return await self._set_io(command, login)
        module = self._rig.modules[command.module]
        return await module.set_timer(command, lambda: self._admit_module(module, command))

    async def _send_guest_away(self, command: SendGuestAway, login: str | None) -> GuestSentAway:
        guest = self._rig.guest(command.port)
        if guest.since_s is None:
            raise WrongState(f"no program uses the port {command.port}", value=command.port)
        axes = tuple(sorted(guest.axes))
        try:
            await guest.send_away()
        except OSError as error:
            raise WrongState(f"the port {command.port} cannot be closed: {error}", value=command.port) from error
        said = f"the program at the port {command.port} was sent away"
        for axis in axes or (RIG_ITSELF,):
            self._events.note(axis, command.verb, CommandStatus.DONE, said, client=command.client, login=login)
        log.info("guest sent away", guest=command.port, client=command.client)
        return GuestSentAway(port=command.port, axes=axes)

    def _answer_at_once(self, axis: str, command: Command[Frozen]) -> Frozen:
        """Answer a question; and publish what an observer says."""
        match command:
            case Why():
                return self._why(self._rig.axes[axis], command)
            case Preview():
                service = self._rig.axes[axis]
                causes = service.obstacles.to_motion(command.motion, speed=command.velocity)
                # a preview names no lease
                not_admitted = refused(lambda: self._admit(axis, None))
                return service.preview(command, tuple(each.text for each in _causes(service, not_admitted + causes)))
            case ReportShadow():
                self._rig.axes[axis].telemetry.publish_shadow(command)
                return ShadowReply(axis=axis)
            case PreviewTogether():
                return preview_together(self._rig, command)
            case ListHolders():
                return self._holders()
            case ReadOutcome():
                return self._outcome(command)
            case ReadEvents():
                return self._events.page(command)
            case ReadWireLog():
                return wire_page(self._rig, command, self._clock)
            case _:
                raise InternalError(f"nothing carries out {command.verb}")

    def _why(self, axis: AxisService, request: Why) -> WhyReply:
        """Tell why a motion of this axis would be refused now, and what would clear that."""
        name = axis.config.name
        reply = explain(axis, request, lambda: self._admit(name, request.lease))
        return reply.model_copy(update={"overrides": self._interlocks.overrides(name)})

    def _held_by_others(self, leases: tuple[str, ...]) -> dict[str, str]:
        """Return the axes that other clients control, and who does; without control, an axis is open to all."""
        holders = {name: self._authority.holder(name) for name in self._rig.axes}
        return {name: each.client for name, each in holders.items() if each and each.token not in leases}

    def _own(self, axis: str, leases: tuple[str, ...]) -> str | None:
        """Return which of these leases is the one on an axis; None when another one is, or none."""
        holder = self._authority.holder(axis)
        return holder.token if holder and holder.token in leases else None

    async def _set_io(self, command: SetIo, login: str | None) -> IoReply:
        """Set outputs, and enter who has, or would have: what they switch may move something."""
        module = self._rig.modules[command.module]
        tokens = {command.lease, *command.leases} - {None}
        holders = (self._authority.holder(name) for name in module.axes)
        holder = next((each.client for each in holders if each and each.token in tokens), None)
        what = module.in_words(command)
        status, said, code = CommandStatus.UNKNOWN, what, None

        of, arrived_s = f"module {module.name}", self._clock.now_s()

        def admitted() -> None:
            self._check_not_overtaken(command.after_stops)
            self._admit_module(module, command)

        def in_time() -> None:
            check_allowed(command, of, self._clock.now_ns())
            check_awaited(command, of, self._clock.now_s() - arrived_s)

        try:
            reply = await module.set_io(command, Right(admitted, in_time))
            status = CommandStatus.DONE
        except LdcndError as error:
            status, said, code = status_of(error), f"{what}: {error.message}", error.code.value
            raise
        finally:
            # what only reads is not entered
            if what:
                self._note_outputs(module.name, (status, said, command.client or holder, login), code)
        return reply

    def _note_outputs(
        self, module: str, news: tuple[CommandStatus, str, str | None, str | None], code: str | None
    ) -> None:
        """Enter what became of outputs: status, words, client and login; the same again at once only now and then."""
        now_s = self._clock.now_s()
        before, since_s = self._outputs_noted.get(module, (None, -math.inf))
        if news == before and now_s - since_s < SAME_OUTPUTS_AFTER_S:
            return
        self._outputs_noted[module] = news, now_s
        status, said, client, login = news
        self._events.note(module, SetIo.verb, status, said, client=client, login=login, code=code)

    def _admit_module(self, module: ModuleService, command: SetIo | SetIoTimer) -> None:
        """Refuse outputs to who may not move the axes of the module's line, and while one of them is stopped.

        What an output switches is not known: it may move something. A line that has modules has at least one axis.
        """
        for name in module.axes:
            self._admit(name, self._own(name, command.leases) or command.lease)
            guards.check_not_latched(self._rig.axes[name].tracker)

    def _check_not_overtaken(self, after_stops: Mapping[str, int]) -> None:
        for name, count in after_stops.items():
            guards.check_not_overtaken(self._rig.axes[name].tracker, count)

    def _admit_faster(self, axes: Iterable[AxisService], leases: tuple[str, ...]) -> None:
        """Refuse faster motions, with the names of all axes in the way; one that takes no motions is none of them."""
        refused: dict[str, LdcndError] = {}
        moved = [axis.config.name for axis in axes if verbs_for(Capability.MOTION) & axis.driver.capabilities]
        for name in moved:
            try:
                self._admit(name, self._own(name, leases))
            except LdcndError as error:
                refused[name] = error
        if refused:
            first = next(iter(refused.values()))
            names = ", ".join(refused)
            raise first if len(refused) == 1 else first.although(f"raising the speed needs control of {names}:")

    async def _set_speed_override(self, command: SetSpeedOverride) -> SpeedOverrideReply:
        """Scale the velocities of all axes; to lower them needs no right, as a stop needs none."""
        share = command.percent / 100.0
        axes = list(self._rig.axes.values())
        if any(share > axis.tracker.status.speed_share for axis in axes):
            self._check_not_overtaken(command.after_stops)
            self._admit_faster(axes, command.leases)
        log.info("speed override", percent=command.percent, client=command.client)
        for axis in axes:
            name = axis.config.name
            if share != axis.tracker.status.speed_share:
                holder = self._authority.holder(name)
                who = command.client or (holder.client if holder and command.leases else None)
                self._events.note(
                    name, command.verb, CommandStatus.DONE, f"speed override {command.percent:g} %", client=who
                )
        stops = {axis.config.name: axis.stops_behind(share) for axis in axes}
        became = defaultdict[str, list[str]](list)

        async def change(axis: AxisService) -> None:
            name = axis.config.name
            try:
                motion = await axis.set_speed_share(share, self._turns[_bus_of(self._rig, name).bus.settings.name])
            except LdcndError as error:
                log.warning("motion goes on at its speed", axis=name, reason=error.message)
                motion = "unchanged" if share else "unconfirmed"
            if motion:
                became[motion].append(name)

        async with asyncio.TaskGroup() as group:
            for axis in axes:
                group.create_task(change(axis), name=f"speed override {axis.config.name}")
        lacks = [(NOT_CONFIRMED, became["unconfirmed"]), (NO_STOP, became["unstoppable"])]
        said = [text.format(", ".join(sorted(names))) for text, names in lacks if names]
        return SpeedOverrideReply(
            percent=command.percent,
            changed=tuple(sorted(became["changed"])),
            unchanged=tuple(sorted(became["unchanged"])),
            halted=tuple(sorted(became["halted"] + became["unconfirmed"])),
            confirmed=tuple(sorted(became["halted"])),
            shortfall=f"{'. '.join(said)}. Use the machine's emergency stop." if said else "",
            stops=stops,
        )

    async def _move_together(
        self, command: MoveTogether | WalkPath, login: str | None
    ) -> MoveTogetherReply | PathReply:
        def execute(axis: str, share: AxisCommand[CommandReply]) -> Awaitable[CommandReply]:
            return self._execute(axis, share, login)

        reply: MoveTogetherReply | PathReply
        if isinstance(command, WalkPath):
            reply = await walk_path(self._rig, command, execute)
        else:
            straight, deviation = command.path is LinePath.LINEAR, command.max_deviation
            reply = await move_together(
                self._rig, shares_of(command), execute, straight=straight, max_deviation=deviation
            )
        share = self._ledger.get(reply.replies[0].command_id).command
        # the ledger decides which request was the first: of two that come at once it knows neither before
        if isinstance(share, (GroupMoveRequest, PathShareRequest)):
            reply = share.rendezvous.reply(reply.replies)
        return reply

    def _holders(self) -> HolderList:
        holders = [(axis, self._authority.holder(axis)) for axis in self._rig.axes]
        return HolderList(
            required=self._authority.required,
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


def concerned(rig: OwnedRig, request: Rehearse) -> tuple[str, ...]:
    """Return the axes that a rehearsed loss concerns: a lost line is lost for all on it.

    Raises:
        UnknownAxis: there is no such axis.
    """
    axis = rig.axes[request.axis]
    if request.kind is Rehearsal.BUS_LOSS:
        return tuple(each.config.name for each in _bus_of(rig, request.axis).axes)
    return (axis.config.name,)


async def rehearse(rig: OwnedRig, request: Rehearse) -> RehearsalReply:
    """Play a loss; returns once it was played, the axis may still be coming to rest.

    Raises:
        UnknownAxis: there is no such axis.
        BusDown: its line is not up, or has not come up again.
    """
    axis = rig.axes[request.axis]
    log.warning("rehearsal", axis=request.axis, kind=request.kind.value)
    if request.kind is Rehearsal.DAEMON_STOP:
        policy = axis.config.loss.daemon
        await apply_policy(axis, policy, "rehearsed end of the daemon", daemon_ends=True)
    else:
        bus = _bus_of(rig, request.axis)
        # what is down already cannot be lost
        bus.check_up()
        bus.bus.drop("rehearsed loss")
        try:
            async with asyncio.timeout(BACK_WITHIN_S):  # also where the daemon ends meanwhile: then it never does
                await bus.wait_down()
                await bus.wait_up()
        except TimeoutError:
            bus.check_up()
        policy = axis.config.loss.bus
    return RehearsalReply(kind=request.kind, axis=request.axis, policy=policy.value)


def _bus_of(rig: OwnedRig, name: str) -> BusService:
    return next(bus for bus in rig.buses if any(axis.config.name == name for axis in bus.axes))


def refused(admit: Callable[[], None]) -> list[tuple[LdcndError, bool]]:
    """Return what a check raises as an obstacle, which does not end with a motion; none when it passes."""
    try:
        admit()
    except LdcndError as error:
        return [(error, False)]
    return []


def explain(axis: AxisService, request: Why, admit: Callable[[], None]) -> WhyReply:
    """Say what forbids a motion of an axis, and each of its commands; `admit` raises what its sender may not."""
    not_admitted = refused(admit)
    alike: dict[tuple[str, ...], Hindered] = {}

    def causes_of(verb: Verb) -> tuple[Cause, ...]:
        effect = AXIS_COMMANDS[verb].effect
        asks_right = [] if effect is Effect.QUESTION else not_admitted
        return () if effect is Effect.REST else _causes(axis, asks_right + axis.obstacles.to_command(verb))

    for verb in AXIS_COMMANDS if request.each_command else ():
        causes = causes_of(verb)
        texts = tuple(cause.text for cause in causes)
        others = alike[texts].verbs if texts in alike else ()
        alike[texts] = Hindered(verbs=(*others, verb.value), causes=causes)
    asked = request.command or (Verb.MOVE_ABSOLUTE if request.absolute else Verb.MOVE_RELATIVE)
    takes = request.command is None or asked in axis.driver.capabilities
    if takes and AXIS_COMMANDS[asked].effect is Effect.MOTION:
        causes = _causes(axis, not_admitted + axis.obstacles.to_motion(asked))
    else:
        causes = causes_of(asked)
    status = axis.tracker.status
    first = status.first_fault
    return WhyReply(
        axis=axis.config.name,
        can_move=not causes,
        causes=causes,
        first_fault=guards.in_words(status, first) if first else None,
        commands=tuple(alike.values()),
    )


def _causes(axis: AxisService, obstacles: Iterable[tuple[LdcndError, bool]]) -> tuple[Cause, ...]:
    """Return obstacles as a client gets them; no remedy names a command that the drive does not take."""
    impossible = verbs_for(Capability.MOTION) - axis.driver.capabilities
    causes = []
    for error, passes in obstacles:
        steps = remedy_steps(error)
        possible = not any(each.verb in impossible for each in steps)
        causes.append(
            Cause(
                code=error.code.value,
                text=error.message,
                remedy=error.remedy if possible else NO_COMMAND_HELPS,
                steps=steps if possible else (),
                page=error.page,
                passes=passes,
            )
        )
    return tuple(causes)


def wire_page(rig: OwnedRig, request: ReadWireLog, clock: Clock) -> WireLogReply:
    """Return the requested records of one line, the oldest first, as many as one reply takes.

    Raises:
        ValueOutOfRange: the rig has no such line.
    """
    service = rig.lines[request.bus]
    log = service.bus.wire_log
    entries = log.entries()
    oldest = log.added - len(entries)
    if request.from_record is None:
        skipped = entries.first_since(clock.now_s() - request.seconds)
    else:
        skipped = min(max(0, request.from_record - oldest), len(entries))
    page = _page(WireRecord(*entry) for entry in entries.behind(skipped))
    return WireLogReply(
        bus=request.bus,
        family=service.family,
        zero=clock.wall_ns(0.0),
        started=clock.started_s,
        now=clock.now_s(),
        first_record=oldest + skipped,
        next_record=oldest + skipped + len(page),
        end_record=log.added,
        lines=page,
    )


def _page(records: Iterable[WireRecord]) -> tuple[str, ...]:
    """Return as many lines as one reply takes, one at least."""
    lines: list[str] = []
    room = PAGE_BYTES
    for record in records:
        line = str(_shortened(record))
        room -= len(line.encode()) + LINE_OVERHEAD_BYTES
        if lines and room < 0:
            break
        lines.append(line)
    return tuple(lines)


def _shortened(record: WireRecord) -> WireRecord:
    left_out = len(record.data) - LONGEST_DATA_BYTES
    if left_out <= 0:
        return record
    note = f"{record.note} {left_out} more bytes left out".lstrip()
    return replace(record, data=record.data[:LONGEST_DATA_BYTES], note=note)
