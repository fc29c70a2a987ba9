"""Open pages and the axes that they control: control lasts as long as the web socket of the page that took it.

Browsers slow the timers of hidden pages and run nothing in pages that are gone. So this process renews the leases, and
it is here that the end of a page is noticed: whatever ended it, what it may have set in motion is halted before its
control is given up.
"""

import asyncio
import math
import secrets
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial

from pydantic import Field

from ldcnd.client.lease import Control, RequestT, acquire
from ldcnd.client.motion import Jogging
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.client.sequences import SequenceRun
from ldcnd.console.rigs import Rigs
from ldcnd.console.sequences import PageRun, RunProgress, RunRequest, Runs, read_catalogue
from ldcnd.console.visitors import Visitor
from ldcnd.contract.codec import error_reply
from ldcnd.contract.commands import AxisCommand, BufferMode, CommandReply, Effect, ErrorReply, Halt, Jog
from ldcnd.contract.errors import (
    CommandExpired,
    LdcndError,
    LeaseExpired,
    LeaseRequired,
    NotSupported,
    RequestRefused,
    TooManyRequests,
    UnknownAxis,
    WrongState,
)
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.leases import ListHolders
from ldcnd.contract.rig_commands import MoveTogether, MoveTogetherReply
from ldcnd.contract.samples import StopCount
from ldcnd.log import get_logger

log = get_logger("console")

LEASE_S = 3.0
"""The daemon acts so soon when this process dies."""
HALT_TIME_S = 3.0
REST_TIME_S = 15.0
"""Time for an axis that a page leaves behind to come to rest; then its lease ends by itself, and `loss.client` of
its configuration decides."""
LOOK_EACH_S = 0.05
HELD_S = 0.4
"""A jog ends after this time without a message that its button is held, in the daemon without one of this process;
pages send one each tenth of a second."""
PULSE_S = 0.25
STOOD_S = 1.0
"""Delay of a pulse from which this process counts as having stood still, seconds."""
STOOD_LATELY_S = 15.0
"""Time for which that is named as the cause of lost control, seconds: renewals wait for their answers."""
MOST_PAGES = 64
TOKEN_BYTES = 16


class Lost(Frozen):
    """Control that a page had."""

    rig: str
    """The rig."""
    axis: str
    """The axis."""
    message: str
    """Why it has no control any more."""
    taken_by: str | None = None
    """The client that controls the axis instead; missing where none does."""


class PageJog(Frozen):
    """Run an axis for as long as the page goes on saying that it is held."""

    rig: str
    """The rig."""
    axis: str
    """The axis."""
    velocity: float
    """Units a second, signed."""
    acceleration: float | None = Field(default=None, gt=0)
    """Units a second squared; the axis default when missing."""
    instance: str | None = None
    """The run of the daemon that it is meant for: another one may have other units."""
    after_stops: StopCount | None = None
    """As of commands: the `stops` of the axis's state that the page has shown."""


class FromPage(Frozen):
    """One message of a page on its web socket."""

    jog: PageJog | None = None
    """Begin to jog; an earlier jog of the page ends."""
    held: bool | None = None
    """The jog goes on, for `HELD_S` more; false ends it."""


class ToPage(Frozen):
    """One message to a page on its web socket; the first has `page` and `client`, the others one of the rest."""

    page: str | None = None
    """The value of `X-Ldcnd-Page` on its commands."""
    client: str | None = None
    """The name under which its commands go."""
    lost: Lost | None = None
    """Control that it does not have any more."""
    refused: ErrorReply | None = None
    """Why a jog did not begin, or what went wrong in it."""
    jog_over: bool | None = None
    """The jog has ended, not by the page: by a halt, a stop or a limit; the events of the axis say by what."""


@dataclass(slots=True, eq=False)
class _Hold:
    """Control of one axis.

    Attributes:
        control: the lease.
        keeping: renews it.
        moved: a motion was commanded under it.
        sending: how many commands have no answer yet.
        let_go: the counts of stops that only the halts at the ends of this page's own jogs have followed.
    """

    client: RigClient
    axis: str
    control: Control
    keeping: asyncio.Task[None]
    moved: bool = False
    sending: int = 0
    let_go: range = range(0)

    def behind_jogs(self, stops: int | None) -> int | None:
        """Return a count of stops such that no end of a jog of the page, which it may not show yet, comes behind it."""
        return self.let_go.stop if stops in self.let_go else stops

    def sent_behind_jogs(self, command: RequestT) -> RequestT:
        """Return a command such that no end of a jog of the page refuses it."""
        return command.model_copy(update={"after_stops": self.behind_jogs(command.after_stops)})

    @contextmanager
    def in_flight(self, *, moves: bool) -> Iterator[None]:
        """Count a command until it is answered."""
        self.moved |= moves
        self.sending += 1
        try:
            yield
        finally:
            self.sending -= 1


class _Pulse:
    """Notices when this process stands still: its leases end then, however well the daemon is."""

    def __init__(self) -> None:
        self._stood_s = 0.0
        self._went_on_s = -STOOD_LATELY_S

    async def beat(self) -> None:
        """Beat until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            before_s = loop.time()
            await asyncio.sleep(PULSE_S)
            if (late_s := loop.time() - before_s - PULSE_S) > STOOD_S:
                self._stood_s, self._went_on_s = late_s, loop.time()

    @property
    def stood(self) -> str:
        """Why control is lost that was not renewed lately; empty unless this process stood still."""
        if asyncio.get_running_loop().time() > self._went_on_s + STOOD_LATELY_S:
            return ""
        ends = f"control ends {LEASE_S:g} s after it was renewed"
        return f"the console process stood still for {self._stood_s:.0f} s, and {ends}"


class PageControl:
    """The axes that one open page controls; made by `Pages.open`.

    Attributes:
        token: what its commands carry; known to the page alone.
        client: the name under which it holds control.
    """

    def __init__(
        self, client: str, rigs: Rigs, runs: Runs, tell: Callable[[ToPage], None], group: asyncio.TaskGroup
    ) -> None:
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        self.client = client
        self._rigs = rigs
        self._tell = tell
        self._group = group
        self._held: dict[tuple[str, str], _Hold] = {}
        self._runs = runs
        self._lent: dict[tuple[str, str], PageRun] = {}
        self._gone = False
        self._jogging: asyncio.Task[None] | None = None
        self._halting: defaultdict[tuple[str, str], asyncio.Lock] = defaultdict(asyncio.Lock)
        self._held_at_s = -math.inf
        self._held_on = asyncio.Event()
        self._pulse = _Pulse()
        self._beating = group.create_task(self._pulse.beat(), name=f"pulse of {client}")

    def heard(self, message: FromPage) -> None:
        """Take a message of the page."""
        if message.jog is not None or message.held is False:
            self._end_jog()
        if message.jog is not None or message.held:
            self._held_at_s = asyncio.get_running_loop().time()
        if message.jog is not None:
            self._jogging = self._group.create_task(self._jog(message.jog), name=f"{self.client} jogs")
        elif message.held:
            self._held_on.set()

    async def take(self, rig: str, axis: str, *, force: bool) -> None:
        """Take control of an axis, from its holder too with `force`.

        Raises:
            UnknownAxis: the rig has no such axis.
            LeaseHeld: another page or program controls it.
            LeaseExpired: the page has gone meanwhile.
            WrongState: it has lent it to a sequence, which would end for want of it.
        """
        client = self._rigs.client(rig)
        self._refuse_lent(rig, axis)
        if axis not in self._rigs.axes(rig):
            raise UnknownAxis(f"rig {rig} has no axis {axis[:64]!r}", axis=axis[:64], value=axis[:64])
        control = await acquire(client, self.client, (axis,), LEASE_S, force=force)
        if self._gone:
            await control.release()
            raise _page_gone()
        if before := self._held.get((rig, axis)):
            before.keeping.cancel()  # the daemon has put the new lease in its place
        keeping = self._group.create_task(self._keep(rig, axis, control), name=f"lease of {self.client} on {axis}")
        self._held[rig, axis] = _Hold(client, axis, control, keeping)
        self._rigs.control_changed(rig, axis)

    async def release(self, rig: str, axis: str) -> None:
        """Give up control of an axis; one that may move is halted before."""
        if run := self._lent.get((rig, axis)):
            await run.stop()  # which gives the axis back
        if hold := self._held.pop((rig, axis), None):
            await _give_up(hold, self.client)
            self._rigs.control_changed(rig, axis)

    async def command(self, rig: str, axis: str, command: AxisCommand[CommandReply]) -> CommandReply:
        """Send one command, under the page's lease where it has one.

        Raises:
            LeaseRequired: it would move an axis that this page does not control.
            LdcndError: as the daemon refused it.
        """
        hold = self._held.get((rig, axis))
        if hold is None:
            if command.effect is Effect.MOTION:
                self._refuse_lent(rig, axis)
            refuse_unwatched(axis, command)
            return await self._rigs.client(rig).command(axis, command)
        with hold.in_flight(moves=command.effect is Effect.MOTION):
            return await hold.control.command(axis, hold.sent_behind_jogs(command))

    async def move_together(self, rig: str, request: MoveTogether) -> MoveTogetherReply:
        """Start the moves of a group under the page's leases.

        Raises:
            LeaseRequired: this page does not control one of the axes.
            LdcndError: as the daemon refused it.
        """
        with ExitStack() as sending:
            moves = []
            for move in request.moves:
                hold = self._held.get((rig, move.axis))
                if hold is None:
                    self._refuse_lent(rig, move.axis)
                    raise control_needed(move.axis)
                sending.enter_context(hold.in_flight(moves=True))
                moves.append(hold.control.stamped(hold.sent_behind_jogs(move), move.axis))
            together = request.model_copy(update={"moves": tuple(moves)})
            return await self._rigs.client(rig).ask(together)

    async def run(self, rig: str, wanted: RunRequest) -> RunProgress:
        """Begin a sequence, or the way to a position; it ends with this page, and without control of its axes.

        The run takes control itself, under the name of this page, in place of the page's own, and the page takes it
        again at its end. So the lease of a run ends with it, and the daemon refuses whatever of it is still on the way
        when it is stopped; and the page cannot move by hand what a sequence relies on.

        Raises:
            LeaseRequired: this page does not control one of the axes.
            WrongState: another one runs on the rig, or it is not any more what the page shows.
            LdcndError: the daemon does not answer.
        """
        client, stopped = self._rigs.client(rig), self._runs.stopped[rig]
        catalogue = await read_catalogue(client, await client.axes())
        config, found = catalogue.find(wanted)
        there = Rig(client, await client.daemon())
        # nothing is awaited from here on: a second press finds the first
        self._runs.refuse_second(rig)
        if self._runs.stopped[rig] != stopped:
            raise CommandExpired(
                f"{wanted.kind} {wanted.name} has not begun: what runs on rig {rig} was stopped since it was asked for"
            )
        if self._gone:
            raise _page_gone()
        if untaken := [axis for axis in found.axes if (rig, axis) not in self._held]:
            raise control_needed(untaken[0])
        first = RunProgress(kind=found.kind, name=found.name, client=self.client, axes=found.axes, of=len(found.steps))
        run = self._runs.new(rig, first)
        sequence = SequenceRun(
            there,
            config,
            catalogue.positions,
            run.report,
            self._runs.now_ns,
            self.client,
            self.behind_jogs(rig, wanted.after_stops),
        )
        carried = self._carry_out(rig, run, sequence)
        run.begin(sequence, self._group.create_task(carried, name=f"{run.title} of {self.client}"))
        return run.progress

    def behind_jogs(self, rig: str, stops: Mapping[str, int]) -> dict[str, int]:
        """Return counts of stops by axis such that no end of a jog of this page comes behind them."""
        held = {axis: self._held.get((rig, axis)) for axis in stops}
        return {axis: (hold and hold.behind_jogs(stops[axis])) or stops[axis] for axis, hold in held.items()}

    def pause(self, rig: str, *, on: bool) -> RunProgress:
        """Have the next step of this page's run wait, or go on.

        Raises:
            WrongState: no run of this page goes on there.
        """
        run = self._runs.going(rig)
        if run is None or run.progress.client != self.client:
            raise WrongState(f"this page runs no sequence on rig {rig}", remedy="look at the page that has begun it")
        run.pause(on=on)
        return run.progress

    async def _carry_out(self, rig: str, run: PageRun, sequence: SequenceRun) -> None:
        error: LdcndError | None = None
        ended = False
        try:
            for axis in run.progress.axes:
                self._lend(rig, axis, run)
            await sequence.run()
            ended = True
        except LdcndError as failed:
            error = failed
        except BaseExceptionGroup as failures:
            first = failures.exceptions[0]
            if not isinstance(first, LdcndError):
                raise
            error = first
        finally:
            run.ending()
            # what another client has taken moves for that one
            halts = not ended and not isinstance(error, LeaseExpired)
            async with asyncio.TaskGroup() as group:
                for axis in run.progress.axes:
                    group.create_task(self._take_back(rig, axis, halts=halts), name=f"{self.client} has {axis} again")
            run.over(error, stopped=not ended and error is None)

    def _lend(self, rig: str, axis: str, run: PageRun) -> None:
        hold = self._held.pop((rig, axis), None)
        if hold is None:  # lost since the press
            raise control_needed(axis)
        hold.keeping.cancel()
        self._lent[rig, axis] = run
        self._rigs.control_changed(rig, axis)

    async def _take_back(self, rig: str, axis: str, *, halts: bool) -> None:
        """Take control of an axis again after a run, unless the page has gone or another client was faster."""
        if self._lent.pop((rig, axis), None) is None:
            return
        if halts:  # a command that had no answer yet may have begun a motion that the run knows nothing of
            with suppress(LdcndError):
                await self._rigs.client(rig).command(axis, Halt(client=self.client), HALT_TIME_S)
        if self._gone:
            return
        try:
            await self.take(rig, axis, force=False)
        except LdcndError as error:
            self._rigs.control_changed(rig, axis)
            taker = await self._holder(rig, axis)
            log.info("control lost", client=self.client, rig=rig, axis=axis, reason=error.message)
            self._tell(ToPage(lost=Lost(rig=rig, axis=axis, message=error.message, taken_by=taker)))

    def _refuse_lent(self, rig: str, axis: str) -> None:
        if run := self._lent.get((rig, axis)):
            raise WrongState(f"axis {axis}: {run.title} moves it", axis=axis, remedy="stop that, or wait for its end")

    def lease(self, rig: str, axis: str) -> str | None:
        """Return the lease of an axis, for questions."""
        hold = self._held.get((rig, axis))
        return hold.control.lease.lease if hold else None

    def leases(self, rig: str) -> tuple[str, ...]:
        """Return all leases on axes of a rig, for what concerns a whole line."""
        return tuple(hold.control.lease.lease for (name, _), hold in self._held.items() if name == rig)

    async def leave(self) -> None:
        """Give up everything: halt what may move, then release it. Nothing more is sent for this page."""
        self._gone = True
        self._beating.cancel()
        self._end_jog()
        holds, self._held = list(self._held.values()), {}
        async with asyncio.TaskGroup() as group:
            for run in set(self._lent.values()):
                group.create_task(run.stop(), name=f"{self.client} leaves {run.title}")
            for hold in holds:
                group.create_task(_give_up(hold, self.client), name=f"{self.client} leaves {hold.axis}")

    def _end_jog(self) -> None:
        if self._jogging:
            self._jogging.cancel()
            self._jogging = None

    async def _jog(self, wanted: PageJog) -> None:
        """Run an axis until its page lets go of it or falls silent, then halt it; if this process dies the jog ends."""
        async with self._halting[wanted.rig, wanted.axis]:  # the one before is halted by then
            if (
                asyncio.get_running_loop().time() - self._held_at_s > HELD_S
            ):  # which can take longer than a hand holds on
                self._tell(ToPage(jog_over=True))
                return
            request = Jog(
                velocity=wanted.velocity,
                acceleration=wanted.acceleration,
                client=self.client,
                instance=wanted.instance,
                after_stops=wanted.after_stops,
                hold_s=HELD_S,
                buffer_mode=BufferMode.ABORTING,
            )
            jog = Jogging(partial(self.command, wanted.rig, wanted.axis), request)
            try:
                await jog.begin()
            except RequestRefused as error:
                self._tell(ToPage(refused=error_reply(error)))
                return
            except (LdcndError, asyncio.CancelledError) as error:
                await self._end_of_jog(wanted, error)
                return
            try:
                while True:
                    self._held_on.clear()
                    async with asyncio.timeout(HELD_S):
                        await self._held_on.wait()
                    await jog.renew()
            except (TimeoutError, LdcndError, asyncio.CancelledError) as error:
                await self._end_of_jog(wanted, error)

    async def _end_of_jog(self, wanted: PageJog, error: BaseException) -> None:
        """Halt the axis, and say so if the page has not let go of it; what went wrong if it was no ordinary end."""
        await self._halt_jog(wanted)
        if isinstance(error, LeaseExpired):  # the daemon has ended it before
            self._tell(ToPage(jog_over=True))
        elif isinstance(error, LdcndError):
            self._tell(ToPage(refused=error_reply(error)))
        if isinstance(error, asyncio.CancelledError):
            raise error

    async def _halt_jog(self, jog: PageJog) -> None:
        try:
            reply = await self._rigs.client(jog.rig).command(jog.axis, Halt(client=self.client), HALT_TIME_S)
        except LdcndError as error:
            self._tell(ToPage(refused=error_reply(error)))
        else:
            hold = self._held.get((jog.rig, jog.axis))
            if hold and (stops := reply.stops):
                hold.let_go = range(hold.let_go.start if hold.let_go.stop == stops - 1 else stops - 1, stops)

    async def _keep(self, rig: str, axis: str, control: Control) -> None:
        await control.keep()
        hold = self._held.get((rig, axis))
        if hold and hold.control is control:
            del self._held[rig, axis]
            self._rigs.control_changed(rig, axis)
            taker = await self._holder(rig, axis)
            # nothing is heard of a daemon, however well it is, by a process that stands still, nor at once afterwards
            why = self._pulse.stood or (control.lost.message if control.lost else "")
            log.info("control lost", client=self.client, rig=rig, axis=axis, reason=why)
            if (rig, axis) in self._held:  # taken again meanwhile
                taker = None
            self._tell(ToPage(lost=Lost(rig=rig, axis=axis, message=why, taken_by=taker)))

    async def _holder(self, rig: str, axis: str) -> str | None:
        """Return who controls an axis that this page has lost; None where none does, or the daemon does not answer."""
        try:
            reply = await self._rigs.client(rig).ask(ListHolders())
        except LdcndError:
            return None
        return next((each.client for each in reply.holders if each.axis == axis), None)


class Pages:
    """All open pages, by what their commands carry."""

    def __init__(self, rigs: Rigs, runs: Runs) -> None:
        self._rigs = rigs
        self._runs = runs
        self._open: dict[str, tuple[Visitor, PageControl]] = {}
        self._count = 0
        rigs.lease_of = self.lease

    def lease(self, rig: str, axis: str) -> str | None:
        """Return the lease under which one of the pages controls an axis."""
        return next((lease for _, page in self._open.values() if (lease := page.lease(rig, axis))), None)

    @asynccontextmanager
    async def open(self, visitor: Visitor, tell: Callable[[ToPage], None]) -> AsyncIterator[PageControl]:
        """Let a page control axes for as long as the context lasts.

        Raises:
            TooManyRequests: there are too many pages.
        """
        if len(self._open) >= MOST_PAGES:
            raise TooManyRequests(f"{MOST_PAGES} pages are open", limit=MOST_PAGES, remedy="close some of them")
        self._count += 1
        async with asyncio.TaskGroup() as group:
            page = PageControl(f"{visitor.client}.{self._count}", self._rigs, self._runs, tell, group)
            self._open[page.token] = (visitor, page)
            try:
                yield page
            finally:
                del self._open[page.token]
                await page.leave()

    def of(self, token: str, visitor: Visitor) -> PageControl:
        """Return the visitor's page that sends a command.

        Raises:
            LeaseExpired: its web socket has closed.
        """
        owner, page = self._open.get(token, (None, None))
        if page is None or owner is not visitor:
            raise _page_gone()
        return page


def refuse_unwatched(axis: str, command: AxisCommand[CommandReply]) -> None:
    """Refuse a motion that no open page is responsible for.

    Raises:
        LeaseRequired: it is one.
    """
    if command.effect is Effect.MOTION:
        raise control_needed(axis)


def control_needed(axis: str) -> LeaseRequired:
    """Return the refusal of a motion that no open page is responsible for."""
    return LeaseRequired(
        f"axis {axis[:64]}: through the console it moves only while a page controls it",
        axis=axis[:64],
        remedy="take control of it first",
    )


def _page_gone() -> LeaseExpired:
    return LeaseExpired("this page has lost its connection to the console", remedy="load the page again")


async def _give_up(hold: _Hold, client: str) -> None:
    """Halt an axis that may move, and release it when it is at rest.

    One that does not come to rest is not released: its lease ends unrenewed, and the daemon does what it is configured
    to do then.
    """
    try:
        async with asyncio.timeout(REST_TIME_S):
            await _bring_to_rest(hold, client)
    except (TimeoutError, LdcndError) as error:
        log.warning("axis not at rest, its lease is left to end", client=client, axis=hold.axis, reason=str(error))
        hold.keeping.cancel()
        return
    hold.keeping.cancel()
    await hold.control.release()


async def _bring_to_rest(hold: _Hold, client: str) -> None:
    """Halt, and once more whenever a command was answered meanwhile: a move may have waited for the end of this one."""
    while True:
        in_flight = hold.sending
        if not hold.moved and await _at_rest(hold):
            return
        try:
            await hold.client.command(hold.axis, Halt(client=client), HALT_TIME_S)
        except NotSupported:
            return  # no command of ours moves it
        at_rest = False
        while hold.sending == in_flight and not (at_rest and not in_flight):
            await asyncio.sleep(LOOK_EACH_S)
            at_rest = await _at_rest(hold)
        if at_rest and not hold.sending:
            return


async def _at_rest(hold: _Hold) -> bool:
    state = await hold.client.state(hold.axis)
    return state is not None and state.has_ended
