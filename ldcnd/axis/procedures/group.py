"""One axis's share of a group move, and where the members wait for each other.

Every member goes through its own axis's queue and guards like any other command, and holds its turn until all the
others have arrived; then the line starts them together, or none of them moves.
"""

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Mapping

from typing_extensions import override

from ldcnd.axis.events import CommandOver, MotionStarted, StopDue
from ldcnd.axis.joint_starts import start_together
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import MotionPlan
from ldcnd.axis.procedure import Procedure
from ldcnd.axis.status import Completion
from ldcnd.axis.straight import straight_line
from ldcnd.contract.commands import CommandReply, MoveAbsolute, Verb
from ldcnd.contract.errors import LdcndError, OutcomeUnknown, ValueOutOfRange, WrongState
from ldcnd.contract.rig_commands import MoveTogetherReply
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import AxisReading, StopMode
from ldcnd.drives.network import Network

NOT_AS_ONE = "sent because its group was not started as one"
MEETING_S = 2.0
"""Longest wait for the turns of all members, seconds; one that has not got it by then keeps the group from moving."""


def cut_short() -> OutcomeUnknown:
    """Return the end of a start that was cancelled: for those who have announced a motion the readings tell."""
    return OutcomeUnknown(
        "the start of several axes was cut short, so all were commanded to stop",
        remedy="read the axis states before anything else",
    )


class GroupMoveRequest(MoveAbsolute):
    """One member's share of a group move; made by the daemon, never read from the network."""

    _rendezvous: "Meeting"

    @classmethod
    def of(cls, move: MoveAbsolute, meeting: "Meeting") -> "GroupMoveRequest":
        """Return the share of an axis."""
        request = cls(**move.model_dump())
        request._rendezvous = meeting
        return request

    @property
    def rendezvous(self) -> "Meeting":
        """Where the members wait for each other."""
        return self._rendezvous


def plans_on_line(
    axes: Mapping[str, tuple[AxisMotion, MotionPlan]], max_deviation: float | None
) -> tuple[dict[str, MotionPlan], float]:
    """Return the plans of moves that keep to a straight line, and how far from it they get, in axis units.

    Args:
        axes: and what each of them would do by itself.
        max_deviation: from the line; None for any.

    Raises:
        ValueOutOfRange: they would get farther from the line than that.
    """
    line = straight_line({name: motion.plans.on_line(plan) for name, (motion, plan) in axes.items()})
    if max_deviation is not None and line.deviation > max_deviation:
        raise ValueOutOfRange(
            f"axes {', '.join(sorted(axes))} would leave the line by {line.deviation:.4g}, more than {max_deviation:g}",
            value=line.deviation,
            limit=max_deviation,
            remedy="move more slowly, or allow more",
        )
    return {
        name: motion.plans.replanned(plan, line.motions[name]) for name, (motion, plan) in axes.items()
    }, line.deviation


class Rendezvous(ABC):
    """Where the members of one motion wait until all have their turns, and where it is started once.

    Equal to another one that was asked for alike: so a request that comes again is known by the ids of its shares.
    """

    def __init__(self, names: frozenset[str], *asked: object) -> None:
        self._asked = (names, *asked)
        self._missing = set(names)
        self._met = asyncio.Event()  # all have come, or one cannot
        self._started: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._started.add_done_callback(_retrieve)

    @override
    def __eq__(self, other: object) -> bool:
        return isinstance(other, Rendezvous) and type(self) is type(other) and self._asked == other._asked

    @override
    def __hash__(self) -> int:
        return hash(self._asked)

    @property
    def failure(self) -> BaseException | None:
        """The first error that kept the axes from moving."""
        return self._started.exception() if self._started.done() else None

    def fail(self, error: LdcndError) -> None:
        """Keep the axes from moving: a member cannot; without effect once they were started."""
        if not self._started.done():
            self._started.set_exception(error)
        self._met.set()

    async def _arrived(self, name: str) -> None:
        """Wait for the others, or start all as the last one.

        Only the wait for the others has a limit. From then on the bus bounds each packet, and the outcome of the start
        is the outcome of every member: a slow line must not have some of them report that none was started.
        """
        self._missing.discard(name)
        if not self._missing and not self._started.done():
            # the others no longer count the time: from here on the line bounds it
            self._met.set()
            await self._start()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(MEETING_S):
                await self._met.wait()
        if self._missing:
            self.fail(
                WrongState(
                    f"axes {', '.join(sorted(self._missing))} did not get their turn within {MEETING_S:g} s, so no axis"
                    " was started"
                )
            )
        # for a caller that gives up nothing is cancelled: the others wait for the same
        await asyncio.shield(self._started)

    @abstractmethod
    async def _start(self) -> None:
        """Start all members, or fail."""


class Meeting(Rendezvous):
    """Where the members of one group move meet.

    Attributes:
        deviation: how far from a straight line they get; None until they are started, and when they keep to none.
    """

    def __init__(
        self, network: Network, names: frozenset[str], *, straight: bool = False, max_deviation: float | None = None
    ) -> None:
        """Wait for these axes.

        Args:
            network: of their line.
            names: of the members.
            straight: they keep to a straight line.
            max_deviation: the line is refused if they would leave it by more, in axis units.
        """
        super().__init__(names, straight, max_deviation)
        self.deviation: float | None = None
        self._network = network
        self._straight = straight
        self._max_deviation = max_deviation
        self._members: dict[str, GroupMember] = {}

    def reply(self, replies: tuple[CommandReply, ...]) -> MoveTogetherReply:
        """Return the reply to the command whose members were answered so."""
        return MoveTogetherReply(replies=replies, deviation=self.deviation)

    async def join(self, name: str, member: "GroupMember") -> None:
        """Wait for the others; return once the drives have started.

        Raises:
            WrongState: another member did not come in time, or refused.
            LdcndError: as `Network.start_group`.
        """
        self._members[name] = member
        await self._arrived(name)

    @override
    async def _start(self) -> None:
        try:
            for member in self._members.values():
                member.make_plan()  # anew: the speed override may be another by now
            if self._straight:
                axes = {name: (member.motion, member.plan) for name, member in self._members.items()}
                plans, self.deviation = plans_on_line(axes, self._max_deviation)
                for name, member in self._members.items():
                    member.plan = plans[name]
            motions = {name: member.plan.motion for name, member in self._members.items()}
            permits = [member.permit for member in self._members.values()]
            await start_together(self._network, motions, permits, self._about_to_start)
        except LdcndError as error:
            self.fail(error)
        except asyncio.CancelledError:
            self.fail(cut_short())
            raise
        else:
            if not self._started.done():
                self._started.set_result(None)

    def _about_to_start(self) -> None:
        """Say that all of them move, unless one has left."""
        if self._started.done():
            raise WrongState("a member of the group has left, so no axis was started")
        for member in self._members.values():
            member.announce()


class GroupMember(Procedure):
    """One axis of a group move; over as soon as the group was started, the readings tell the rest."""

    def __init__(self, motion: AxisMotion, permit: Permit, request: GroupMoveRequest) -> None:
        self.permit = permit
        self.plan: MotionPlan
        self.motion = motion
        self._request = request
        self._announced = False

    async def begin(self) -> CommandReply:
        """See `Procedure`; a member that cannot move keeps the others from moving.

        Raises:
            LdcndError: as `move_absolute`, or because another member could not.
        """
        meeting, motion = self._request.rendezvous, self.motion
        try:
            self.permit.check_state()
            self.make_plan()
            await meeting.join(motion.config.name, self)
        except (LdcndError, asyncio.CancelledError) as error:
            failure = error if isinstance(error, LdcndError) else cut_short()
            meeting.fail(failure)
            self._not_started(failure)
            raise
        own, target = self.permit.command_id, self.plan.motion.target_counts
        motion.tracker.take(MotionStarted(own, motion.clock.now_s(), target, endless=False))
        return motion.reply(self.permit, self.plan)

    def make_plan(self) -> None:
        """Plan the move by limits and the speed override of now.

        Raises:
            RequestRefused: as `move_absolute`.
        """
        self.permit.planned_share = self.motion.tracker.status.speed_share
        position = self.motion.plans.unwrapped(self._request.position, self._request.direction)
        self.plan = self.motion.plans.to(position, self._request.velocity, self._request.acceleration)

    def announce(self) -> None:
        """Say that the axis moves, before its drive does."""
        self._announced = True
        self.permit.announce(self.plan.motion)
        self.motion.begin(
            self.permit.command_id, self.permit.verb, AxisState.DISCRETE_MOTION, Completion.PROFILE, plan=self.plan
        )

    def calls_for_step(self, reading: AxisReading) -> bool:  # noqa: ARG002 - part of the contract
        """See `Procedure`: there are no further steps."""
        return False

    @override
    async def step(self) -> bool:
        return False

    def _not_started(self, error: LdcndError) -> None:
        """Have the axis stopped after an unknown outcome, until its drive confirms that; else it is where it was."""
        motion = self.motion
        if not self._announced:
            return
        if isinstance(error, OutcomeUnknown):
            motion.tracker.take(MotionStarted(self.permit.command_id, motion.clock.now_s(), endless=False))
            motion.tracker.take(StopDue(StopMode.SMOOTH, NOT_AS_ONE, Verb.HALT))
            return
        motion.tracker.take(CommandOver(self.permit.command_id, error.message))
        motion.publish_state()


def _retrieve(started: "asyncio.Future[None]") -> None:
    """Retrieve an error that no member waits for, so that asyncio does not report it."""
    if not started.cancelled():
        started.exception()
