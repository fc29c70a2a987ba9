"""The state of an axis for a program: its last values with their age, a motion from start to end, a jog."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from ldcnd.client.ends import CHECK_PERIOD_S, forgotten, until_ended
from ldcnd.client.notebook import table
from ldcnd.client.rest import drive_silent
from ldcnd.contract.commands import CommandReply, Jog
from ldcnd.contract.condition import Condition, assess
from ldcnd.contract.errors import CommandAborted, DriveFault, LdcndError, OutcomeUnknown
from ldcnd.contract.events import FINAL, CommandOutcome, CommandStatus
from ldcnd.contract.samples import AxisState, LinkState, Moving, PositionSample, Quality, StateSample

if TYPE_CHECKING:
    from ldcnd.client.axis import Axis

ENDED = FINAL - {CommandStatus.UNKNOWN}
"""How a motion has ended that does not go on: of one whose outcome is unknown that is not known."""


@dataclass(frozen=True, slots=True)
class Position:
    """Where an axis was.

    Attributes:
        sample: as it was published.
        age_s: for how long it is known here, in seconds; how old it was on arrival, `sample.t` tells.
        state: of the axis, as it was published last; None before the first.
        state_age_s: for how long that is known here, in seconds; None without one.
        rate_hz: how many positions a second its daemon is asked for; None while that is not known.
    """

    sample: PositionSample
    age_s: float
    state: StateSample | None = None
    state_age_s: float | None = None
    rate_hz: float | None = None

    @property
    def condition(self) -> Condition:
        """Whether the position says where the axis is, and all that is to be said of it."""
        return assess(
            self.state,
            age_s=self.age_s,
            state_age_s=self.state_age_s,
            position_quality=self.quality,
            rate_hz=self.rate_hz,
        )

    @property
    def value(self) -> float:
        """Position in axis units."""
        return self.sample.value

    @property
    def unit(self) -> str:
        """The axis unit."""
        return self.sample.unit

    @property
    def quality(self) -> Quality:
        """How much the value is worth."""
        return self.sample.quality

    def __float__(self) -> float:
        return self.sample.value

    def __str__(self) -> str:
        uncertainty = "" if self.quality is Quality.GOOD else f", {self.quality}"
        where = self.condition.position(f"{self.value:.4f}", self.unit)
        return f"{where} ({self.age_s:.2f} s old{uncertainty})"


@dataclass(frozen=True, slots=True)
class State:
    """In which state an axis was.

    Attributes:
        sample: as it was published.
        age_s: for how long it is known here, in seconds.
        position: behind a motion where it has ended, in axis units; otherwise None.
        following_error: target minus that position, in axis units.
        settled: whether the axis came to rest within its window in time; None without a target.
        rate_hz: how many positions a second its daemon is asked for; None while that is not known.
    """

    sample: StateSample
    age_s: float
    position: float | None = None
    following_error: float | None = None
    settled: bool | None = None
    rate_hz: float | None = None

    @property
    def state(self) -> AxisState:
        """PLCopen state."""
        return self.sample.state

    @property
    def enabled(self) -> bool:
        """The position loop is closed."""
        return self.sample.enabled

    @property
    def referenced(self) -> bool:
        """The position means something."""
        return self.sample.referenced

    @property
    def moving(self) -> Moving:
        """Whether it moves; unknown when the drive does not answer."""
        return self.sample.moving

    @property
    def link(self) -> LinkState:
        """Whether the drive answers."""
        return self.sample.link

    @property
    def stop_latched(self) -> bool:
        """A stop is latched; only reset clears it."""
        return self.sample.stop_latched

    def __str__(self) -> str:
        return f"{assess(self.sample, age_s=self.age_s, rate_hz=self.rate_hz).summary} ({self.age_s:.2f} s old)"


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a motion is.

    Attributes:
        position: where the axis is, in its units.
        left: how far it still has to go, signed; None for a motion without an end of its own, and on an axis with a
            modulo, where turns may lie between.
        unit: of both.
    """

    position: float
    left: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class Sent:
    """The last motion that this client has begun, beside the states that are published of the axis.

    Attributes:
        reply: to its command.
        run: of the daemon that has replied, as `RigClient.run` has it: the states of another one do not go on from it.
        asked: the requested target, in axis units, before the drive's registers rounded it; None without one, and on
            an axis with a modulo, where the reply counts within a turn.
    """

    reply: CommandReply
    run: str | None
    asked: float | None = None

    def target(self, state: StateSample) -> float | None:
        """Return where the axis was sent last or came to rest after anything else; None where only a position tells.

        Args:
            state: the last one of that run that has arrived; it may be older than the reply.
        """
        reply, named = self.reply, state.command is not None and state.command.command_id == self.reply.command_id
        is_older = reply.since is not None and state.t <= reply.since and not named
        target = reply.position if is_older else state.target
        is_reply = target is not None and target == reply.position
        return self.asked if is_reply and self.asked is not None else target


def set_point(state: StateSample, here: Callable[[], float], sent: Sent | None, run: str | None) -> float:
    """Return where an axis was sent last, by any program; where it is, once anything else stopped or moved it.

    Args:
        state: the last one that has arrived.
        here: returns the last position, in axis units.
        sent: the last motion that this program has begun; None without one.
        run: of the daemon whose states arrive: the clocks of two runs are not compared.
    """
    target = sent.target(state) if sent and sent.run == run else state.target
    return here() if target is None else target


@dataclass(slots=True, eq=False)
class Motion:
    """A command that the drive has acknowledged and that ends later.

    Attributes:
        reply: the request as the drive's registers have it: target, velocity, duration.
        ended: the state after it; None until `done` has returned.
        over: it has ended in any way, as far as this program knows.
    """

    reply: CommandReply
    _axis: "Axis"
    ended: State | None = field(default=None, init=False)
    over: bool = field(default=False, init=False)

    @property
    def command_id(self) -> str:
        """Names the command in events and in the log."""
        return self.reply.command_id

    async def done(self) -> State:
        """Wait until the motion has ended as requested and has settled; return the state after it, and where.

        A motion that does not settle in time ends with `settled` false, or as a fault: see `settle` of the axis.

        A wait that is cancelled, by Ctrl-C or a time-out for example, halts the axis.

        Raises:
            CommandAborted: another command, a stop or a loss policy ended it.
            DriveFault: the drive failed.
            LeaseExpired: control was lost; the axis does what its configuration says for that.
            OutcomeUnknown: the drive, the daemon or the network went silent, or the daemon was restarted.
        """
        try:
            outcome = await self._outcome()
        except asyncio.CancelledError:
            await self._axis.halt_now()
            raise
        self.over = outcome.status in ENDED
        if outcome.status is not CommandStatus.DONE:
            if self._axis.control and outcome.status in (CommandStatus.ABORTED, CommandStatus.REFUSED):
                await self._axis.control.check()  # what took control away has ended it, too
            raise failure(outcome)
        await self._arrival()
        self.ended = replace(
            self._axis.state,
            position=outcome.position,
            following_error=outcome.following_error,
            settled=outcome.settled,
        )
        return self.ended

    async def __aiter__(self) -> AsyncIterator[Progress]:
        """Yield the progress with each value that arrives until the command has ended; `done` tells how.

        A wait for the next value that is cancelled halts the axis, as in `done`; a loop that is left does not.
        """
        try:
            while self._under_way() or not await self._over():
                here = self._axis.position
                to = self.reply.position if here.sample.turns is None else None
                left = None if to is None else to - here.value
                yield Progress(here.value, left, here.unit)
                await self._axis.news(CHECK_PERIOD_S)
        except asyncio.CancelledError:
            await self._axis.halt_now()
            raise

    async def _over(self) -> bool:
        return (await self._axis.outcome(self.command_id)).status in FINAL

    async def _outcome(self) -> CommandOutcome:
        axis = self._axis
        _, outcome = await until_ended(
            axis.name, self.command_id, lambda: axis.state.sample, lambda: axis.news(None), axis.outcome
        )
        if outcome is None:
            raise forgotten(self.reply)
        return outcome

    async def _arrival(self) -> None:
        """Wait, but not for long, for a position that is as new as the state after the end."""
        ended_at = self._axis.state.sample.t
        while self._axis.position.sample.t < ended_at:
            if not await self._axis.news(CHECK_PERIOD_S):
                return

    def _under_way(self) -> bool:
        state = self._axis.state.sample
        if state.link is LinkState.DOWN:
            raise drive_silent(self._axis.name)
        return state.command is not None and state.command.command_id == self.command_id

    def _repr_html_(self) -> str:
        """Return what it is and how it has ended as a table, for notebooks."""
        reply, ended = self.reply, self.ended
        unit = self._axis.position.unit
        values = {
            "target": (reply.position, unit),
            "velocity": (reply.velocity, f"{unit}/s"),
            "acceleration": (reply.acceleration, f"{unit}/s2"),
            "duration": (reply.duration_s, "s"),
            "ended at": (ended.position if ended else None, unit),
            "following error": (ended.following_error if ended else None, unit),
        }
        rows = [(name, f"{value:g} {per}") for name, (value, per) in values.items() if value is not None]
        return table(f"{reply.verb} of {reply.axis}: {'ended' if ended else 'accepted'}", rows)

    def __repr__(self) -> str:
        target = "" if self.reply.position is None else f" to {self.reply.position:g}"
        return f"<{self.reply.verb} of {self.reply.axis}{target}: {'ended' if self.ended else 'accepted'}>"


def failure(outcome: CommandOutcome) -> LdcndError:
    """Return the error for a command that did not end as requested."""
    text = f"axis {outcome.axis}: {outcome.verb} ended as {outcome.status}: {outcome.reason or 'no reason is known'}"
    match outcome.status:
        case CommandStatus.UNKNOWN:
            return OutcomeUnknown(text, axis=outcome.axis)
        case CommandStatus.FAILED:
            return DriveFault(text, axis=outcome.axis)
        case _:
            return CommandAborted(text, axis=outcome.axis)


RENEWALS_PER_HOLD = 4
"""Number of consecutive renewals that may be lost before a jog ends."""


class Jogging:
    """One jog, begun by `begin`. Nothing renews it by itself: it ends when this program hangs, too.

    Args:
        send: sends one command to the axis, under control.
        request: the jog.

    Attributes:
        reply: to its first command; None before.
    """

    def __init__(self, send: Callable[[Jog], Awaitable[CommandReply]], request: Jog) -> None:
        self.reply: CommandReply | None = None
        self._send = send
        self._request = request
        self._due_s = 0.0

    async def begin(self) -> CommandReply:
        """Start it.

        Raises:
            LdcndError: as the daemon refused it.
        """
        self.reply = await self._send(self._request)
        # of its beginning alone: what has come since ends it, as the daemon says then
        of_beginning = dict.fromkeys(("command_id", "after_stops"))
        self._request = self._request.model_copy(update={"renews": self.reply.command_id, **of_beginning})
        self._due_s = asyncio.get_running_loop().time()
        return self.reply

    async def renew(self, velocity: float | None = None, *, hold_s: float | None = None) -> None:
        """Say once that it is held.

        Args:
            velocity: from now on, in units a second; as before when missing. Any drive but PIC-SERVO SC comes to rest
                to change it.
            hold_s: from now on; as before when missing.

        Raises:
            LeaseExpired: it is over: not renewed in time, halted, or at the software limit.
            LdcndError: as the daemon refused it.
        """
        changed = {"velocity": velocity, "hold_s": hold_s}
        given = {name: value for name, value in changed.items() if value is not None}
        self._request = self._request.model_copy(update=given)
        await self._send(self._request)

    async def held(self, velocity: float | None = None) -> None:
        """Say that it is held and return when that is to be said again; see `renew`."""
        await self.renew(velocity)
        loop = asyncio.get_running_loop()
        self._due_s = max(self._due_s + self._request.hold_s / RENEWALS_PER_HOLD, loop.time())
        await asyncio.sleep(self._due_s - loop.time())
