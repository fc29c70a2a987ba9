"""Several axes on one polyline: their drives walk through points that are sent to them ahead of time.

Each member feeds its own drive, one packet when that has room for it, in the lane of commands: stops and polls go
first. Permission is checked before every packet. An end of one member ends all: the first that notices stops them.
"""

import asyncio
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from typing_extensions import override

from ldcnd.axis.events import CommandOver, MotionStarted, StopDue
from ldcnd.axis.joint_starts import start_path
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import MotionPlan
from ldcnd.axis.polyline import PathAxis, PathWalk, walk
from ldcnd.axis.procedure import Procedure
from ldcnd.axis.procedures.group import Rendezvous, cut_short
from ldcnd.axis.status import Completion
from ldcnd.axis.unmoved import walking
from ldcnd.contract.commands import CommandReply, MoveAbsolute, Verb
from ldcnd.contract.errors import (
    BusError,
    LdcndError,
    NotSupported,
    OutcomeUnknown,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.rig_commands import PathReply
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import AxisReading, PathStatus, StopMode
from ldcnd.drives.network import Network
from ldcnd.line.bus import Bus
from ldcnd.log import get_logger

log = get_logger("axis")

NOT_CONFIRMED = "sent because the stop of its path was not confirmed"
AHEAD_S = 1.0
"""Part of the path that the drives hold in advance, seconds: they walk it to its end if the daemon dies."""
LINE_SHARE = 0.5
"""Most of a line's time for feeding paths."""
LEVEL_POINTS = 3
"""Largest difference between the points in a drive and those expected: from its start to when that was seen."""
CLOCK_SHARE = 0.0005
"""Largest difference between the clock rates of a drive and of this host, as a fraction."""
LATE_S = 1.0
"""Longest overrun of a path before it is stopped, seconds."""


class PathShareRequest(MoveAbsolute):
    """One member's share of a path; made by the daemon, never read from the network."""

    via: tuple[float, ...] = ()
    _rendezvous: "SharedPath"

    @classmethod
    def of(cls, move: MoveAbsolute, via: tuple[float, ...], path: "SharedPath") -> "PathShareRequest":
        """Return the share of an axis."""
        request = cls(**move.model_dump(), via=via)
        request._rendezvous = path
        return request

    @property
    def rendezvous(self) -> "SharedPath":
        """The path with its other members."""
        return self._rendezvous


@dataclass(slots=True)
class _Share:
    """Progress of one member.

    Attributes:
        member: the procedure of its axis.
        sent: points.
        over: it has reached the last point.
        tripped: its drive has opened its loop.
    """

    member: "PathMember"
    sent: int = 0
    over: bool = False
    tripped: bool = False


class SharedPath(Rendezvous):
    """State shared by the members of one path.

    Attributes:
        plan: the points; None before all members have come.
        broken: why it was stopped; empty while it was not.
        begun_s, begun_by_s: the earliest and the latest instant at which the drives began to walk, in loop time: what
            proves that they did takes a while. Infinite before.
    """

    def __init__(
        self, network: Network, bus: Bus, names: frozenset[str], speed: float | None, max_deviation: float | None
    ) -> None:
        super().__init__(names, speed, max_deviation)
        self.plan: PathWalk | None = None
        self.broken = ""
        self.begun_s = self.begun_by_s = math.inf
        self._network = network
        self._bus = bus
        self._names = names
        self._speed = speed
        self._max_deviation = max_deviation
        self._shares: dict[str, _Share] = {}

    async def join(self, name: str, member: "PathMember") -> None:
        """Wait for the others; return once the drives walk.

        Raises:
            WrongState: another member did not come in time, or refused.
            LdcndError: as `Network.start_path`.
        """
        self._shares[name] = _Share(member)
        await self._arrived(name)

    @override
    async def _start(self) -> None:
        fed = False
        try:
            members = {name: share.member for name, share in self._shares.items()}
            for member in members.values():
                member.make_plan()  # anew: the speed override may be another by now
            plan = self.plan = self._planned({name: member.on_path() for name, member in members.items()})
            self._check_line(members)
            for member in members.values():
                await member.prepare()
            fed = True
            ahead = round(AHEAD_S / plan.period_s)
            while min(share.sent for share in self._shares.values()) < min(ahead, len(member.steps)):
                for share in self._shares.values():
                    await self.feed(share)
            if self._started.done():
                raise WrongState("a member of the path has left, so no axis was started")
            for member in members.values():
                member.announce()
            asked_s = next(iter(members.values())).motion.clock.now_s()
            await start_path(self._network, self._names, [member.permit for member in members.values()])
        except LdcndError as error:
            if fed:
                await self.stop_all(error.message)
            self.fail(error)
        except asyncio.CancelledError:
            self.fail(cut_short())
            raise
        else:
            self.begun_s, self.begun_by_s = asked_s, next(iter(members.values())).motion.clock.now_s()
            if self._started.done():
                await self.stop_all("a member has left while the drives were started")
            else:
                self._started.set_result(None)

    def _planned(self, axes: Mapping[str, PathAxis]) -> PathWalk:
        """Plan the points.

        Raises:
            ValueOutOfRange: the path would be left too far, or an axis would be too fast for path mode.
        """
        first = next(iter(self._shares.values())).member
        drives = [walking(share.member.motion.driver) for share in self._shares.values()]
        cycle_s = first.motion.driver.capture_s
        override = min(share.member.motion.tracker.status.speed_share for share in self._shares.values())
        speed = None if self._speed is None else self._speed * override
        plan = walk(axes, max(drive.path_period_s for drive in drives), cycle_s, speed)
        if self._max_deviation is not None and plan.deviation > self._max_deviation:
            raise ValueOutOfRange(
                f"axes {', '.join(sorted(axes))} would leave the path by {plan.deviation:.4g}, more than"
                f" {self._max_deviation:g}",
                value=plan.deviation,
                limit=self._max_deviation,
                remedy="walk it more slowly, or allow more",
            )
        for name, steps in plan.steps.items():
            most = walking(self._shares[name].member.motion.driver).path_most_counts
            if max(map(abs, steps)) > most:
                raise ValueOutOfRange(
                    f"axis {name}: a path point of {max(map(abs, steps))} counts; path mode takes {most} at most",
                    axis=name,
                    value=max(map(abs, steps)),
                    limit=most,
                    remedy="walk it more slowly",
                )
        return plan

    def _check_line(self, members: Mapping[str, "PathMember"]) -> None:
        drives = [walking(member.motion.driver) for member in members.values()]
        feeding_s = sum(self._bus.longest_s(exchange) for drive in drives for exchange in drive.path_exchanges())
        lasts_s = min(drive.path_packet * drive.path_period_s for drive in drives)
        if feeding_s > LINE_SHARE * lasts_s:
            raise NotSupported(
                f"feeding {len(drives)} axes takes {feeding_s / lasts_s:.0%} of the line; a path gets"
                f" {LINE_SHARE:.0%} at most",
                value=feeding_s,
                limit=LINE_SHARE * lasts_s,
                remedy="raise the baud rate of the line",
            )

    def reply(self, replies: tuple[CommandReply, ...]) -> PathReply:
        """Return the reply to the command whose members were answered so."""
        plan = self.plan or PathWalk({}, 1.0, 0.0)
        return PathReply(
            replies=replies,
            duration_s=plan.duration_s,
            deviation=plan.deviation,
            rate_hz=1.0 / plan.period_s,
            ahead_s=min(AHEAD_S, plan.duration_s),
        )

    def share_of(self, member: "PathMember") -> _Share:
        """Return what is known of a member."""
        return next(share for share in self._shares.values() if share.member is member)

    def holds(self, share: _Share, status: PathStatus) -> bool:
        """Tell whether at some instant of a status a drive has the points left that it was sent and had not walked."""
        if self.plan is None:
            return False
        period_s = self.plan.period_s
        from_s, until_s = status.timing.true_from_s - self.begun_by_s, status.timing.true_until_s - self.begun_s
        most, least = (max(0.0, share.sent - elapsed_s / period_s) for elapsed_s in (from_s, until_s))
        leeway = LEVEL_POINTS + until_s * CLOCK_SHARE / period_s
        return least - leeway <= status.points <= most + leeway

    async def feed(self, share: _Share) -> PathStatus | None:
        """Send one more packet of points to the drive of a member, if there are any left; return what it shows then.

        Raises:
            LdcndError: as `Permit.add_points`; WrongState when the drive has walked what it has, and would keep them.
        """
        member = share.member
        steps = member.steps[share.sent : share.sent + walking(member.motion.driver).path_packet]
        if not steps:
            return None
        # firmware may keep points behind a stop, and no path begins before them
        member.permit.by_s = self.begun_s + (share.sent - 1) * (self.plan.period_s if self.plan else 0.0)
        # before they are sent: if the reply is lost the drive may hold them, and would walk them twice
        share.sent += len(steps)
        try:
            return await member.permit.add_points(steps, self._check_goes_on)
        finally:
            member.permit.by_s = math.inf

    def _check_goes_on(self) -> None:
        # a stop of the path that was sent meanwhile is no stop of the axis, and voids no permit
        begun = math.isfinite(self.begun_s)  # before it no member is at its command
        if reason := self.broken or (begun and self.left()):
            raise WrongState(f"the path was stopped: {reason}")

    def left(self) -> str:
        """Say which member has left the path before its end; empty when none has."""
        for name, share in self._shares.items():
            if not share.over and share.member.outlived(share.member.motion.tracker):
                return f"axis {name} has left the path"
        return ""

    async def stop_all(self, reason: str) -> None:
        """Stop every drive of the path; what each axis says follows from its own step."""
        if self.broken:
            return
        self.broken = reason
        log.warning("path stopped", axes=sorted(self._names), reason=reason)
        closed = {
            name
            for name, share in self._shares.items()
            if share.member.motion.tracker.status.energised and not share.tripped and not share.member.has_gone_on
        }
        try:
            await self._network.stop_together(StopMode.SMOOTH, frozenset(closed))
        except BusError as error:
            log.error("stop of a path not sent to the group", reason=error.message)
        for name, share in self._shares.items():
            if share.member.has_gone_on:
                continue
            try:  # a stop that holds would close the loop of a drive that has tripped
                await share.member.motion.driver.stop(StopMode.SMOOTH if name in closed else StopMode.OFF)
            except BusError as error:
                log.error("stop of a path not confirmed", axis=share.member.motion.config.name, reason=error.message)
                mode = StopMode.SMOOTH if name in closed else StopMode.OFF
                share.member.motion.tracker.take(StopDue(mode, NOT_CONFIRMED, Verb.HALT))


class PathMember(Procedure):
    """One axis of a path: feeds its drive until the last point, then settles like any move."""

    def __init__(self, motion: AxisMotion, permit: Permit, request: PathShareRequest) -> None:
        self.permit = permit
        self.motion = motion
        self.plan: MotionPlan
        self._request = request
        self._path = request.rendezvous
        self._corners: tuple[float, ...] = ()
        self._here = 0
        self._announced = False

    @property
    def has_gone_on(self) -> bool:
        """Whether another command moves the axis, for which it was brought to rest: it must not be stopped again."""
        command = self.motion.tracker.status.command
        return command is not None and command.command_id != self.permit.command_id

    @property
    def steps(self) -> tuple[int, ...]:
        """The points of this axis."""
        plan = self._path.plan
        return plan.steps[self.motion.config.name] if plan else ()

    async def begin(self) -> CommandReply:
        """See `Procedure`; a member that cannot walk keeps the others from it.

        Raises:
            LdcndError: as `move_absolute` to each corner, or because another member could not.
        """
        path, motion = self._path, self.motion
        try:
            self.permit.check_state()
            walking(motion.driver).check_path()
            status = await walking(motion.driver).path_status()
            # the drive would walk what is left of an earlier path first
            if status.points or status.running or not status.enabled:
                raise WrongState(
                    f"axis {motion.config.name}: {status.points} points of an earlier path are left in the drive",
                    axis=motion.config.name,
                    value=status.points,
                    remedy="restart the drive",
                )
            self._here = status.commanded_counts
            self.make_plan()
            await path.join(motion.config.name, self)
        except (LdcndError, asyncio.CancelledError) as error:
            failure = error if isinstance(error, LdcndError) else cut_short()
            path.fail(failure)
            self._not_started(failure)
            raise
        motion.tracker.take(MotionStarted(self.permit.command_id, motion.clock.now_s(), endless=False))
        self._wait(path.share_of(self).sent)
        return motion.reply(self.permit, self.plan, duration_s=path.plan.duration_s if path.plan else None)

    def make_plan(self) -> None:
        """Plan the move to each corner from the one before, by limits and the speed override of now.

        Raises:
            RequestRefused: as `move_absolute`.
        """
        motion, request = self.motion, self._request
        self.permit.planned_share = motion.tracker.status.speed_share
        corners = [self._here]
        for position in (*request.via, request.position):
            corner = motion.plans.unwrapped(position, request.direction, from_counts=corners[-1])
            self.plan = motion.plans.to(corner, request.velocity, request.acceleration)
            corners.append(self.plan.motion.target_counts or 0)
        self._corners = tuple(map(float, corners))  # where the path turns, in counts of the drive

    def on_path(self) -> PathAxis:
        """Return the share of this axis."""
        motion = self.plan.motion
        return PathAxis(
            self._corners,
            abs(self.motion.scale.counts_per_unit),
            abs(motion.velocity_counts_per_s),
            motion.acceleration_counts_per_s2,
        )

    async def prepare(self) -> None:
        """Put the acceleration in force by which a smooth stop ends the path: a trapezoid that goes nowhere."""
        driver, places = self.motion.driver, (round(min(self._corners)), round(max(self._corners)))
        for place in places:
            # a drive sets its counter back where a target lies beyond it; points that lead there would count on
            if abs(place - self._here) > driver.room_counts(forward=place > self._here):
                await self.permit.load(replace(self.plan.motion, target_counts=place, stays=True))
        await self.permit.load(replace(self.plan.motion, target_counts=self._here, stays=True))
        await self.permit.start(stays=True)

    def announce(self) -> None:
        """Say that the axis moves, before its drive does."""
        self._announced = True
        self.permit.announce(self.plan.motion, anywhere=True)
        self.motion.begin(
            self.permit.command_id, self.permit.verb, AxisState.DISCRETE_MOTION, Completion.PROCEDURE, plan=self.plan
        )

    @override
    def calls_for_step(self, reading: AxisReading) -> bool:
        return bool(self._path.broken or self._path.left())

    async def step(self) -> bool:
        """See `Procedure`: see whether the path goes on, and send the next packet.

        Raises:
            WrongState: the path was stopped.
        """
        path, motion = self._path, self.motion
        share, name = path.share_of(self), motion.config.name
        try:
            reason = path.broken or path.left()
            if not reason:
                status = await walking(motion.driver).path_status()
                ends_s = path.begun_s + (path.plan.duration_s if path.plan else 0.0)
                share.tripped = not status.enabled
                if share.tripped:
                    reason = f"axis {name} has opened its loop"
                elif share.sent >= len(self.steps) and not status.running and not status.points:
                    if status.timing.true_until_s < ends_s - 2 * walking(motion.driver).path_period_s:
                        reason = f"axis {name} ended its path early"
                    else:
                        share.over = True
                        return self._settle(status.commanded_counts)
                elif not status.running:
                    reason = f"axis {name} ran out of points: they came too late"
                elif not path.holds(share, status):
                    reason = f"axis {name} has {status.points} points left, which is not what it was sent"
                elif status.timing.true_from_s - path.begun_by_s > ends_s - path.begun_s + LATE_S:
                    reason = f"axis {name} still walks, {LATE_S:g} s later than planned"
                else:
                    self._wait((await path.feed(share) or status).points)
        except LdcndError as error:
            reason = reason or path.broken or path.left() or f"axis {name}: {error.message}"
        if not reason:
            return True
        await path.stop_all(reason)
        raise WrongState(f"axis {name}: the path was stopped: {reason}", axis=name)

    def _wait(self, points: int) -> None:
        """Come again when the drive has room for another packet."""
        drive = walking(self.motion.driver)
        spare = points - (round(AHEAD_S / drive.path_period_s) - drive.path_packet)
        self.deadline_s = self.motion.clock.now_s() + max(1, spare) * drive.path_period_s

    def _settle(self, commanded_counts: int) -> bool:
        """The last point was reached: the rest is as behind any move; the drive must have summed up what was sent."""
        motion, target = self.motion, self.plan.motion.target_counts
        name, own = motion.config.name, self.permit.command_id
        if target is None or abs(commanded_counts - target) > 1:
            reason = f"the drive ended its path at {commanded_counts} counts, not at {target}"
            motion.tracker.take(CommandOver(own, reason))
            motion.publish_state()
            return False
        at_end = replace(self.plan, duration_s=0.0)
        motion.begin(own, self.permit.verb, AxisState.DISCRETE_MOTION, Completion.PROFILE, plan=at_end, goes_on=True)
        motion.tracker.take(MotionStarted(own, motion.clock.now_s(), target, endless=False))
        log.debug("path walked", axis=name)
        return False

    def _not_started(self, error: LdcndError) -> None:
        motion = self.motion
        if not self._announced or self.outlived(motion.tracker):
            return
        if isinstance(error, OutcomeUnknown):
            motion.comes_to_rest(self.permit, error.message)
            return
        motion.tracker.take(CommandOver(self.permit.command_id, error.message))
        motion.publish_state()
