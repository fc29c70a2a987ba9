"""Joint operations of axes of one LDCN/NMC line: start in the same servo cycle, stop by one packet, show one instant.

A group without a leader does not answer: whatever was done is proven afterwards by each drive's own status.
Source: LS-182AP manual, "Addressing"; PIC-SERVO manual, 4.1 "Group Commands", 5.2 "Start Motion", "Save Current
Position As Home".
"""

import asyncio
from collections.abc import Awaitable, Callable, Mapping

from ldcnd.contract.errors import (
    BusError,
    DriveFault,
    LdcndError,
    NotSupported,
    OutcomeUnknown,
    ReplyTimeout,
    RequestRefused,
    WrongState,
)
from ldcnd.contract.rig_commands import CapturedInputs
from ldcnd.drives.driver import CountsMotion, StopMode
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.addressing import Addressing
from ldcnd.drives.ldcn.commands import Node, unanswered
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.group_plan import EVERYBODY, Group, GroupPlan
from ldcnd.drives.ldcn.io_module import IoModule
from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag, StatusItem, StatusPacket
from ldcnd.drives.ldcn.pic_io import LINES, IoStatus
from ldcnd.drives.ldcn.servo import STOP_CONTROLS, LdcnAxis
from ldcnd.drives.network import Instant
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Lane, PacketEffect
from ldcnd.log import get_logger

log = get_logger("ldcn")

READY_ITEMS = StatusItem.POSITION | StatusItem.VELOCITY | StatusItem.AUX
FROZEN_ITEMS = StatusItem.POSITION | StatusItem.HOME
TAKEN_OVER = "the line was taken over, so which modules obey a packet to everybody is not known"
"""Only those that are configured were looked for."""


class Groups:
    """The groups of one line at work.

    Attributes:
        proven: no module is in a group that another host has put it into: after addressing, not after an adoption.
        start_barred: why no packet starts everybody; empty where nothing but configured axes would obey it.
        freeze_barred: why no Save Current Position as Home goes to everybody; empty where all that would obey it
            captures a position or, as Synch Input, the inputs of a PIC-I/O.
    """

    def __init__(
        self,
        bus: Bus,
        plan: GroupPlan,
        addressing: Addressing,
        drives: Mapping[str, LdcnAxis],
        io: tuple[IoModule, ...] = (),
        *,
        snapshots: bool,
    ) -> None:
        self.proven = False
        self.start_barred = self.freeze_barred = TAKEN_OVER
        self._io = io
        self._bus = bus
        self._plan = plan
        self._addressing = addressing
        self._rate = addressing.rate
        self._drives = drives
        self._snapshots = snapshots

    async def stop(self, mode: StopMode, names: frozenset[str]) -> None:
        """See `Network.stop_together`: one burst for all groups whose members all stop.

        Raises:
            BusError: the line failed.
        """
        names = frozenset(name for name in names if not self._drives[name].switched_off)  # it would close their loops
        groups = [
            group for group in self._plan.within(names) if self._usable(group) and not self._untold(group.members)
        ]
        if not groups:
            return
        control = STOP_CONTROLS[mode]
        packets = [commands.stop_motor(commands.LeaderlessGroup(group.address), control).request for group in groups]
        burst = self._rate.spaced(packets)
        stop = unanswered(
            groups[0].address, burst, self._quiet_s(groups), repeatable=True, effect=PacketEffect.RELIEVES
        )
        try:
            await self._bus.execute(stop, Lane.STOP)
        # also when it failed: nobody answers a group, and the packet may have arrived
        finally:
            for group in groups:
                for name in group.members:
                    self._drives[name].state.switched_unconfirmed(
                        pic_ae=bool(control & StopControl.AMP_ENABLE), closed=not control & StopControl.MOTOR_OFF
                    )

    async def start(self, motions: Mapping[str, CountsMotion], still_wanted: Callable[[], None]) -> None:
        """See `Network.start_group`.

        Raises:
            NotSupported, DriveFault, OutcomeUnknown, BusError: as there.
        """
        group = self.group_of(frozenset(motions))
        names = frozenset(motions)
        await self._prove(names)
        before: dict[str, int] = {}
        for name, motion in motions.items():
            before[name] = self._counts(name, await self._ready(name))
            await self._drives[name].load(motion)
        still_wanted()

        async def stuck() -> list[str]:
            return [name for name, motion in motions.items() if not await self._started(name, motion, before[name])]

        await self._start_proven(f"group of {', '.join(sorted(names))}", group, self._start_motion(group), stuck)

    async def start_path(self, names: frozenset[str], still_wanted: Callable[[], None]) -> None:
        """See `Network.start_path`.

        Raises:
            NotSupported, OutcomeUnknown, BusError: as there.
        """
        group = self.group_of(names)
        await self._prove(names)
        still_wanted()

        async def stuck() -> list[str]:
            return [name for name in sorted(names) if not (await self._drives[name].path_status()).running]

        await self._start_proven(f"path of {', '.join(sorted(names))}", group, self._start_walking(group), stuck)

    async def snapshot(self, still_free: Callable[[], None]) -> Instant:
        """See `Network.snapshot`: Save Current Position as Home freezes, the home registers tell.

        A capture that only guards a motion (`limit_switches`) does not need the register; if it comes meanwhile it
        overwrites what was frozen, and the instant is missed.

        Raises:
            NotSupported, WrongState, BusError: as there; ReplyTimeout when a drive missed the packet.
        """
        if not self._snapshots:
            raise NotSupported(
                "positions cannot be frozen on this line: it is not configured", remedy="set snapshot = true on the bus"
            )
        captures_all = not self.freeze_barred
        groups = [group for group in self._plan.groups if group.address != EVERYBODY or captures_all]
        if sum(len(group.members) for group in groups) < len(self._drives):
            raise _barred(
                "positions cannot be frozen on this line by a packet to everybody", self.freeze_barred, "all its axes"
            )
        homing = [name for name, drive in self._drives.items() if drive.state.homing_armed and not drive.state.guard]
        if homing:
            raise WrongState(f"axis {homing[0]} is homing: its home register is in use", axis=homing[0])
        still_free()
        await self._prove(frozenset(self._drives))
        before = {name: await self._frozen(name) for name in self._drives}
        io_before = {module.name: await module.captured() for module in self._io} if captures_all else {}
        addresses = dict.fromkeys(group.address for group in groups) | ({EVERYBODY: None} if io_before else {})
        packets = [commands.save_home(commands.LeaderlessGroup(address)).request for address in addresses]
        save = unanswered(EVERYBODY, self._rate.spaced(packets), self._quiet_s(groups), repeatable=False)
        still_free()
        _, timing = await self._bus.execute_timed(save)
        positions = {}
        for name in self._drives:
            status = await self._frozen(name)
            position, home = status.position or 0, status.home or 0
            captured = (before[name].flags ^ status.flags) & StatusFlag.HOME_IN_PROGRESS
            # a capture has come in between and overwritten it, or it still holds another place than that of the axis
            if captured or (home == before[name].home and position != home):
                raise ReplyTimeout(f"axis {name}: the drive missed the instant", axis=name)
            positions[name] = home + self._drives[name].state.offset_counts
        io = [await self._captured(module, io_before[module.name]) for module in self._io if module.name in io_before]
        return Instant(positions, timing.sent_at_s, timing.received_at_s, tuple(io))

    def group_of(self, names: frozenset[str]) -> Group:
        """Return the group that has exactly these members.

        Raises:
            NotSupported: there is none.
        """
        group, axes = self._plan.exactly(names), f"axes {', '.join(sorted(names))}"
        if group is None:
            raise NotSupported(
                f"{axes} are not exactly the members of one group", remedy="configure a [[bus.group]] of these axes"
            )
        if not self._usable(group):
            raise _barred(
                f"{axes} are in no [[bus.group]], and no packet starts everybody", self.start_barred, "these axes"
            )
        return group

    # -- steps -------------------------------------------------------------------------------------------------------

    def _usable(self, group: Group) -> bool:
        return group.address != EVERYBODY or not self.start_barred

    def _quiet_s(self, groups: list[Group]) -> float:
        """Return how long the line rests after a burst: a servo cycle, and replies of leaders, which are not read."""
        # status byte and checksum of each: bring-up has drives add nothing to their replies
        leaders = sum(group.leader is not None for group in groups)
        return (
            commands.group_quiet_s(self._rate.cycle_s) + 2 * leaders * self._bus.settings.bits_per_byte / self._bus.baud
        )

    def _untold(self, members: frozenset[str]) -> list[str]:
        """Return the axes whose drives have to be told their groups before these may be started together."""
        if not self.proven:
            return list(self._drives)  # any of them may be in the group of these
        return [name for name in sorted(members) if self._drives[name].spec.address in self._addressing.untold]

    async def _prove(self, members: frozenset[str]) -> None:
        """Tell drives their groups again that are not known to have heard that from this daemon.

        Raises:
            ReplyTimeout: one does not acknowledge it.
        """
        for name in self._untold(members):
            if not await self._addressing.regroup(self._drives[name].spec.address):
                raise ReplyTimeout(f"axis {name}: the drive does not take its group address", axis=name)
        self.proven = True

    async def _ready(self, name: str) -> StatusPacket:
        """Read a drive that is about to be started.

        Raises:
            DriveFault: its loop is open.
        """
        status = await self._read(name, READY_ITEMS)
        if status.aux is None or not status.aux & AuxFlag.SERVO_ON:
            raise DriveFault(f"axis {name}: its loop is open, so the group was not started", axis=name)
        if not status.flags & StatusFlag.MOVE_DONE:
            raise WrongState(f"axis {name} moves already, so the group was not started", axis=name)
        return status

    async def _start_proven(
        self, what: str, group: Group, start: Awaitable[object], stuck: Callable[[], Awaitable[list[str]]]
    ) -> None:
        """Send the packet that starts a group, and have all stopped unless every drive proves that it has started.

        Args:
            what: it is, in words.
            group: which.
            start: sends the packet.
            stuck: returns who has not started.

        Raises:
            OutcomeUnknown: that was not proven.
            RequestRefused: when the turn of the packet came it was not sent.
        """
        sent = False
        try:
            await start
            sent = True
            if not (late := await stuck()):
                for name in group.members:
                    self._drives[name].started()
                return
            why = f"{', '.join(late)} did not start"
            cause = None
        except asyncio.CancelledError:  # nobody waits for the outcome any more, and the packet may be out
            await self._stop_all(group)
            raise
        except LdcndError as error:  # also a stop of one member that came between
            if isinstance(error, RequestRefused) and not sent:
                raise
            why = f"{error.message}; not all axes are known to have started"
            cause = error
        await self._stop_all(group)
        raise OutcomeUnknown(
            f"{what}: {why}, so all were commanded to stop", remedy="read the axis states before anything else"
        ) from cause

    async def _start_motion(self, group: Group) -> None:
        """Start Motion, once; a leader's reply proves that the packet was understood, and its loss proves nothing."""
        if group.leader is None:
            await self._bus.execute(
                commands.start_motion(commands.LeaderlessGroup(group.address, cycle_s=self._rate.cycle_s))
            )
            return
        leader = self._drives[group.leader]
        # a leader that has received it damaged speaks for itself only: the others may have started
        await self._bus.execute(commands.start_motion(Node(group.address, leader.profile)), once=True)

    async def _start_walking(self, group: Group) -> None:
        """Start Path, once."""
        profile = self._drives[min(group.members)].profile
        if group.leader is None:
            node = commands.LeaderlessGroup(group.address, profile, self._rate.cycle_s)
            await self._bus.execute(commands.start_path(node))
        else:
            await self._bus.execute(commands.start_path(Node(group.address, profile)), once=True)

    async def _started(self, name: str, motion: CountsMotion, came_from: int) -> bool:
        """Tell from the drive's status whether it has set out, or has arrived already."""
        status = await self._read(name, READY_ITEMS)
        if not status.flags & StatusFlag.MOVE_DONE:
            return True
        # in velocity mode it is clear only "when accelerating from one velocity to the next" (manuals, status byte)
        if motion.target_counts is None:
            return bool(status.velocity)
        is_at = self._counts(name, status)
        # so short that it was over before it was read: then it is nearer to its target than to where it began
        return abs(is_at - motion.target_counts) <= abs(is_at - came_from)

    async def _stop_all(self, group: Group) -> None:
        """Stop every member, first together, then each by itself; what fails is logged, the rest goes on."""
        try:
            await self.stop(StopMode.SMOOTH, group.members)
        except BusError as error:
            log.error("group stop not sent", bus=self._bus.settings.name, reason=error.message)
        async with asyncio.TaskGroup() as stops:
            for name in sorted(group.members):
                stops.create_task(self._stop_one(name), name=f"stop {name}")

    async def _stop_one(self, name: str) -> None:
        try:
            await self._drives[name].stop(StopMode.SMOOTH)
        except BusError as error:
            log.error("stop not confirmed", axis=name, reason=error.message)

    def _counts(self, name: str, status: StatusPacket) -> int:
        """Return a position in counts since the reset of the drive."""
        return (status.position or 0) + self._drives[name].state.offset_counts

    async def _captured(self, module: IoModule, before: IoStatus) -> CapturedInputs:
        """Read what a PIC-I/O has captured; only a count that runs proves that it was this time."""
        status = await module.captured()
        levels, counter = status.captured_levels or 0, status.captured_counter or 0
        return CapturedInputs(
            module=module.name,
            levels=tuple(bool(levels & 1 << bit) for bit in range(LINES)),
            counter=counter,
            proven=counter != before.captured_counter,
        )

    async def _frozen(self, name: str) -> StatusPacket:
        return await self._read(name, FROZEN_ITEMS)

    async def _read(self, name: str, items: StatusItem) -> StatusPacket:
        drive = self._drives[name]
        return await self._bus.execute(commands.read_status(Node(drive.spec.address, drive.profile), items))


def _barred(what: str, why: str, axes: str) -> NotSupported:
    """Return the refusal of what would need a packet to everybody, with what to do about it."""
    again = ', or restart the daemon with start = "reset"' if why is TAKEN_OVER else ""
    return NotSupported(f"{what}: {why}", remedy=f"put {axes} into a [[bus.group]]{again}")
