"""The judge of whole schedules: what clients have sent, and what the simulated drives and shafts do.

It keeps its own books of commands, leases, stops and daemons, from what is sent and answered. Of a daemon it takes only
in whose name it moves an axis, and whether it calls the axis referenced; both are held against the books.
"""

import asyncio
import itertools
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

from typing_extensions import override

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import (
    AxisCommand,
    CommandReply,
    Direction,
    Jog,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Reset,
    SetPosition,
)
from ldcnd.contract.rig_commands import AxisPath
from ldcnd.daemon.daemon import Daemon
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.received import AddPathPoints, LoadTrajectory, PlainCommand, ReceivedCommand, StopMotor
from ldcnd.drives.ldcn.registers import FRACTION
from ldcnd.drives.ldcn.trajectory import ProfileMode
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from tests.support.witness import STANDING_COUNTS, Witness

ROUNDING = 1e-6
"""Tolerance of a profile, relative: it is made of register values."""
GOAL_COUNTS = 40.0
"""Tolerance of a goal: a shaft is within its settling window where a motion begins, and where its place is named."""
ON_THE_FLY_S = 0.4
"""A motion that follows another without a halt is planned from where that one was so long ago, or will end."""
LIMIT_COUNTS = 60.0
"""So far a servo overshoots a software limit."""
PATH_COUNTS = 150.0
"""So far an axis may be beside its polyline: the points of corners, and what the servo lags."""
SEEN_WITHIN_S = 0.4
"""Until a daemon knows at the latest that a drive has opened its loop: it is polled six times a second."""
ARRIVES_S = 0.05
"""From when a packet is written until its drive executes it."""
REACHED_WITHIN_S = 1.5
"""From when a cable is back or a process goes on until a motion that went on meanwhile is brought to rest."""
CAME_S = 1e-6
"""What is sent arrives at once; the turn of the loop in which it does takes no longer."""


def now_ns() -> int:
    """Return the wall clock: that of the loop."""
    return 10**18 + round(asyncio.get_running_loop().time() * 1e9)


@dataclass
class Asked:
    """A command of one axis.

    Attributes:
        axis: which.
        command: as it was sent.
        sent_s: when, each time.
        refused_s: when it was refused for good; None while it was not.
        from_counts: where the shaft was when its position was to be named.
    """

    axis: str
    command: AxisCommand[CommandReply]
    sent_s: list[float] = field(default_factory=list)
    refused_s: float | None = None
    from_counts: float = 0.0


@dataclass
class Held:
    """A lease: until when it can hold at the latest, by what was sent and answered."""

    client: str
    until_s: float


@dataclass
class Begun:
    """The motion of an axis that was begun last.

    Attributes:
        command_id: in whose name.
        referenced: its daemon called the axis referenced.
        at_s: when.
        corners: of a path, true places in counts, its beginning included.
    """

    command_id: str = ""
    referenced: bool = False
    at_s: float = -math.inf
    corners: tuple[float, ...] = ()


class ShaftJudge(Witness):
    """A witness that explains every motion by a command, and every command by its motion.

    Attributes:
        settings: the rig.
        asked: the commands of all clients, by id.
        leases: by token.
        stops: of each axis, when the last stop was sent that no reset has followed.
        latched: of each axis, when that stop was sent, if a daemon has said that its latch is kept.
        zeros: where a position of 0 may be in truth, in counts of the shaft, by axis; empty where nothing is known.
        resets: where the shaft stood when the drive was reset last, by axis.
        heard: when each drive executed Stop Motor.
        daemons: those whose tokens are shown.
        born: when each was made.
        ended: those that were told to end, and when.
        tripped: of each axis, when its drive last opened its loop by itself.
        frozen: when the process was held up, and until when.
        out_of_reach: when no daemon could reach the drives, and until when.
        motions: how many were begun.
        modules: the drives, in the order of the chain.
    """

    def __init__(self, chain: Chain, axes: Mapping[int, tuple[str, ...]], settings: RigConfig) -> None:
        super().__init__(chain, axes)
        self.settings = {axis.name: axis for axis in settings.bus[0].axis}
        self.asked: dict[str, Asked] = {}
        self.leases: dict[str, Held] = {}
        self.stops: dict[str, float] = {}
        self.latched: dict[str, float] = {}
        self.zeros: dict[str, tuple[float, ...]] = dict.fromkeys(self.settings, (0.0,))
        self.resets: dict[str, float] = dict.fromkeys(self.settings, 0.0)
        self.heard: dict[str, list[float]] = defaultdict(list)
        self.daemons: set[str] = set()
        self.born: dict[str, float] = {}
        self.ended: dict[str, float] = {}
        self.tripped: dict[str, float] = {}
        self.frozen: list[tuple[float, float]] = []
        self.out_of_reach: list[tuple[float, float]] = []
        self._beyond: dict[str, float] = defaultdict(float)
        self.begun: dict[str, Begun] = {name: Begun() for name in self.settings}
        self.renewed: dict[str, float] = {}
        self.motions = 0
        self.paths = 0
        self._next: dict[str, Begun] = {}
        self._goals: dict[str, float] = {}
        self._naming: dict[str, int] = defaultdict(int)
        self._up: set[str] = set()
        self._reset_s: dict[str, float] = {}
        self.modules: list[SimulatedDrive] = []
        for address, names in axes.items():
            if len(names) == 1 and address <= len(chain.modules):
                drive = chain.modules[address - 1]
                assert isinstance(drive, SimulatedDrive)
                self.modules.append(drive)
                self._watch(names[0], drive)

    # -- what clients and daemons do ---------------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        return asyncio.get_running_loop().time()

    def sent(self, axis: str, command: AxisCommand[CommandReply]) -> Asked:
        """Note a command that is about to be sent."""
        assert command.command_id
        asked = self.asked.setdefault(command.command_id, Asked(axis, command))
        asked.sent_s.append(self.now_s)
        if isinstance(command, Reset):
            self._reset_s[axis] = self.now_s
            self.stops.pop(axis, None)
            self.latched.pop(axis, None)
        if isinstance(command, Jog):
            self.renewed[command.renews or command.command_id] = self.now_s
        if isinstance(command, SetPosition):
            self._naming[axis] += 1
            self.zeros[axis] = ()
            asked.from_counts = self.drive(axis).shaft.position_counts
        return asked

    def answered(self, asked: Asked, *, accepted: bool | None) -> None:
        """Note what came of it; None where that is not known."""
        if self.daemon:
            self.came_up(self.daemon)
        if accepted is False and len(asked.sent_s) == 1:
            asked.refused_s = self.now_s
        if not isinstance(asked.command, SetPosition):
            return
        self._naming[asked.axis] -= 1
        here = self.drive(asked.axis).shaft.position_counts
        stood = abs(here - asked.from_counts) < STANDING_COUNTS  # one that coasts is named where it was read
        if accepted and stood and not self._naming[asked.axis] and len(asked.sent_s) == 1:
            counts = asked.command.position * self.settings[asked.axis].signed_counts_per_unit
            self.zeros[asked.axis] = (here - counts,)

    def stopped(self, axis: str) -> None:
        """Note a stop that is about to be sent; which of it and a reset of the same instant comes last is open."""
        if self.now_s > self._settled_s(self._reset_s.get(axis, -math.inf)):
            self.stops[axis] = self.now_s

    def kept(self, axes: tuple[str, ...], since_s: float) -> None:
        """Note that the latches of a stop outlast the daemon, for those that no reset has followed."""
        for axis in axes:
            if self.stops.get(axis, math.inf) <= since_s:
                self.latched[axis] = since_s

    def came_up(self, daemon: Daemon) -> None:
        """See whether a daemon has brought its line up for the first time, and which places it has taken for 0."""
        instance = daemon._run.instance
        if instance in self._up or daemon.rig.buses[0].report is None:
            return
        self._up.add(instance)
        keeps = daemon.config.state_dir is not None
        for name in daemon.rig.axes:
            self.zeros[name] = (self.resets[name], *(self.zeros[name] if keeps else ()))
            if name in self.latched and not daemon.rig.axes[name].tracker.status.stop_latched:
                self.wrong.append(f"{self.now_s:.4f}: {instance} does not know that {name} is latched")

    def _settled_s(self, at_s: float) -> float:
        """Return until when what happened at an instant may not have been noticed."""
        for since_s, until_s in self.frozen:
            if since_s - CAME_S <= at_s < until_s:
                at_s = until_s
        return at_s + CAME_S

    # -- what drives do ----------------------------------------------------------------------------------------------

    def _watch(self, name: str, drive: SimulatedDrive) -> None:
        restart, execute = drive.restart, drive.execute

        def restarted() -> None:
            restart()
            self.resets[name] = drive.shaft.position_counts
            self._watch_profile(name, drive)

        def executed(command: ReceivedCommand) -> None:
            before, tripped = drive.loop.trajectory.velocity, self.tripped.get(name, -math.inf)
            execute(command)
            if isinstance(command, StopMotor):
                self.heard[name].append(self.now_s)
                self.tripped[name] = tripped  # what opened the loop now was asked for
            self._check_goal(name, drive, command, moving=bool(before))

        drive.restart, drive.execute = restarted, executed  # type: ignore[method-assign]
        self._watch_profile(name, drive)

    def _watch_profile(self, name: str, drive: SimulatedDrive) -> None:
        """Hold every tick of a profile against the limits of its axis."""
        axis, loop, trajectory = self.settings[name], drive.loop, drive.loop.trajectory
        counts, cycle_s, step = abs(axis.signed_counts_per_unit), drive.profile.servo_cycle_s, trajectory.step
        most_velocity = (axis.limits.velocity or math.inf) * counts * (1 + ROUNDING)
        most_acceleration = (axis.limits.acceleration or math.inf) * counts * (1 + ROUNDING)

        open_loop = loop.open

        def opened() -> None:
            if loop.servo_on:
                self.tripped[name] = self.now_s
            open_loop()

        loop.open = opened  # type: ignore[method-assign]

        def stepped() -> None:
            before = trajectory.velocity
            step()
            if trajectory.path.running:
                tick_s = cycle_s * loop._tick_cycles
                speed = abs(trajectory.path.velocity) / FRACTION / tick_s
                if speed > most_velocity:
                    self.wrong.append(f"{name} is on a path at {speed:.0f} counts/s")
                return
            after = trajectory.velocity
            if after == before == 0:
                return
            tick_s = cycle_s * loop._tick_cycles
            if abs(after) / FRACTION / tick_s > most_velocity:
                self.wrong.append(f"{name} has a profile at {abs(after) / FRACTION / tick_s:.0f} counts/s")
            change = abs(after - before) / FRACTION / tick_s**2
            if change > most_acceleration:
                self.wrong.append(f"{name} has a profile at {change:.0f} counts/s2")

        trajectory.step = stepped  # type: ignore[method-assign]

    # -- beginnings --------------------------------------------------------------------------------------------------

    @override
    def _forbidden(self, daemon: Daemon, name: str, now_s: float, *, begins: bool) -> str | None:
        if not begins and now_s <= self._settled_s(self.tripped.get(name, -math.inf)) + SEEN_WITHIN_S:
            return None  # the drive has opened its loop by itself, and no reading could tell
        instance = daemon._run.instance
        if (ended_s := self.ended.get(instance)) is not None and now_s > self._settled_s(ended_s):
            return f"the end of its daemon has begun at {ended_s:.4f}"
        if others := self.daemons - {instance}:
            return f"there are other daemons, {sorted(others)}"
        stopped_s = self.stops.get(name, math.inf)
        holds = name in self.latched or stopped_s >= self.born[instance]
        if now_s > self._settled_s(stopped_s) and holds:
            return f"it was stopped at {stopped_s:.4f} and not reset"
        return super()._forbidden(daemon, name, now_s, begins=begins)

    @override
    def _count(self, daemon: Daemon, name: str, now_s: float) -> None:
        self.motions += 1
        self.came_up(daemon)
        tracker = daemon.rig.axes[name].tracker
        command = tracker.status.command
        asked = self.asked.get(command.command_id) if command else None
        if command is None or asked is None:
            self.wrong.append(f"{now_s:.4f}: {name} is moved by {command and command.command_id}, which was not sent")
            return
        self._next[name] = Begun(command.command_id, tracker.status.referenced, now_s)
        if not isinstance(asked.command, Jog):
            super()._count(daemon, name, now_s)
        if why := self._unexplained(daemon, asked, name, now_s):
            self.wrong.append(f"{now_s:.4f}: {name} is moved by {asked.command!r} although {why}")

    def _unexplained(self, daemon: Daemon, asked: Asked, name: str, now_s: float) -> str | None:
        """Return why a command does not explain a motion that begins."""
        command = asked.command
        if asked.axis != name:
            return f"it is of {asked.axis}"
        if asked.refused_s is not None and self._settled_s(asked.refused_s) < now_s:
            return f"it was refused at {asked.refused_s:.4f}"
        if max(asked.sent_s) < self.born[daemon._run.instance]:
            return "it was sent to an earlier daemon only"
        if command.not_after is not None and now_ns() > command.not_after and not isinstance(command, Jog):
            return f"it is {(now_ns() - command.not_after) / 1e9:.4f} s too late"
        if isinstance(command, Jog):
            renewed_s = self._settled_s(self.renewed[command.renews or command.command_id or ""])
            if now_s > renewed_s + command.hold_s:
                return f"its hold was renewed last at {renewed_s:.4f}"
        held = self.leases.get(command.lease or "")
        if held is None:
            return "its lease was never given"
        if now_s > self._settled_s(held.until_s):
            return f"its lease has ended at {held.until_s:.4f} or before"
        return None

    def _check_goal(self, name: str, drive: SimulatedDrive, command: ReceivedCommand, *, moving: bool) -> None:
        """Compare where a motion that a drive begins will end with what its command said."""
        match command:
            case LoadTrajectory(trajectory) if trajectory.start_now and trajectory.velocity:
                pass
            case PlainCommand(CommandCode.START_MOTION) | AddPathPoints((), None):
                pass
            case StopMotor(control, _) if control & StopControl.HERE:
                pass
            case _:
                return
        begun = self._next.pop(name, None)
        if begun is None or self.now_s > begun.at_s + ARRIVES_S:
            return  # the packet that was to begin it was damaged on its way; this one goes nowhere
        self.begun[name] = begun
        profile, request = drive.loop.trajectory, self.asked[begun.command_id].command
        loose = drive.shaft.position_counts - drive.loop.position  # of the shaft and the drive's own counter
        here = profile.position / FRACTION + loose
        if isinstance(request, AxisPath):
            self._begin_path(name, begun, request, here)
        elif profile.mode is ProfileMode.TRAPEZOIDAL:
            goal, tick_s = profile._goal / FRACTION + loose, drive.profile.servo_cycle_s * drive.loop._tick_cycles
            speed, shaft = profile._top_speed / FRACTION / tick_s, drive.shaft.position_counts
            wrong = self._wrong_motion(name, request, (here, shaft), goal, speed, moving=moving)
            if wrong:
                way = f"{name} goes from {here:.0f} to {goal:.0f} for {request!r}"
                self.wrong.append(f"{self.now_s:.4f}: {way}: {wrong}")
            self._goals[name] = goal

    def _wrong_motion(
        self,
        name: str,
        request: AxisCommand[CommandReply],
        places: tuple[float, float],
        goal: float,
        speed: float,
        *,
        moving: bool,
    ) -> str | bool:
        """Tell what is wrong with a trapezoid: its goal, its way, its speed in counts a second.

        Its distance is from where the shaft is or from where its drive wants it; the two differ while a servo settles.
        """
        here, shaft = places
        axis = self.settings[name]
        counts, tolerance = axis.signed_counts_per_unit, GOAL_COUNTS
        if moving:
            tolerance += ON_THE_FLY_S * (axis.limits.velocity or axis.velocity) * abs(counts)
        asked = getattr(request, "velocity", None)
        most = abs(axis.velocity if asked is None else asked) * abs(counts) * (1 + ROUNDING)
        if speed > most and not isinstance(request, Jog):  # a renewal may ask for more
            return f"that is at {speed:.0f} counts/s"
        match request:
            case MoveAbsolute(position=position, direction=direction):
                wrong = self._wrong_goal(name, goal, position, self.begun[name])
                if wrong or axis.modulo is None or moving:
                    return wrong
                return _wrong_way((goal - here) / counts, direction, axis.modulo, GOAL_COUNTS / abs(counts))
            case MoveRelative(distance=distance):
                froms = here, shaft, self._goals.get(name, here)  # one that follows a move in mid-move is from its goal
                off = min(abs(goal - begin - distance * counts) for begin in froms)
                return off > tolerance and "that is another distance"
            case MoveVelocity(velocity=velocity):
                backward = (goal - here) * velocity * counts < 0 and abs(goal - here) > tolerance
                return backward and "that is the other way"
        return False

    def _wrong_goal(self, name: str, goal: float, position: float, begun: Begun) -> str | bool:
        """Tell what is wrong with the goal of an absolute move."""
        axis, zeros = self.settings[name], self.zeros[name]
        if not zeros or self._naming[name]:
            return False
        if not begun.referenced:
            return "the axis is not referenced"
        off = []
        for zero in zeros:
            way = (goal - zero) / axis.signed_counts_per_unit - position
            off.append(abs(way if axis.modulo is None else math.remainder(way, axis.modulo)))
        return min(off) * abs(axis.signed_counts_per_unit) > GOAL_COUNTS and f"0 is at {zeros}"

    def _begin_path(self, name: str, begun: Begun, request: AxisPath, here: float) -> None:
        axis, zeros = self.settings[name], self.zeros[name]
        self.paths += 1
        if len(zeros) != 1 or self._naming[name]:
            return
        corners, counts = [here], axis.signed_counts_per_unit
        for position in (*request.via, request.position):
            place = zeros[0] + position * counts
            if axis.modulo is not None:
                turn = abs(counts) * axis.modulo
                way = math.remainder(place - corners[-1], turn)
                if request.direction is Direction.POSITIVE:
                    way = way % turn if counts > 0 else -(-way % turn)
                elif request.direction is Direction.NEGATIVE:
                    way = -(-way % turn) if counts > 0 else way % turn
                place = corners[-1] + way
            corners.append(place)
        begun.corners = tuple(corners)

    # -- places ------------------------------------------------------------------------------------------------------

    def _is_out_of_reach(self) -> bool:
        return any(since_s <= self.now_s <= until_s + REACHED_WITHIN_S for since_s, until_s in self.out_of_reach)

    async def watch(self) -> None:
        """Look at the shafts again and again."""
        while True:
            self.look_at_places()
            await asyncio.sleep(0.01)

    def look_at_places(self) -> None:
        """Hold the shafts against software limits and paths."""
        if self.daemon:
            self.came_up(self.daemon)
        walking: dict[str, SimulatedDrive] = {}
        for name, axis in self.settings.items():
            drive, begun = self.drive(name), self.begun[name]
            if drive.loop.trajectory.path.running and begun.corners:
                walking[name] = drive
            zeros = self.zeros[name]
            if not begun.referenced or not drive.loop.servo_on or len(zeros) != 1 or self._naming[name]:
                continue
            counts = axis.signed_counts_per_unit
            low, high = axis.limits.position_min, axis.limits.position_max
            if low is None or high is None or drive.loop.trajectory.at_rest:
                continue
            asked = self.asked.get(begun.command_id or "")
            position, spare = (drive.shaft.position_counts - zeros[0]) / counts, LIMIT_COUNTS / abs(counts)
            beyond = max(low - position, position - high)
            before, self._beyond[name] = self._beyond[name], beyond
            if asked and isinstance(asked.command, MoveVelocity | Jog) and self._is_out_of_reach():
                continue  # a motion without an end in the drive goes on while nothing can reach it
            if beyond > max(spare, before):  # from where that has led, it may come back
                self.wrong.append(
                    f"{self.now_s:.4f}: {name} is at {position:.3f} in {begun.command_id}, beyond its limits"
                )
                begun.referenced = False  # once is enough
        if len(walking) == len(self.settings) > 1:
            self._look_at_path(walking)

    def _look_at_path(self, walking: Mapping[str, SimulatedDrive]) -> None:
        legs = list(zip(*(self.begun[name].corners for name in walking), strict=False))
        place = tuple(drive.shaft.position_counts for drive in walking.values())
        off = min(_beside(place, first, last) for first, last in itertools.pairwise(legs))
        if off > PATH_COUNTS:
            self.wrong.append(f"{self.now_s:.4f}: {list(walking)} are {off:.0f} counts beside their path {legs}")
            for name in walking:
                self.begun[name].corners = ()

    def is_at_rest(self, axis: str) -> bool:
        """Tell whether a drive has no motion of its own under way."""
        loop = self.drive(axis).loop
        return not loop.trajectory.velocity and not loop.trajectory.path.running if loop.servo_on else not loop.pwm


def _wrong_way(way: float, direction: Direction | None, modulo: float, spare: float) -> str | bool:
    """Tell what is wrong with the way of a turning axis."""
    match direction:
        case Direction.POSITIVE:
            return not -spare <= way < modulo + spare and f"{way:g} is not the positive way"
        case Direction.NEGATIVE:
            return not -modulo - spare < way <= spare and f"{way:g} is not the negative way"
    return abs(way) > modulo / 2 + spare and f"{way:g} is not the shortest way"


def _beside(place: tuple[float, ...], first: tuple[float, ...], last: tuple[float, ...]) -> float:
    """Return how far a place is beside a leg."""
    leg = [end - begin for begin, end in zip(first, last, strict=True)]
    length = sum(each * each for each in leg)
    along = (
        sum((at - begin) * each for at, begin, each in zip(place, first, leg, strict=True)) / length if length else 0.0
    )
    along = min(1.0, max(0.0, along))
    return math.dist(place, [begin + along * each for begin, each in zip(first, leg, strict=True)])
