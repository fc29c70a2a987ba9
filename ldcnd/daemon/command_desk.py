"""Where commands are admitted: authority, freshness, at most once; then the axis, then the ledger."""

import asyncio
from collections.abc import Callable

from ldcnd.daemon.authority import Authority
from ldcnd.daemon.axis_service import AxisService
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.explaining import explain
from ldcnd.daemon.ledger import Entry, Ledger
from ldcnd.daemon.rig import Rig
from ldcnd.errors import CommandExpired, DuplicateDaemon, LdcndError, OutcomeUnknown, RequestRefused
from ldcnd.model.events import CommandStatus
from ldcnd.model.replies import CommandReply
from ldcnd.model.requests import BufferMode, MoveRequest, Request, StopRequest, Verb
from ldcnd.model.why import WhyReply, WhyRequest

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

    async def carry_out(self, axis_name: str, verb: Verb, request: Request, login: str | None = None) -> CommandReply:
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
        self._ledger.open(Entry(command_id, axis_name, verb, request, client, login))
        over = self._under_way[command_id] = asyncio.Event()
        try:
            return await self._execute(axis, verb, request, command_id)
        except LdcndError as error:
            self._ledger.answered(command_id, error, _status(error))
            raise
        except BaseException:
            self._ledger.answered(command_id, OutcomeUnknown("the command was cut short"), CommandStatus.UNKNOWN)
            raise
        finally:
            del self._under_way[command_id]
            over.set()

    async def _execute(self, axis: AxisService, verb: Verb, request: Request, command_id: str) -> CommandReply:
        if isinstance(request, MoveRequest) and request.buffer_mode is not BufferMode.REFUSE:
            return await axis.in_turn(request.buffer_mode, lambda: self._start(axis, verb, request, command_id))
        return await self._start(axis, verb, request, command_id)

    async def _start(self, axis: AxisService, verb: Verb, request: Request, command_id: str) -> CommandReply:
        reply = await axis.execute(verb, request, command_id)
        moving = axis.tracker.command is not None and axis.tracker.command.command_id == command_id
        status = CommandStatus.DONE if verb in AT_ONCE or not moving else CommandStatus.EXECUTING
        self._ledger.answered(command_id, reply, status)
        return reply

    def stopped(
        self, names: tuple[str, ...], confirmed: tuple[str, ...], request: StopRequest, login: str | None
    ) -> None:
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

    def why(self, axis: AxisService, request: WhyRequest) -> WhyReply:
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

    def _admit(self, axis: str, verb: Verb, request: Request) -> str | None:
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
        if request.not_after is not None and self._clock.now_ns() > request.not_after:
            late_s = (self._clock.now_ns() - request.not_after) / 1e9
            raise CommandExpired(
                f"axis {axis}: {verb} came {late_s:.3f} s after its sender had stopped waiting for it",
                axis=axis,
                value=request.not_after,
                remedy="send it again if it is still wanted",
            )
        return self._authority.admit(axis, request.lease, request.sequence, self._clock.now_s())

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
