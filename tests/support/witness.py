"""What truly happens on a simulated line, whatever the daemon says: what is sent that can move; where shafts are."""

import asyncio
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from ldcnd.contract.commands import Verb
from ldcnd.contract.samples import LinkState, Moving
from ldcnd.daemon.daemon import Daemon
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import CommandCode, Packet, PacketReader
from ldcnd.drives.ldcn.received import AddPathPoints, LoadTrajectory, StopMotor, received_command
from ldcnd.drives.ldcn.registers import FRACTION
from ldcnd.drives.ldcn.trajectory import ProfileMode
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.drive import SimulatedDrive

MOST_STARTS = {Verb.HOME: 4, Verb.JOG: 3, Verb.TRACK: 2}
"""Packets that begin a motion, of one command; every other verb has one. A jog begins again with another velocity, and
a set-point, which is a place, is told twice."""
STANDING_COUNTS = 10
"""A shaft that stands moves by less within `LOOK_S`: a closed loop settles and hunts."""
LOOK_S = 0.2
TRUE_WITHIN_UNITS = 0.02


@dataclass
class Witness:
    """Reads every packet of the host before the drives do.

    Attributes:
        chain: the line.
        axes: names, by address; the members of a group by its address.
        daemon: who sends at present; None when nobody may send anything that moves.
        started: packets that began a motion, by the command in whose name.
        wrong: what must not happen and has happened.
    """

    chain: Chain
    axes: Mapping[int, tuple[str, ...]]
    daemon: Daemon | None = None
    started: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Listen to the host from now on."""
        self._write = self.chain.write
        self._reader = PacketReader()
        self.chain.write = self._heard  # type: ignore[method-assign]

    def drive(self, axis: str) -> SimulatedDrive:
        """Return the drive of an axis, with its servo cycles up to now behind it."""
        address = next(address for address, names in self.axes.items() if names == (axis,))
        module = self.chain.modules[address - 1]
        assert isinstance(module, SimulatedDrive)
        module.catch_up(asyncio.get_running_loop().time())
        return module

    def _heard(self, now_s: float, data: bytes) -> None:
        for value in data:
            received = self._reader.feed(value)
            if received:
                self._judge(received.packet, now_s)
        self._write(now_s, data)

    def _judge(self, packet: Packet, now_s: float) -> None:
        names = self.axes.get(packet.address, ())
        for name in names:
            begins, closes = self._moves(packet, name)
            if not begins and not closes:
                continue
            if self.daemon is None:
                self.wrong.append(f"{now_s:.4f}: {name} got {packet} from a daemon that had only started")
                continue
            if why := self._forbidden(self.daemon, name, now_s, begins=begins):
                self.wrong.append(f"{now_s:.4f}: {name} got {packet} although {why}")
            if begins:
                self._count(self.daemon, name, now_s)

    def _moves(self, packet: Packet, name: str) -> tuple[bool, bool]:
        """Tell whether a packet begins a motion of an axis, and whether it closes an open loop or prolongs a path."""
        drive = self.drive(name)
        if packet.address not in (drive.address, drive.group):
            return False, False  # it has lost power, and does not hear this
        command = received_command(drive.dialect, packet)
        match command:
            case LoadTrajectory(trajectory):
                return trajectory.start_now and bool(trajectory.velocity), False
            case AddPathPoints(points, _):
                return not points, bool(points) and drive.loop.trajectory.path.running
            case StopMotor(control, _):
                stops = control & (StopControl.ABRUPT | StopControl.SMOOTH)
                idle = not drive.loop.servo_on and not drive.loop.pwm
                return bool(control & StopControl.HERE), bool(stops) and idle
        if packet.command is not CommandCode.START_MOTION:
            return False, False
        loaded, profile = drive._trajectory, drive.loop.trajectory
        if loaded.mode is ProfileMode.VELOCITY:
            return not (loaded.servo and loaded.velocity == 0), False
        here = loaded.position == profile.position // FRACTION and not loaded.relative
        goes_nowhere = loaded.servo and profile.done and here
        return not goes_nowhere, goes_nowhere and not drive.loop.servo_on

    def _forbidden(self, daemon: Daemon, name: str, now_s: float, *, begins: bool) -> str | None:
        """Return why an axis must not be moved now; without `begins` its loop is closed, or its path goes on."""
        del begins
        tracker, dispatcher = daemon.rig.axes[name].tracker, daemon._dispatcher
        lease = dispatcher.authority.holder(name)
        if lease is None or lease.ends_at_s <= now_s:
            return "nobody holds it"
        if tracker.status.stop_latched or tracker.status.stop_pending:
            return "a stop is latched"
        return f"there are other daemons, {dispatcher.rivals}" if dispatcher.rivals else None

    def _count(self, daemon: Daemon, name: str, now_s: float) -> None:
        command = daemon.rig.axes[name].tracker.status.command
        if command is None:
            self.wrong.append(f"{now_s:.4f}: {name} is moved by no command")
            return
        self.started[command.command_id] += 1
        if self.started[command.command_id] > MOST_STARTS.get(command.verb, 1):
            self.wrong.append(f"{now_s:.4f}: {name} is started again for {command.verb} {command.command_id}")

    async def stands(self, axis: str) -> bool:
        """Tell whether a shaft stands."""
        before = self.drive(axis).shaft.position_counts
        await asyncio.sleep(LOOK_S)
        return abs(self.drive(axis).shaft.position_counts - before) < STANDING_COUNTS

    async def look(self, daemon: Daemon, places: Mapping[str, float]) -> None:
        """Compare what a daemon says of axes that should stand with what is true.

        Args:
            daemon: the one that is asked.
            places: what a position of 0 is called in truth, by axis whose place is known: counts of its shaft.
        """
        before = {name: self.drive(name).shaft.position_counts for name in daemon.rig.axes}
        await asyncio.sleep(LOOK_S)
        for name, axis in daemon.rig.axes.items():
            tracker, counts = axis.tracker, self.drive(name).shaft.position_counts
            moved = abs(counts - before[name]) >= STANDING_COUNTS
            if moved:
                self.wrong.append(f"{name} moves with nobody in charge, {tracker.status.state} {tracker.status.moving}")
            if moved and tracker.status.moving is Moving.NO:
                self.wrong.append(f"{name} moves and is said to stand")
            if tracker.status.link is not LinkState.UP:
                self.wrong.append(f"{name} is {tracker.status.link}")
            if tracker.status.referenced and name in places and not moved:
                said = axis.tracker.status.scale.position(self.drive(name).loop.position)
                true = (counts - places[name]) / axis.config.signed_counts_per_unit
                if abs(said - true) > TRUE_WITHIN_UNITS:
                    self.wrong.append(f"{name} is said to be at {said:g} and is at {true:g}")
