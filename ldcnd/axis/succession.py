"""Moves that come while their axis is at work: each begins behind what goes before it, or in its place.

A motion that goes on from one of its own, as another velocity does on a drive that takes it in mid-move, disturbs
nothing: what waits goes on waiting. Where it could not turn in time it is halted for, as for an aborting one.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable

from ldcnd.axis import guards
from ldcnd.axis.commands import AxisCommands
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import LATENCY_S
from ldcnd.axis.stopping import AxisStops
from ldcnd.axis.turns import CommandQueue
from ldcnd.contract.commands import BufferMode, CommandReply, Move, MoveAbsolute, Verb
from ldcnd.contract.errors import CommandAborted, LdcndError
from ldcnd.contract.events import CommandStatus
from ldcnd.drives.driver import StopMode

HALTS_WITHIN_S = 1.0
"""Longest time that an aborting move is left without an answer while the axis comes to rest, seconds."""


class Succession:
    """The moves of one axis that wait for their turn.

    Attributes:
        beginning: motions on their way to the drive: what was sent before a move begins before it.
    """

    def __init__(self, motion: AxisMotion, commands: AxisCommands, queue: CommandQueue, stops: AxisStops) -> None:
        self.beginning = 0
        self._motion = motion
        self._tracker = motion.tracker
        self._commands = commands
        self._queue = queue
        self._stops = stops
        self._turn = asyncio.Lock()
        self._last = ""  # the last move that came to wait for its turn
        self._newest = self._newest_aborting = 0  # those before it wait in vain
        self._failed_at = 0  # the newest one that waited when one before it failed: it was to begin where that ends

    @property
    def busy(self) -> bool:
        """Whether a motion is about to begin: its loop is to stay closed for it."""
        return self.beginning > 0 or self._turn.locked()

    async def carry_out(
        self,
        move: Move,
        permit: Permit,
        execute: Callable[[], Awaitable[CommandReply]],
        waits: Callable[[str], None] = lambda _: None,
    ) -> CommandReply:
        """Carry out a move after what the axis is doing: after having halted that, or after its end.

        An aborting move that would be refused halts nothing. One that is to be refused while the axis moves is only
        seen to where it goes on from a motion of its own.

        Args:
            move: the move.
            permit: of it.
            execute: begins it.
            waits: called with the id of the command that it waits for: at once for a buffered move, and for an aborting
                one when the axis takes long to come to rest.

        Raises:
            StopLatched: a stop came first.
            CommandAborted: a halt, or a later aborting move, came first.
            StopNotConfirmed: the drive has not confirmed the halt of what goes before it.
            LdcndError: as the move itself, and as `Permit.ask_to_move`: also what has changed while it waited.
        """
        if move.buffer_mode is BufferMode.REFUSE and await self._disturbs_nothing(move, permit):
            return await execute()
        # now, not at its turn: a stop that is latched may be reset while it waits
        permit.ask()
        guards.require(guards.TO_MOVE, self._tracker)
        ahead = self._line_up(move, permit, waits)
        async with self._turn:  # those who wait are served in the order in which they came
            try:
                return await self._in_its_turn(move, permit, ahead, execute, waits)
            except LdcndError:
                self.note_failure()
                raise

    def note_failure(self) -> None:
        """Have buffered moves begin no more that wait for a motion which was refused, or has failed.

        Behind one under way they go on waiting: how that ends is seen.
        """
        if self._tracker.status.command is None:
            self._failed_at = self._newest
            self._queue.changed.set()

    async def _in_its_turn(
        self,
        move: Move,
        permit: Permit,
        ahead: str | None,
        execute: Callable[[], Awaitable[CommandReply]],
        waits: Callable[[str], None],
    ) -> CommandReply:
        patience_s = math.inf
        await self._until_begun(move, permit)
        if self._commands.supersedes(move) and self._tracker.status.command:
            self._ask(permit, move)
            self._check_follows(permit, move)
            if await self._goes_over(move, permit) or not self._commands.supersedes(move):
                return await execute()
            await self._stops.bring_to_rest(StopMode.SMOOTH, by=permit)
            patience_s = HALTS_WITHIN_S
        elif move.buffer_mode is BufferMode.REFUSE:
            return await execute()
        await self._wait_for_the_end(permit, move, ahead, patience_s, waits)
        return await execute()

    async def _until_begun(self, move: Move, permit: Permit) -> None:
        """Wait until what was sent before a move has begun."""
        while self.beginning:
            await self._news(math.inf)
            self._ask(permit, move)

    async def _disturbs_nothing(self, move: Move, permit: Permit) -> bool:
        """Tell whether a move that is to be refused in mid-move can begin: nothing has to be halted for it."""
        if not self._motion.driver.retargets or move.verb not in guards.GOES_ON:
            return True
        await self._until_begun(move, permit)
        if not self._commands.supersedes(move):
            return True
        self._check_follows(permit, move)
        return await self._goes_over(move, permit) or not self._commands.supersedes(move)

    def _line_up(self, move: Move, permit: Permit, waits: Callable[[str], None]) -> str | None:
        """Note a move that comes to wait; tell its sender whether it does; return the command that it is to follow."""
        # behind others that wait it follows the last of these
        ahead, command = self._last if self._turn.locked() else self._active_id, self._tracker.status.command
        if command and self._commands.supersedes(move):
            self._check_follows(permit, move)
            self._newest_aborting = permit.number
            self._queue.changed.set()
        elif ahead is not None and move.buffer_mode is BufferMode.BUFFERED:
            if command and command.verb is not Verb.HOME and isinstance(move, MoveAbsolute):
                self._commands.check(move)  # what can be told now is not kept for later
            waits(ahead)
        self._last, self._newest = permit.command_id, permit.number
        return ahead if move.buffer_mode is BufferMode.BUFFERED else None

    async def _goes_over(self, move: Move, permit: Permit) -> bool:
        """Tell whether the motion under way may go over into a move without a halt."""
        if not self._commands.retargets(move):
            return False
        by_s = self._motion.clock.now_s() + LATENCY_S
        await self._motion.read()  # the latest reading may be as old as the rates let it be
        # again, because the reading has taken its time
        self._ask(permit, move)
        permit.ask_to_move()
        if not self._commands.goes_on(move) or self._motion.clock.now_s() >= by_s:
            return False
        permit.by_s, permit.overtakes = by_s, move.buffer_mode is BufferMode.ABORTING
        return True

    async def _wait_for_the_end(
        self, permit: Permit, move: Move, ahead: str | None, patience_s: float, waits: Callable[[str], None]
    ) -> None:
        """Wait until the command under way is over; tell once when that takes longer than a time."""
        deadline_s = self._motion.clock.now_s() + patience_s
        while self._tracker.status.command:
            ahead = self._active_id
            self._ask(permit, move)
            if not await self._news(deadline_s):
                # said once: from here on its sender waits for no reply
                deadline_s = math.inf
                waits(self._active_id or permit.command_id)
        self._ask(permit, move)
        end = self._tracker.status.last_end
        if end and end.command.command_id == ahead and end.status is CommandStatus.FAILED:
            name = self._motion.config.name
            raise CommandAborted(f"axis {name}: the {end.command.verb} before it has failed: {end.reason}", axis=name)

    async def _news(self, deadline_s: float) -> bool:
        """Wait for a change that a move which waits for its turn has to look at; tell whether it came in time."""
        # no await between the look before and the wait, so that no change is missed
        self._queue.changed.clear()
        try:
            async with asyncio.timeout_at(None if math.isinf(deadline_s) else deadline_s):
                await self._queue.changed.wait()
        except TimeoutError:
            return False
        return True

    def _ask(self, permit: Permit, move: Move) -> None:
        """Raise when a move must not wait for its turn any more."""
        permit.ask()
        # its sender has been told that the axis cannot be stopped: when it can be again nothing may set off by itself
        guards.check_stop_confirmed(self._tracker)
        if permit.number < self._newest_aborting:
            name = self._motion.config.name
            raise CommandAborted(f"axis {name}: {permit.verb} was overtaken by a later motion", axis=name)
        if move.buffer_mode is BufferMode.BUFFERED and permit.number <= self._failed_at:
            name = self._motion.config.name
            raise CommandAborted(
                f"axis {name}: a motion before this {permit.verb} was refused or has failed", axis=name
            )

    def _check_follows(self, permit: Permit, move: Move) -> None:
        """Refuse a move that would be refused once the axis stands, before anything is halted for it."""
        permit.ask_to_move()
        self._commands.check(move)

    @property
    def _active_id(self) -> str | None:
        return self._tracker.status.command.command_id if self._tracker.status.command else None
