"""The Python client: from an endpoint to a rig, and from a rig to axes that a program controls."""

import asyncio
import contextlib
import os
import warnings
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from pathlib import Path
from types import TracebackType
from typing import Generic, Literal, TypeVar, overload

from ldcnd.client.axis import Axis, come_to_rest, made, on_the_way
from ldcnd.client.events import follow_events
from ldcnd.client.lease import Control, inherited_lease, take_control, told_once
from ldcnd.client.motion import Motion
from ldcnd.client.rig_client import RigClient, check_axes, find_rig
from ldcnd.contract.codec import valid
from ldcnd.contract.commands import StopReply
from ldcnd.contract.errors import LdcndError, LeaseRequired, OutcomeUnknown, SessionError, UnknownAxis
from ldcnd.contract.events import CommandEvent, CommandOutcome
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.leases import GuestSentAway, HolderList, ListHolders, SendGuestAway
from ldcnd.contract.meta import AxisInfo, BusInfo, DaemonInfo
from ldcnd.contract.rig_commands import (
    AxisMove,
    AxisPath,
    IoReply,
    IoTimer,
    LinePath,
    MoveTogether,
    OverrideInterlock,
    OverrideReply,
    PreviewTogether,
    PreviewTogetherReply,
    Reload,
    ReloadReply,
    SetIo,
    SetIoTimer,
    SetSpeedOverride,
    Snapshot,
    SnapshotReply,
    SpeedOverrideReply,
    WalkPath,
)
from ldcnd.contract.samples import FaultSample, Sample, StateSample
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import user_settings

ENDPOINT_VARIABLE = "LDCND_CONNECT"
DESCRIBE_PERIOD_S = 1.0
"""Period of queries for what the axes are, for programs that outlive a daemon or its configuration, seconds."""
RETRY_S = 0.2
"""Pause before the next try to reach a daemon that is awaited, seconds."""
ENDED_S = 0.5
"""Longest wait for the end of a motion whose axis is not controlled any more, seconds."""
ItemT_co = TypeVar("ItemT_co", covariant=True)


class Stream(Generic[ItemT_co]):
    """What arrives from now on: to be iterated over, or to be entered, which yields an iterator until it is left.

    Nothing is received before either begins, and nothing after it ends.

    Args:
        opened: receives while it is entered.
    """

    def __init__(self, opened: AbstractAsyncContextManager[AsyncIterator[ItemT_co]]) -> None:
        self._opened = opened

    async def __aenter__(self) -> AsyncIterator[ItemT_co]:
        return await self._opened.__aenter__()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        return await self._opened.__aexit__(kind, error, trace)

    async def __aiter__(self) -> AsyncIterator[ItemT_co]:
        """Yield each item for as long as the loop goes on."""
        async with self as items:
            async for item in items:
                yield item


@asynccontextmanager
async def connect(
    endpoint: str | None = None, *, rig: str | None = None, config: Path | str | None = None, wait_s: float = 0.0
) -> AsyncIterator["Rig"]:
    """Use one rig for as long as the context lasts.

    A lost connection is opened again by itself; values arrive again, and a lease that has ended meanwhile is reported
    by `LeaseExpired`.

    Args:
        endpoint: of the daemon or a router, such as `tcp/127.0.0.1:7447` or `127.0.0.1:7447`; $LDCND_CONNECT, then
            `tcp/127.0.0.1:7447`, when missing.
        rig: which one; needed only when several can be reached.
        config: a Zenoh configuration file with a login, as `ldcnd pki` makes it; its endpoint counts without one.
        wait_s: longest wait for a daemon that may be starting, and then for its lines to come up, seconds.

    Raises:
        SessionError: no connection, or no daemon answers.
        UnknownAxis: several rigs can be reached and none was named.
    """
    given = endpoint or os.environ.get(ENDPOINT_VARIABLE)
    settings = user_settings((given,) if given else (), (), config)
    loop = asyncio.get_running_loop()
    until_s = loop.time() + wait_s
    async with AsyncExitStack() as joined:
        while True:
            try:
                session = await joined.enter_async_context(open_zenoh_session(settings))
                found = await find_rig(session, rig, settings.connect)
                break
            except SessionError:
                await joined.aclose()
                if loop.time() >= until_s:
                    raise
                await asyncio.sleep(RETRY_S)
        client = RigClient(session, found.rig, inherited_lease())
        while loop.time() < until_s and not all(bus.up for bus in await client.buses()):  # noqa: ASYNC110 - happens in the daemon
            await asyncio.sleep(RETRY_S)
        yield Rig(client, found)


class UnfinishedMotion(RuntimeWarning):
    """A program has left its control over an axis while a motion of its own was under way."""


class Rig:
    """A rig that a program uses; made by `connect`.

    Attributes:
        name: of the rig.
        axes: the names of its axes, as they were described last.
    """

    def __init__(self, client: RigClient, daemon: DaemonInfo) -> None:
        self.name = daemon.rig
        self.axes = daemon.axes
        self._client = client
        self._held: dict[str, Axis] = {}

    # -- axes --------------------------------------------------------------------------------------------------------

    @overload
    def control(
        self, axis: str, /, *, client: str, lease_s: float = 1.0, force: bool = False
    ) -> AbstractAsyncContextManager[Axis]: ...

    @overload
    def control(
        self, first: str, second: str, /, *more: str, client: str, lease_s: float = 1.0, force: bool = False
    ) -> AbstractAsyncContextManager[tuple[Axis, ...]]: ...

    def control(
        self, *axes: str, client: str, lease_s: float = 1.0, force: bool = False
    ) -> AbstractAsyncContextManager[Axis] | AbstractAsyncContextManager[tuple[Axis, ...]]:
        """Control axes until the context ends: no other client moves them, and they halt when this program disappears.

        Yields the axis, or a tuple when several are named. When control is lost, calls and motions of the axis raise
        `LeaseExpired`; whatever else the program waits for inside is cancelled, as by `asyncio.timeout`, and the
        context raises `LeaseExpired`: clean up in `finally`. An exception that leaves the context halts the axes whose
        motions have not ended. At its other ends these do what their `loss.client` says, and the warning
        `UnfinishedMotion` names them. Inside `ldcnd lease hold -- PROGRAM` the program shares the control that is held
        for it. Control that this `Rig` has already under the same name is replaced; what moves goes on.

        Args:
            axes: what to control; a group stands for its members.
            client: who this is, a name for people.
            lease_s: how soon the daemon acts when this program disappears, 0.2 to 60 s.
            force: take control away from its holder.

        Raises:
            LeaseHeld: another program controls one of the axes, or this one by another `Rig` or before it was started.
            UnknownAxis: there is no such axis.
        """
        held = self.controlled(axes, client, lease_s, force=force)
        return _only(held) if len(axes) == 1 else held

    @overload
    def watch(self, axis: str, /) -> AbstractAsyncContextManager[Axis]: ...

    @overload
    def watch(self, first: str, second: str, /, *more: str) -> AbstractAsyncContextManager[tuple[Axis, ...]]: ...

    def watch(self, *axes: str) -> AbstractAsyncContextManager[Axis] | AbstractAsyncContextManager[tuple[Axis, ...]]:
        """Watch axes until the context ends, without control over them; yields as `control` does.

        Raises:
            UnknownAxis: there is no such axis.
        """
        watched = self.watched(axes)
        return _only(watched) if len(axes) == 1 else watched

    async def stop(self) -> StopReply:
        """Stop every axis at once and latch: nothing moves again before `reset`. Needs no control."""
        return await self._client.stop()

    async def move_together(
        self,
        targets: Mapping[str, float | str],
        *,
        velocity: float | str | None = None,
        acceleration: float | str | None = None,
        path: LinePath = LinePath.INDEPENDENT,
        max_deviation: float | None = None,
    ) -> tuple[Motion, ...]:
        """Start absolute moves of the members of one group in the same servo cycle, or none of them.

        Args:
            targets: by axis, in axis units or a text with a unit; exactly the members of a configured group, all
                controlled here.
            velocity: of each of them, in its units a second; the axis default when missing. On a line the highest.
            acceleration: likewise.
            path: the way between: each for itself, or on a straight line.
            max_deviation: a line that would be left by more, in axis units, is refused.

        Raises:
            LeaseRequired: one of them is not controlled by this program.
        """
        limits = {"velocity": velocity, "acceleration": acceleration}
        moves = []
        for name, position in targets.items():
            self._control_of(name)
            moves.append(await made(self._client, name, AxisMove, {"axis": name, "position": position, **limits}))
        stamped = tuple(self._control_of(move.axis).stamped(move, move.axis) for move in moves)
        request = valid(MoveTogether, moves=stamped, path=path, max_deviation=max_deviation)
        async with on_the_way(*map(self._axis, targets)):
            reply = await self._client.ask(request)
        return tuple(self._axis(each.axis).begun(each) for each in reply.replies)

    async def path(
        self,
        corners: Mapping[str, Sequence[float]],
        *,
        speed: float | None = None,
        velocity: float | None = None,
        acceleration: float | None = None,
        max_deviation: float | None = None,
    ) -> tuple[Motion, ...]:
        """Walk the members of one group along a polyline; for drives with path mode.

        Args:
            corners: by axis, where it is at each corner, in axis units; exactly the members of a configured group, all
                controlled here, equally many for each. The last one is the end, the first one not where they stand.
            speed: along the path, in axis units a second; as fast as the axes allow when missing.
            velocity: the highest of each axis; its default when missing.
            acceleration: likewise.
            max_deviation: a path that would be left by more, in axis units, is refused.

        Raises:
            LeaseRequired: one of them is not controlled by this program.
        """
        moves = []
        for name, places in corners.items():
            *via, end = places
            move = valid(
                AxisPath, axis=name, via=tuple(via), position=end, velocity=velocity, acceleration=acceleration
            )
            moves.append(self._control_of(name).stamped(move, name))
        request = valid(WalkPath, moves=tuple(moves), speed=speed, max_deviation=max_deviation)
        async with on_the_way(*map(self._axis, corners)):
            reply = await self._client.ask(request)
        return tuple(self._axis(each.axis).begun(each) for each in reply.replies)

    def _control_of(self, name: str) -> Control:
        control = self._axis(name).control
        if control is None:
            raise LeaseRequired(f"axis {name} is not controlled here", axis=name, remedy="use Rig.control")
        return control

    def _leases(self) -> tuple[str, ...]:
        """Return the leases that this program holds here, for what concerns several axes."""
        return tuple({axis.control.lease.lease: None for axis in self._held.values() if axis.control})

    async def set_speed_override(self, percent: float) -> SpeedOverrideReply:
        """Scale every velocity of the rig, 0 to 100 %; at 0 what moves is halted and nothing begins.

        Raises:
            LeaseHeld, LeaseRequired: it would be raised, and another program controls one of the axes.
            OutcomeUnknown: a drive has not confirmed that it was halted.
        """
        reply = await self._client.ask(valid(SetSpeedOverride, percent=percent, leases=self._leases()))
        if reply.shortfall:
            raise OutcomeUnknown(f"speed override {percent:g} %: {reply.shortfall}", remedy="look at the machine")
        return reply

    async def reload(self, *, dry_run: bool = False, revision: str | None = None) -> ReloadReply:
        """Have the daemon read its configuration again; what needs a restart is named and stays as it is.

        So do the settings of an axis that another client controls.

        Args:
            dry_run: only name the changes.
            revision: of an earlier reply; refused when the file has changed since.

        Raises:
            ConfigError: the file makes no configuration; the daemon goes on with the one that it has.
            WrongState: it has another revision.
        """
        return await self._client.ask(valid(Reload, dry_run=dry_run, revision=revision, leases=self._leases()))

    async def preview_together(
        self,
        targets: Mapping[str, float],
        *,
        velocity: float | None = None,
        acceleration: float | None = None,
        path: LinePath = LinePath.LINEAR,
    ) -> PreviewTogetherReply:
        """Preview `move_together`: durations, and how far from a straight line the axes would get."""
        moves = tuple(
            valid(AxisMove, axis=name, position=position, velocity=velocity, acceleration=acceleration)
            for name, position in targets.items()
        )
        return await self._client.ask(valid(PreviewTogether, moves=moves, path=path))

    # -- what it says ------------------------------------------------------------------------------------------------

    @property
    def client(self) -> RigClient:
        """Client that this rig stands on."""
        return self._client

    async def daemon(self) -> DaemonInfo:
        """Return what the daemon says about itself."""
        return await self._client.daemon()

    async def describe(self) -> list[AxisInfo]:
        """Return what every axis is: unit, limits, capabilities, in the order of lines and addresses."""
        described = await self._client.axes()
        names = tuple(info.axis for info in described)
        if described and {*names} != {*self.axes}:
            self.axes = names  # the daemon was restarted with others
        return described

    async def follow_descriptions(self) -> AsyncIterator[Mapping[str, AxisInfo]]:
        """Yield what every axis is by its name: at once, and soon after each reload and restart of the daemon."""
        known: dict[str, AxisInfo] = {}
        while True:
            with contextlib.suppress(LdcndError):
                described = {info.axis: info for info in await self.describe()}
                if described and described != known:
                    known = described
                    yield known
            await asyncio.sleep(DESCRIBE_PERIOD_S)

    async def buses(self) -> list[BusInfo]:
        """Return what every line is and how it does."""
        return await self._client.buses()

    async def faults(self) -> dict[str, FaultSample]:
        """Return what is wrong with every axis."""
        return await self._client.faults()

    async def states(self) -> dict[str, StateSample]:
        """Return the last state of every axis that has one."""
        return await self._client.states()

    async def holders(self) -> HolderList:
        """Return who controls what."""
        return await self._client.ask(ListHolders())

    async def at(self, t: int) -> dict[str, AxisInstant]:
        """Return where every axis was at an instant of the last 600 s, with bounds that hold.

        Args:
            t: UTC in ns since 1970, as in samples; two polls later its answer is known.

        Raises:
            MalformedRequest: it is no instant.
        """
        return await self._client.at(t)

    async def between(self, t: int, until: int) -> dict[str, list[AxisInstant]]:
        """Return where every axis was at both ends of a range and at each reading in it.

        Args:
            t: UTC in ns since 1970, as in samples.
            until: likewise.

        Raises:
            MalformedRequest: it is no range, or one with more than 1000 readings of an axis.
        """
        return await self._client.past(f"[{t}..{until}]")

    async def snapshot(self, bus: str) -> SnapshotReply:
        """Return the positions of all axes of a line at one instant, and how sure that instant is.

        Raises:
            NotSupported: the line is not configured for it.
        """
        return await self._client.ask(valid(Snapshot, bus=bus))

    async def set_io(
        self,
        module: str,
        *,
        high: Iterable[int | str] = (),
        low: Iterable[int | str] = (),
        inputs: Iterable[int | str] = (),
        pwm1: float | None = None,
        pwm2: float | None = None,
        lease: str | None = None,
    ) -> IoReply:
        """Set outputs of an I/O module; what is left out stays as it is.

        Args:
            module: its configured name.
            high: lines, by number or name, that are driven high.
            low: likewise low.
            inputs: lines that are inputs from now on.
            pwm1: share of time for which PWM output 1 is on, 0 to 1.
            pwm2: likewise output 2.
            lease: one besides those under which this program controls axes here; together they must cover the axes of
                the module's line, where a motion of them would need one.
        """
        request = valid(
            SetIo,
            module=module,
            high=tuple(high),
            low=tuple(low),
            inputs=tuple(inputs),
            pwm1=pwm1,
            pwm2=pwm2,
            lease=lease,
            leases=self._leases(),
            after_stops={
                name: axis.control.after_stops[name]
                for name, axis in self._held.items()
                if axis.control and name in axis.control.after_stops
            },
        )
        return await self._client.ask(request)

    async def set_io_timer(
        self, module: str, mode: IoTimer | str, *, prescale: Literal[1, 2, 4, 8] = 1, lease: str | None = None
    ) -> IoReply:
        """Choose what the counter of an I/O module counts: `timer`, `counter` (edges of line 10), or `off`."""
        return await self._client.ask(
            valid(SetIoTimer, module=module, mode=mode, prescale=prescale, lease=lease, leases=self._leases())
        )

    async def override_interlock(self, interlock: str, seconds: float, reason: str) -> OverrideReply:
        """Lift one interlock for service, for at most 600 s and while this program controls what it binds.

        Args:
            interlock: its configured name.
            seconds: how long; 0 takes it back.
            reason: for events and log.

        Raises:
            LeaseRequired: nothing is controlled by this program.
            LeaseHeld: its control does not cover what the interlock binds.
        """
        leases = self._leases()
        if not leases:
            raise LeaseRequired("nothing is controlled here", remedy="use Rig.control")
        return await self._client.ask(
            valid(OverrideInterlock, interlock=interlock, seconds=seconds, reason=reason, lease=leases[0])
        )

    async def send_guest_away(self, port: str) -> GuestSentAway:
        """Close the terminal or the connection of the program at a port, and end its control.

        Raises:
            WrongState: no program uses it.
        """
        return await self._client.ask(
            valid(
                SendGuestAway,
                port=port,
            )
        )

    async def outcome(self, command_id: str) -> CommandOutcome:
        """Return what became of a command."""
        return await self._client.outcome(command_id)

    def events(self, axis: str | None = None, *, history: bool = False) -> Stream[CommandEvent]:
        """Follow what happens to commands, each event once: what the network drops is fetched.

        `async for event in rig.events()`; `async with` yields an iterator, which counts in `lost` what is not there.

        Args:
            axis: only this one.
            history: begin with what the daemon remembers instead of now.
        """
        return Stream(follow_events(self._client, axis, history=history))

    async def latest(self, axis: str, item: str) -> Sample | None:
        """Return the last sample of an item, such as `velocity` or `monitor/speed_feedback`; None without one."""
        return await self._client.last(axis, item)

    def samples(self, axis: str = "*", item: str = "*") -> Stream[tuple[str, Sample]]:
        """Take telemetry of any item, `*` for all but monitors: pairs of the axis and its sample.

        `async for axis, sample in rig.samples()`; `async with` yields an iterator, which counts in `dropped` what its
        reader was too slow for.
        """
        return Stream(self._client.samples(axis, item))

    # -- making axes -------------------------------------------------------------------------------------------------

    def _axis(self, name: str) -> Axis:
        try:
            return self._held[name]
        except KeyError:
            raise UnknownAxis(f"axis {name!r} is not controlled here", axis=name, value=name) from None

    @asynccontextmanager
    async def watched(self, names: tuple[str, ...]) -> AsyncIterator[tuple[Axis, ...]]:
        """Watch axes; always a tuple."""
        check_axes(self.name, names, self.axes)
        loop = asyncio.get_running_loop()
        async with AsyncExitStack() as watching:
            axes = [await watching.enter_async_context(Axis(name, self._client, loop).watched()) for name in names]
            yield tuple(axes)

    @asynccontextmanager
    async def controlled(
        self, names: tuple[str, ...], who: str, lease_s: float, *, force: bool
    ) -> AsyncIterator[tuple[Axis, ...]]:
        """Control axes; always a tuple."""
        control = await take_control(self._client, who, names, lease_s, force=force)
        lease = control.lease
        wanted = names if control.inherited and names else lease.axes
        unfinished: dict[Axis, Motion] = {}
        try:
            async with self.watched(wanted) as covered, asyncio.TaskGroup() as group:
                axes = (
                    covered
                    if set(names) != set(wanted)
                    else tuple(next(axis for axis in covered if axis.name == name) for name in names)
                )
                for axis in axes:
                    axis.control = control
                    self._held[axis.name] = axis
                keeper = group.create_task(_keep(control, axes), name=f"lease of {who}")
                try:
                    yield axes
                except BaseException:
                    await _halt_unfinished(axes)
                    raise
                else:
                    under_way = {axis: await axis.under_way() for axis in axes}
                    # a halt is waited for below
                    unfinished = {
                        axis: motion for axis, motion in under_way.items() if motion and not axis.comes_to_rest
                    }
                    # the daemon does so when a lease is released, but not with what it may not have got yet
                    await _halt_unfinished([axis for axis in axes if control.inherited or axis.unanswered])
                finally:
                    # under control: an axis that is given up while it slows down does what `loss.client` says
                    await asyncio.gather(*map(come_to_rest, axes))
                    keeper.cancel()
                    for axis in axes:
                        self._held.pop(axis.name, None)
        except BaseExceptionGroup as errors:
            raise told_once(errors) from None
        finally:
            await control.release()
        await _warn_of_unfinished(self._client, unfinished)

    def __repr__(self) -> str:
        return f"<rig {self.name}: axes {', '.join(self.axes)}>"


@asynccontextmanager
async def _only(axes: AbstractAsyncContextManager[tuple[Axis, ...]]) -> AsyncIterator[Axis]:
    async with axes as found:
        yield found[0]


async def _keep(control: Control, axes: tuple[Axis, ...]) -> None:
    """Renew until cancelled.

    Raises:
        LeaseExpired: control was lost; this ends the program's context.
    """
    await control.keep()
    for axis in axes:
        axis.lost()
    if control.lost:
        raise control.lost


async def _warn_of_unfinished(client: RigClient, unfinished: Mapping[Axis, Motion]) -> None:
    """Say what control has ended, too: a program that did not wait for it may not have meant that."""
    for axis, motion in unfinished.items():
        ended = f"goes on or is halted, as the `loss.client` of {axis.name} says"
        with contextlib.suppress(LdcndError, TimeoutError):
            async with asyncio.timeout(ENDED_S):
                _, outcome = await client.end_of(motion.reply)
            ended = f"was {outcome.status}: {outcome.reason}"
        target = "" if motion.reply.position is None else f" to {motion.reply.position:g}"
        warnings.warn(
            f"axis {axis.name}: {motion.reply.verb}{target} was under way when its control ended, and {ended}; wait for"
            " it with `done()`",
            UnfinishedMotion,
            stacklevel=2,
        )


async def _halt_unfinished(axes: Iterable[Axis]) -> None:
    # what is cancelled once more sends its halts all the same
    await asyncio.shield(asyncio.gather(*(axis.halt_unfinished() for axis in axes)))
