"""A raw duty on the motor for a limited time, then a controlled stop.

Nothing in these drives bounds a duty: if this daemon dies, the motor runs on. That is why the time must be named and
the axis must be configured for it.
"""

import math

from typing_extensions import override

from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import LATENCY_S
from ldcnd.axis.procedures.endless import WATCH_S, EndlessMotion
from ldcnd.axis.status import Completion
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.commands import CommandReply, SetPwm
from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import StopMode


class PwmRun(EndlessMotion):
    """One duty, from the request to the stop that ends it."""

    def __init__(self, motion: AxisMotion, permit: Permit, request: SetPwm) -> None:
        super().__init__(motion, permit)
        self._request = request
        self._begun = False
        self._seen: tuple[float, float] | None = None  # the latest velocity, and when it was read
        self._gains: float | None = None  # signed acceleration; not known before two readings of this duty show it

    async def begin(self) -> CommandReply:
        """See `Procedure`. A duty under way may be replaced by another."""
        motion, request = self._motion, self._request
        self.permit.check_state()
        self._check_bounds()
        output = motion.plans.output(request.duty)
        self.acceleration = output.acceleration_counts_per_s2 / abs(motion.scale.counts_per_unit)
        if motion.tracker.status.command is None:
            self.check_room()
        else:
            await self.look_before_change()
        await self.permit.load(output)
        # before the start: if that is not confirmed the motor is stopped all the same
        self._until_s = motion.clock.now_s() + request.duration_s
        self._begun = True
        await motion.start(self.permit, AxisState.CONTINUOUS_MOTION, Completion.PROCEDURE, opens_loop=True)
        duty = math.copysign(output.duty, request.duty)  # a reversed axis has it the other way
        return motion.reply(self.permit, duration_s=request.duration_s, duty=duty)

    @override
    def fastest(self, velocity: float) -> tuple[float, float]:
        """See `EndlessMotion`: what a duty leads to depends on motor and load, so its readings tell.

        Until they do, the velocity of the axis stands for it. A load may overcome it: the axis goes the other way then.
        """
        read_at_s = self._motion.tracker.read_at_s
        if self._seen is None:
            self._seen = (velocity, read_at_s) if self._begun else None
        # a velocity is coarse: two readings that follow each other closely would make any acceleration of it
        elif (took_s := read_at_s - self._seen[1]) >= WATCH_S / 2:
            self._gains = (velocity - self._seen[0]) / took_s
            self._seen = velocity, read_at_s
        if self._gains is None:
            most, soon = max(abs(velocity), self._motion.config.velocity), velocity
        else:
            most = abs(velocity) + abs(self._gains) * LATENCY_S
            soon = velocity + self._gains * LATENCY_S
        forward, backward = max(0.0, velocity, soon), max(0.0, -velocity, -soon)
        return (max(most, forward), backward) if self._request.duty > 0 else (forward, max(most, backward))

    async def step(self) -> bool:
        """See `Procedure`: its time is over, or a limit near; with its switch met, or failed, it is switched off."""
        motion, cut_short = self._motion, self._motion.latest().cut_short
        under_way = motion.tracker.status.is_at(self.permit.command_id)
        mode = await motion.driver.stop(StopMode.SMOOTH if under_way else StopMode.OFF)
        if cut_short and mode is StopMode.OFF and motion.tracker.status.is_at(self.permit.command_id):
            motion.let_go(self.permit, cut_short)
            motion.stop_acknowledged(mode)
        else:
            motion.comes_to_rest(self.permit, mode=mode)
        return False

    def outlived(self, tracker: AxisTracker) -> bool:
        """See `Procedure`; without a command it is unknown whether the motor still runs."""
        return tracker.status.command is not None and super().outlived(tracker)

    def _check_bounds(self) -> None:
        name, bounds, request = self._motion.config.name, self._motion.config.pwm, self._request
        if bounds is None:
            raise NotSupported(
                f"axis {name} is not configured for raw duties", axis=name, remedy="configure [bus.axis.pwm]"
            )
        if abs(request.duty) > bounds.duty:
            raise ValueOutOfRange(
                f"axis {name}: duty {request.duty:g} is above the limit {bounds.duty:g}",
                axis=name,
                value=request.duty,
                limit=bounds.duty,
                nearest=bounds.duty if request.duty > 0 else -bounds.duty,
            )
        if request.duration_s > bounds.duration_s:
            raise ValueOutOfRange(
                f"axis {name}: {request.duration_s:g} s of duty is above the limit {bounds.duration_s:g} s",
                axis=name,
                value=request.duration_s,
                limit=bounds.duration_s,
                nearest=bounds.duration_s,
            )
