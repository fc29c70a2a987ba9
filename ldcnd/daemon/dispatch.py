"""Commands, from a decoded request to its reply: who may, whether again, whether in time, and what came of it.

A command is written into the flight recorder of its line, admitted, entered into the ledger, and carried out by its
axis. What is not for one axis alone is in rig_commands.py.
"""

import asyncio
from collections.abc import Callable

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.axis.events import LatchNamed
from ldcnd.axis.guards import check_not_overtaken
from ldcnd.axis.permit import UNCONDITIONAL, Permit, Right
from ldcnd.axis.status import LatchedBy
from ldcnd.config.interlocks import InterlockConfig
from ldcnd.contract.commands import (
    AxisCommand,
    Command,
    CommandReply,
    Effect,
    Ends,
    Jog,
    Move,
    MoveAbsolute,
    QuickStop,
    Stop,
)
from ldcnd.contract.errors import (
    CommandExpired,
    DuplicateDaemon,
    LdcndError,
    OutcomeUnknown,
)
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import RIG_ITSELF
from ldcnd.contract.leases import Acquire
from ldcnd.daemon.in_time import check_allowed, check_awaited
from ldcnd.daemon.interlocks import Interlocks
from ldcnd.daemon.journal import Journal
from ldcnd.daemon.leases import Authority, LeaseWatch
from ldcnd.daemon.ledger import EventLog, Ledger, LedgerEntry, status_of
from ldcnd.daemon.rig import OwnedRig
from ldcnd.daemon.rig_commands import RigCommands
from ldcnd.log import get_logger

log = get_logger("commands")

Accept = Callable[[CommandReply], None]


class Dispatcher:
    """Hands every command to what carries it out, each command id at most once, and keeps the outcomes.

    Attributes:
        authority: the leases of the rig.
        leases: gives control and ends it.
        events: what happens to its commands.
        interlocks: what motions and outputs require.
        rig_commands: carry out what is not for one axis.
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
        self.rig_commands = RigCommands(
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
                return await self.rig_commands.answer(axis, command, login)

    async def carry_out(
        self,
        axis_name: str,
        command: AxisCommand[CommandReply],
        login: str | None = None,
        accept: Accept = lambda _: None,
    ) -> CommandReply:
        """Carry out a command of an axis, or answer as the first time when its id is known.

        What takes energy out passes no gate: its lease, run, deadline, id and count of stops are not asked, nor is
        another daemon.

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
        target = command.position if isinstance(command, MoveAbsolute) else None
        # before its hold: a jog that was not entered must not be renewed into life
        self._enter(LedgerEntry(command_id, axis_name, command, client, login, target=target))
        hold = axis.begin_hold(command_id, command) if isinstance(command, Jog) else None
        if hold:
            right = right.also(lambda: hold.check(self._clock.now_s()))
        permit = axis.permit(command_id, command.verb, right)
        over = self._under_way[command_id] = asyncio.Event()
        try:
            if isinstance(command, Move):

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
        """Refuse a command that is stale, late, overtaken or of another client; return its sender, if it names one."""
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
        check_allowed(command, f"axis {axis}", self._clock.now_ns(), axis)
        check_not_overtaken(self._rig.axes[axis].tracker, command.after_stops)
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
            check_allowed(command, f"axis {axis}", self._clock.now_ns(), axis)
            if not accepted.is_set():
                check_awaited(command, f"axis {axis}", self._clock.now_s() - arrived_s, axis)

        return Right(holds, in_time)

    def _refuse_rival(self, axis: str) -> None:
        if self.rivals:
            others = ", ".join(sorted(self.rivals))
            raise DuplicateDaemon(
                f"axis {axis}: rig {self._rig.name} is served by other daemons, too ({others}); nothing is moved",
                axis=axis,
                value=others,
                remedy="end all but one of the daemons",
            )
