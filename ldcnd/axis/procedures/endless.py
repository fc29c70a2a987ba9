"""Motions that have no end in the drive: the daemon ends them after a time, and before a software limit.

The limit must hold at any configured poll rate, so such an axis is read often while it moves, and the instant at which
a stop would come too late is worked out anew from every reading: the stop goes out then even if no reading follows.
"""

import math
from abc import abstractmethod

from typing_extensions import override

from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import LATENCY_S
from ldcnd.axis.procedure import Procedure
from ldcnd.axis.tracker import AxisTracker
from ldcnd.axis.trapezoid import braking_way
from ldcnd.contract.errors import PositionLimit
from ldcnd.drives.driver import AxisReading
from ldcnd.line.exchange import NEVER_S

WATCH_S = 0.05
"""Time between two readings while such a motion runs, seconds, whatever the poll rates."""


class EndlessMotion(Procedure):
    """One such motion, from its start to the stop that ends it.

    Attributes:
        acceleration: at which a stop slows it down, in axis units a second squared.
    """

    watch_s = WATCH_S

    def __init__(self, motion: AxisMotion, permit: Permit) -> None:
        self.permit = permit
        self.acceleration = 0.0
        self._motion = motion
        self._until_s = self._stop_at_s = NEVER_S
        self._near = math.inf  # the software limit that `_stop_at_s` is for

    @property
    @override
    def deadline_s(self) -> float:  # type: ignore[override]
        """See `Procedure`: when its time is over, or a stop would come too late before a limit."""
        return min(self._until_s, self._stop_at_s)

    @abstractmethod
    def fastest(self, velocity: float) -> tuple[float, float]:
        """Return how fast it can be until the next reading, forward and backward, both from 0 upwards.

        Args:
            velocity: as the latest reading shows it, in axis units a second.
        """

    def ends_before_limit(self, reading: AxisReading, at_s: float) -> bool:
        """Tell whether it must be stopped now to stand before a software limit; if not, work out by when at last.

        Args:
            reading: where it was.
            at_s: when that was, in loop time: a reading may come late.
        """
        motion, limits = self._motion, self._motion.config.limits
        self._stop_at_s = NEVER_S
        # it does not know where its limits are
        if not motion.tracker.status.referenced:
            return False
        here = motion.scale.position(reading.position_counts)
        forward, backward = self.fastest(reading.velocity_counts_per_s / motion.scale.counts_per_unit)
        spare_s = NEVER_S
        if limits.position_max is not None and forward > 0:
            spare_s, self._near = self._spare_s(limits.position_max - here, forward), limits.position_max
        if limits.position_min is not None and backward > 0:
            behind_s = self._spare_s(here - limits.position_min, backward)
            spare_s, self._near = min((spare_s, self._near), (behind_s, limits.position_min))
        self._stop_at_s = at_s + spare_s
        return self._stop_at_s <= motion.clock.now_s()

    @property
    def _brakes_at(self) -> float:
        """How fast a stop slows it down, in axis units a second squared.

        A change that was loaded and not started, or not heard, may have left a drive under way another rate.
        """
        motion, own = self._motion, self.permit.command_id
        in_force = motion.driver.deceleration_counts_per_s2
        if in_force is None or not motion.tracker.status.is_at(own):
            return self.acceleration
        return min(self.acceleration, in_force / abs(motion.scale.counts_per_unit))

    def _spare_s(self, way: float, speed: float) -> float:
        """Return for how long it can go on at a speed and still be stopped within a way."""
        brakes = speed * LATENCY_S + braking_way(speed, self._brakes_at)
        return (way - brakes) / speed

    async def look_before_change(self) -> None:
        """Read where the axis is by now, check its room, and bound how late the change may still be told its drive.

        What runs until then is ended by its own steps, which wait while packets of the change are tried.

        Raises:
            PositionLimit: see `check_room`.
            RequestRefused, DriveFault: see `Permit.ask_to_move`.
            BusError: the line failed.
        """
        motion = self._motion
        by_s = motion.clock.now_s() + LATENCY_S
        await motion.read()  # the latest reading may be as old as the rates let it be
        self.permit.ask_to_move()
        self.check_room()
        self.permit.by_s = by_s

    def check_room(self) -> None:
        """Refuse a motion that could not be stopped before a software limit, be it the one that it turns away from.

        Raises:
            PositionLimit: there is not enough way left.
        """
        motion, tracker = self._motion, self._motion.tracker
        at_s = motion.clock.now_s() if tracker.status.at_rest else motion.latest_at_s
        if self.ends_before_limit(motion.latest(), at_s):
            here, unit = motion.plans.here, motion.scale.unit
            raise PositionLimit(
                f"axis {tracker.name} is at {here:g} {unit}: its limit {self._near:g} {unit} is too near",
                axis=tracker.name,
                value=here,
                limit=self._near,
                remedy="move the other way, more slowly, or with a higher acceleration",
            )

    @override
    def calls_for_step(self, reading: AxisReading) -> bool:
        """See `Procedure`: a limit is near, the drive has stopped, or the command was lost while out of sight."""
        lost = self._motion.tracker.status.command is None
        at_s = self._motion.tracker.read_at_s
        return self.ends_before_limit(reading, at_s) or lost or bool(reading.cut_short)

    async def step(self) -> bool:
        """See `Procedure`: stop. An axis that has lost its loop meanwhile is switched off instead."""
        await self._motion.end(self.permit, self._motion.latest().cut_short)
        return False

    def outlived(self, tracker: AxisTracker) -> bool:
        """See `Procedure`; without a command the drive may still run until it is seen at rest."""
        return tracker.status.at_rest if tracker.status.command is None else super().outlived(tracker)
