"""One axis as a program sees it: a method for each verb, its last values, its positions as they come."""

import asyncio
import contextlib
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from typing import Any, TypeVar

from ldcnd.client.lease import Control
from ldcnd.client.motion import ENDED, Jogging, Motion, Position, Sent, State, set_point
from ldcnd.client.notebook import table
from ldcnd.client.overview import health_reports, last_bus_health
from ldcnd.client.rest import REST_S, until_at_rest
from ldcnd.client.rig_client import RigClient
from ldcnd.client.traces import Trace, armed_trace, fetch_trace, wait_for_trace
from ldcnd.client.verbs import AxisVerbs
from ldcnd.contract.codec import decode_received, valid
from ldcnd.contract.commands import AxisCommand, BufferMode, Command, CommandReply, Halt, Jog, Power, StopReply, Verb
from ldcnd.contract.condition import assess
from ldcnd.contract.errors import LdcndError, LeaseExpired, MalformedRequest, RequestRefused, SessionError, UnknownAxis
from ldcnd.contract.events import FINAL, CommandOutcome
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.health import BusHealth, DaemonHealth
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.number_text import NotANumber
from ldcnd.contract.samples import PositionSample, StateSample, TelemetryItem
from ldcnd.contract.traces import TakeTrace, TraceTrigger
from ldcnd.contract.units import DIMENSIONS, read_quantity
from ldcnd.net.session import Publication, SampleKind

LINGER_S = 0.03
"""Time that a position may wait for others, seconds: waking a program for each one costs more than all else."""
KEPT_SAMPLES = 256
"""Maximum number of samples kept for a slow reader; the oldest are dropped."""
HALT_S = 2.0
"""Longest time that a cancelled wait takes to halt its axis, in seconds."""

ReplyT = TypeVar("ReplyT", bound=Frozen)
CommandT = TypeVar("CommandT", bound=Frozen)
AxisReplyT = TypeVar("AxisReplyT", bound=CommandReply)


class Positions:
    """The positions of an axis from now on, as an endless iterator; made by `Axis.positions`.

    Attributes:
        dropped: how many samples its reader was too slow for.
    """

    def __init__(self, axis: "Axis") -> None:
        self.dropped = 0
        self._axis = axis
        self._kept: deque[Publication] = deque()

    def take(self, sample: Publication) -> None:
        """Take a sample from the axis."""
        if len(self._kept) == KEPT_SAMPLES:
            self._kept.popleft()
            self.dropped += 1
        self._kept.append(sample)

    def __aiter__(self) -> "Positions":
        return self

    async def __anext__(self) -> PositionSample:
        """Return the next position.

        Raises:
            LeaseExpired: control of the axis was lost.
        """
        while not self._kept:
            await self._axis.news(None)
        sample = self._kept.popleft()
        return decode_received(PositionSample, sample.payload, sample.encoding)


class Axis(AxisVerbs):
    """An axis that a program controls or watches; made by `Rig.control` and `Rig.watch`.

    Attributes:
        name: of the axis.
    """

    def __init__(self, name: str, client: RigClient, loop: asyncio.AbstractEventLoop) -> None:
        self.name = name
        self.control: Control | None = None
        self._client = client
        self._loop = loop
        self._state: tuple[StateSample, float] | None = None
        self._position: tuple[Publication | PositionSample, float] | None = None
        self._rate_hz: float | None = None  # of its positions, as its daemon was asked for them; None until it reports
        self._sent: Sent | None = None
        self._changed = asyncio.Event()
        self._readers: weakref.WeakSet[Positions] = weakref.WeakSet()
        self._last: Motion | None = None  # of those begun here: what came before it has ended when it has
        self.unanswered: set[object] = set()  # motions that were sent, without an answer or a halt behind them
        self._halting: set[asyncio.Task[bool]] = set()
        self.comes_to_rest = False  # it was halted or stopped from here, and sent nowhere since

    # -- what it says ------------------------------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """The last state.

        Raises:
            SessionError: none has come yet.
        """
        if self._state is None:
            raise self._silent()
        sample, at_s = self._state
        return State(sample, self._loop.time() - at_s, rate_hz=self._rate_hz)

    @property
    def position(self) -> Position:
        """The last position.

        Raises:
            SessionError: none has come yet.
        """
        if self._position is None:
            raise self._silent()
        sample, at_s = self._position
        if isinstance(sample, Publication):
            sample = decode_received(PositionSample, sample.payload, sample.encoding)
            self._position = sample, at_s
        now_s = self._loop.time()
        if self._state is None:
            return Position(sample, now_s - at_s, rate_hz=self._rate_hz)
        state, state_at_s = self._state
        return Position(sample, now_s - at_s, state, now_s - state_at_s, self._rate_hz)

    @property
    def target(self) -> float:
        """Where it was sent last, by any program, in axis units; where it is, once anything else stopped or moved it.

        Raises:
            SessionError: nothing has come from it yet.
        """
        return set_point(self.state.sample, lambda: self.position.value, self._sent, self._client.run)

    async def at(self, t: int) -> AxisInstant:
        """Return where it was at an instant of the last 600 s, UTC in ns since 1970, with bounds that hold.

        Raises:
            MalformedRequest: it is no instant.
        """
        return (await self._client.at(t, self.name))[self.name]

    async def between(self, t: int, until: int) -> list[AxisInstant]:
        """Return where it was in a range; see `Rig.between`.

        Raises:
            MalformedRequest: it is no range, or one with more than 1000 readings.
        """
        return (await self._client.past(f"[{t}..{until}]", self.name))[self.name]

    def positions(self) -> Positions:
        """Iterate over the positions that come from now on; several readers do not disturb each other."""
        reader = Positions(self)
        self._readers.add(reader)
        return reader

    async def news(self, within_s: float | None) -> bool:
        """Wait until a state or a position arrives; tell whether that was in time.

        Raises:
            LeaseExpired: control was lost.
        """
        self._refuse_lost()
        self._changed.clear()
        try:
            async with asyncio.timeout(within_s):
                await self._changed.wait()
        except TimeoutError:
            return False
        self._refuse_lost()
        return True

    # -- what it does ------------------------------------------------------------------------------------------------

    async def stop(self) -> StopReply:
        """Stop at once and latch: nothing moves again before `reset`. Needs no control and is never refused."""
        over = self._so_far()
        reply = await self._client.stop(self.name, client=self._who)
        self.comes_to_rest = True
        if self.name in reply.confirmed:
            over()
        return reply

    @contextlib.asynccontextmanager
    async def jogging(
        self, velocity: float | str, *, acceleration: float | str | None = None, hold_s: float = 0.4
    ) -> AsyncIterator[Jogging]:
        """Jog for as long as `Jogging.held` is called; the end of the context halts the axis, whatever ends it.

        What the axis does already, such as coming to rest from another jog, is halted first.

        Args:
            velocity: in units a second, positive forward, not 0; or a text with its unit, such as "300 rpm".
            acceleration: in units a second squared, or likewise; the axis default when missing.
            hold_s: longest time between two renewals, 0.2 to 1 s; then the daemon ends the jog.

        Raises:
            LdcndError: as the daemon refused it.
        """
        fields = {"velocity": velocity, "acceleration": acceleration, "hold_s": hold_s}
        jog = Jogging(self._sent_as, await self._made(Jog, {**fields, "buffer_mode": BufferMode.ABORTING}))
        async with on_the_way(self):  # one that is refused has begun nothing, and halts nothing
            await jog.begin()
        try:
            yield jog
        finally:
            await self.halt_now()

    async def take_trace(
        self,
        *channels: str,
        samples: int = 500,
        interval_s: float | None = None,
        pre_trigger: int = 0,
        trigger: TraceTrigger | None = None,
        within_s: float = 60.0,
    ) -> Trace:
        """Record channels against time and return the complete trace; one that is cancelled ends in the drive, too.

        Args:
            channels: what to record; `meta/axes/<axis>` lists what the axis has.
            samples: how many.
            interval_s: time between two of them; as fast as the line allows when missing.
            pre_trigger: number of samples before the trigger.
            trigger: what to wait for; starts at once when missing.
            within_s: longest time from its arming to its end.
        """
        arming = self.tracing(
            *channels, samples=samples, interval_s=interval_s, pre_trigger=pre_trigger, trigger=trigger
        )
        async with arming as taken:
            return await taken(within_s)

    @contextlib.asynccontextmanager
    async def tracing(
        self,
        *channels: str,
        samples: int = 500,
        interval_s: float | None = None,
        pre_trigger: int = 0,
        trigger: TraceTrigger | None = None,
    ) -> AsyncIterator[Callable[[float], Coroutine[Any, Any, Trace]]]:
        """Record what happens in the context, which begins once the trace is armed; see `take_trace`.

        Yields a function that waits for the end of the trace, with the longest time in seconds, and returns the trace.
        """
        fields = {"channels": channels, "samples": samples, "pre_trigger": pre_trigger, "trigger": trigger}
        every = "fastest" if interval_s is None else interval_s
        request = await self._made(TakeTrace, {**fields, "interval_s": every})
        client, name = self._client, self.name
        await client.meet(f"axis {name}: {request.verb}")
        stamped = self.control.stamped(request, name) if self.control else request
        async with armed_trace(client, name, stamped) as reply:

            async def taken(within_s: float) -> Trace:
                await wait_for_trace(client, name, reply.trace_id, within_s)
                return await fetch_trace(client, name, reply.trace_id)

            yield taken

    async def outcome(self, command_id: str) -> CommandOutcome:
        """Query the daemon for the outcome of a command."""
        return await self._client.outcome(command_id)

    async def halt_now(self) -> bool:
        """Halt, in a bounded time and without raising; tell whether that was confirmed.

        It is sent and waited for to its end whatever cancels the caller meanwhile. Nothing is sent once control was
        lost: another may have it.
        """
        if self.control and self.control.lost:
            return False
        halting = asyncio.create_task(self._halt_in_time(), name=f"halt {self.name}")
        self._halting.add(halting)  # a loop keeps no task alive
        halting.add_done_callback(self._halting.discard)
        return await asyncio.shield(halting)

    async def _halt_in_time(self) -> bool:
        with contextlib.suppress(LdcndError, TimeoutError):
            async with asyncio.timeout(HALT_S):
                await self._brought_to_rest(Halt(client=self._who))
                return True
        return False

    async def under_way(self) -> Motion | None:
        """Return the last motion that was begun here if it has not ended; None also where that cannot be known."""
        last = self._last
        if last is None or last.over or (self.control and self.control.lost):
            return None
        with contextlib.suppress(LdcndError):
            status = (await self.outcome(last.command_id)).status
            last.over = status in ENDED
            return None if status in FINAL else last
        return None

    async def halt_unfinished(self) -> bool:
        """Halt at once if a motion that was sent from here may not have ended; tell whether none goes on for certain.

        One that has no answer counts as under way. Nothing is asked before: meanwhile the axis would travel on.
        """
        if self._halting:  # what is on its way already is not given twice
            await asyncio.shield(asyncio.gather(*self._halting, return_exceptions=True))
        last = self._last
        # a halt that was confirmed is not given again: the axis comes to rest already
        if not self.unanswered and (last is None or last.over or last.reply.verb == Verb.HALT):
            return True
        if not self.unanswered and last and self.control and self.control.inherited:
            # what moves may be of who shares its lease
            with contextlib.suppress(LdcndError, TimeoutError):
                async with asyncio.timeout(HALT_S):
                    if (await self.outcome(last.command_id)).status in ENDED:
                        return True
        return await self.halt_now()

    async def begin(self, command: type[AxisCommand[CommandReply]], **fields: object) -> Motion:
        """Begin what a command says; of its fields the methods of the verbs have none that is about permission."""
        return await self._start(command, **fields)

    def begun(self, reply: CommandReply, asked: float | None = None) -> Motion:
        """Return the motion that a command has begun; `asked` is the requested target, in axis units."""
        self._last, self.comes_to_rest = Motion(reply, self), False
        turns = self._position is not None and self.position.sample.turns is not None
        self._sent = Sent(reply, self._client.run, None if turns else asked)
        return self._last

    async def _send(self, command: type[AxisCommand[AxisReplyT]], **fields: object) -> AxisReplyT:
        request = await self._made(command, fields)
        return await (self._brought_to_rest(request) if request.takes_energy_out else self._sent_as(request))

    async def _brought_to_rest(self, request: AxisCommand[AxisReplyT]) -> AxisReplyT:
        """Send what brings the axis to rest; its answer is the end of all that was sent before it."""
        over = self._so_far()
        self.comes_to_rest = not isinstance(request, Power)  # a shaft may turn on for long without power
        reply = await self._sent_as(request)
        over()
        return reply

    def _so_far(self) -> Callable[[], None]:
        """Return what notes that the motions have ended that were sent until now."""
        last, unanswered = self._last, frozenset(self.unanswered)

        def over() -> None:
            self.unanswered -= unanswered
            if last:
                last.over = True

        return over

    async def _sent_as(self, command: AxisCommand[AxisReplyT]) -> AxisReplyT:
        if self.control:
            return await self.control.command(self.name, command)
        return await self._client.command(self.name, command)

    async def _start(self, command: type[AxisCommand[CommandReply]], **fields: object) -> Motion:
        request = await self._made(command, fields)
        if request.takes_energy_out:
            # where the axis was sent stays what it was: a halt of one that stands changes nothing
            self._last = Motion(await self._brought_to_rest(request), self)
            return self._last
        await self._client.meet(f"axis {self.name}: {request.verb}")  # what is interrupted here was not sent
        async with on_the_way(self):
            reply = await self._sent_as(request)
        return self.begun(reply, getattr(request, "position", None))

    async def _ask(self, command: type[Command[ReplyT]], /, **fields: object) -> ReplyT:
        request = await self._made(command, fields)
        if self.control and "lease" in command.model_fields:
            request = request.model_copy(update={"lease": self.control.lease.lease})
        return await self._client.ask(request, self.name)

    async def _made(self, command: type[CommandT], fields: Mapping[str, object]) -> CommandT:
        return await made(self._client, self.name, command, fields)

    # -- life --------------------------------------------------------------------------------------------------------

    @contextlib.asynccontextmanager
    async def watched(self) -> AsyncIterator["Axis"]:
        """Take states and positions for the time of the context; the last ones are there when it begins."""
        async with (
            self._client.values(self.name, TelemetryItem.STATE, self._take_state),
            self._client.values(self.name, TelemetryItem.POSITION, self._take_position, LINGER_S),
            health_reports(self._client, self._take_report),
        ):
            for report in await last_bus_health(self._client):
                self._take_report(report)
            now_s = self._loop.time()
            state, position = await self._client.state(self.name), await self._client.position(self.name)
            if state and self._state is None:
                self._state = state, now_s
            if position and self._position is None:
                self._position = position, now_s
            try:
                yield self
            finally:
                await self._end_halts()

    async def _end_halts(self) -> None:
        """Wait for halts whose callers were cancelled once more; none is sent again once control was lost."""
        halts = tuple(self._halting)
        if self.control and self.control.lost:
            for each in halts:
                each.cancel()
        await asyncio.gather(*halts, return_exceptions=True)

    def lost(self) -> None:
        """Wake up those who wait: control was lost."""
        self._changed.set()

    def _take_state(self, sample: Publication) -> None:
        if sample.kind is SampleKind.PUT:
            self._state = decode_received(StateSample, sample.payload, sample.encoding), self._loop.time()
            self._changed.set()

    def _take_position(self, sample: Publication) -> None:
        if sample.kind is SampleKind.PUT:
            self._position = sample, self._loop.time()
            for reader in self._readers:
                reader.take(sample)
            self._changed.set()

    def _take_report(self, report: DaemonHealth | BusHealth) -> None:
        for each in report.axes if isinstance(report, BusHealth) else ():
            if each.axis == self.name:
                self._rate_hz = each.rate_wanted_hz

    @property
    def _who(self) -> str | None:
        return self.control.lease.client if self.control else None

    def _refuse_lost(self) -> None:
        if self.control and self.control.lost:
            raise LeaseExpired(
                f"axis {self.name}: control was lost: {self.control.lost.message}",
                axis=self.name,
                remedy="take control again",
            )

    def _silent(self) -> SessionError:
        return SessionError(f"axis {self.name}: nothing was received from it yet", axis=self.name)

    def _repr_html_(self) -> str:
        """Return what is known of it as a table, for notebooks."""
        if self._state is None or self._position is None:
            return table(f"axis {self.name}", [("no sample received yet",)])
        state, position = self.state, self.position
        rows = [
            ("position", position),
            ("state", state),
            ("enabled", "yes" if state.enabled else "no"),
            ("homed", "yes" if state.referenced else "no"),
            ("control", assess(state.sample).control or "unknown"),
        ]
        return table(f"axis {self.name}", rows)

    def __repr__(self) -> str:
        if self._state is None or self._position is None:
            return f"<axis {self.name}: no sample received yet>"
        return f"<axis {self.name}: {self.position}, {self.state}>"


@contextlib.asynccontextmanager
async def on_the_way(*axes: Axis) -> AsyncIterator[None]:
    """Count the motion as under way that is sent in the context, and halt its axes unless its answer comes.

    A refusal is an answer: nothing of the motion was carried out. Whatever else ends the wait for it, such as Ctrl-C,
    a time-out or a lost answer, tells nothing of the axes: they may move.
    """
    motion = object()
    for axis in axes:
        axis.unanswered.add(motion)
    try:
        yield
    except RequestRefused:
        _answered(axes, motion)
        raise
    except (Exception, asyncio.CancelledError):
        # where no halt is confirmed it stays unanswered: the end of control sends another one
        await asyncio.shield(asyncio.gather(*(axis.halt_now() for axis in axes)))
        raise
    _answered(axes, motion)


def _answered(axes: tuple[Axis, ...], motion: object) -> None:
    for axis in axes:
        axis.unanswered.discard(motion)


async def come_to_rest(axis: Axis) -> None:
    """Wait, in a bounded time and without raising, until an axis stands if it was halted or stopped from here."""
    if axis.comes_to_rest and not (axis.control and axis.control.lost):
        with contextlib.suppress(LdcndError):
            await at_rest(axis)


async def made(client: RigClient, axis: str, command: type[CommandT], fields: Mapping[str, object]) -> CommandT:
    """Return a command to an axis; texts among its numbers are read in the units that the axis has now."""
    texts = {name: value for name, value in fields.items() if name in DIMENSIONS and isinstance(value, str)}
    if texts:
        infos = [info for info in await client.axes() if info.axis == axis]
        if not infos:
            raise UnknownAxis(f"there is no axis {axis} any more", axis=axis)
        (info,) = infos
        try:
            fields = {**fields} | {name: read_quantity(text, info, DIMENSIONS[name]) for name, text in texts.items()}
        except NotANumber as error:
            raise MalformedRequest(f"axis {axis}: {error}", axis=axis) from None
    return valid(command, **fields)


CHECK_PERIOD_S = 0.05


async def seen(axis: Axis) -> Axis:
    """Wait for the first state and position of an axis; return it.

    Raises:
        SessionError: nothing is received from it.
    """
    deadline_s = asyncio.get_running_loop().time() + REST_S
    while True:
        try:
            _ = axis.state, axis.position
        except SessionError:
            if asyncio.get_running_loop().time() > deadline_s:
                raise
            await axis.news(CHECK_PERIOD_S)
        else:
            return axis


async def at_rest(axis: Axis, within_s: float | None = REST_S, *, watched: bool = False) -> StateSample:
    """Wait until an axis stands, and return its state then; see `until_at_rest`.

    Raises:
        LeaseExpired: control was lost.
        OutcomeUnknown: the drive does not answer, nothing comes from it any more, or its readings prove no rest.
        WrongState: it does not come to rest in time.
    """
    return await until_at_rest(axis.name, lambda: axis.state.sample, lambda: axis.news(None), within_s, watched=watched)
