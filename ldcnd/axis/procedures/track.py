"""A stream of set-points that an axis follows without a profile, bounded in step and rate."""

from typing_extensions import override

from ldcnd.axis import guards
from ldcnd.axis.events import CommandOver, MotionStarted
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.procedure import Procedure
from ldcnd.axis.status import Completion
from ldcnd.contract.commands import CommandReply, Track, Verb
from ldcnd.contract.errors import (
    BusError,
    NotSupported,
    OutcomeUnknown,
    RequestRefused,
    TooManyRequests,
    ValueOutOfRange,
)
from ldcnd.contract.samples import AxisState
from ldcnd.drives.axis_config import TrackingConfig
from ldcnd.drives.driver import AxisReading

IDLE_PERIODS = 5
SHORTEST_IDLE_S = 0.5
"""A stream ends after this number of its shortest periods without a set-point, but not sooner than this."""
EARLY = 0.5
"""A set-point may come this share of a period early; the mean rate is kept."""


class SetPoint(Procedure):
    """One set-point; it takes the stream over from the one before it."""

    def __init__(self, motion: AxisMotion, permit: Permit, request: Track, before: Procedure | None) -> None:
        self.permit = permit
        self._motion = motion
        self._request = request
        self._before = before if isinstance(before, SetPoint) and not before.outlived(motion.tracker) else None
        self._due_s = 0.0  # when this one could have come at the configured rate

    async def begin(self) -> CommandReply:
        """See `Procedure`.

        Raises:
            TooManyRequests: faster than the configured rate.
            ValueOutOfRange: farther from the last set-point than the configured step.
        """
        motion, tracker, position = self._motion, self._motion.tracker, self._request.position
        own = self.permit.command_id
        bounds = self._bounds()
        before, self._before = self._before, None  # a stream keeps only its last set-point
        self.permit.check_state()
        guards.check_position(tracker, motion.config.limits, position)
        self._check_rate(before, bounds)
        last = tracker.status.target_counts
        if before is None or last is None:  # it goes there without a profile: its way counts from where it is now
            reading = await motion.read()
            self.permit.check_state()
            if last is None or reading.held_away_counts(last, motion.lags_counts) > motion.window_counts:
                last = reading.position_counts
        target = motion.plans.counts_of(position)
        self._check_step(target, last, bounds)
        self.permit.ask_to_move()
        if tracker.status.command and tracker.status.command.verb is Verb.TRACK:
            tracker.take(CommandOver(tracker.status.command.command_id))  # the stream goes on under the new one's name
        stands_when_done = tracker.status.stands_when_done  # with its command it counts as moving
        motion.begin(own, self.permit.verb, AxisState.CONTINUOUS_MOTION, Completion.PROCEDURE)
        self.deadline_s = motion.clock.now_s() + max(SHORTEST_IDLE_S, IDLE_PERIODS / bounds.rate)
        try:
            await self.permit.track(target, stands_when_done=stands_when_done)
        except OutcomeUnknown:
            # if it was not executed the next set-point is still near enough
            tracker.take(MotionStarted(own, motion.clock.now_s(), target, endless=False))
            raise
        except (BusError, RequestRefused) as error:
            tracker.take(CommandOver(own, error.message))
            motion.publish_state()
            raise
        tracker.take(MotionStarted(own, motion.clock.now_s(), target, endless=False))
        return motion.reply(self.permit, position=motion.scale.shown_at(target))

    @override
    def calls_for_step(self, reading: AxisReading) -> bool:
        return False

    async def step(self) -> bool:
        """See `Procedure`: nothing came any more; the axis holds the last set-point, and says whether it is there."""
        motion = self._motion
        here = (await motion.read()).position_counts  # the latest poll may be of before the last set-point
        off = abs(motion.plans.commanded_counts - here) / abs(motion.scale.counts_per_unit)
        # a loop may be soft; half a step away the drive has not taken what it has acknowledged
        away = off > max(self._bounds().step / 2, motion.window_counts / abs(motion.scale.counts_per_unit))
        said = f"it is {off:.4g} {motion.scale.unit} away from its last set-point: read where it is before you go on"
        motion.tracker.take(CommandOver(self.permit.command_id, said if away else None))
        self._motion.publish_state()
        return False

    def _bounds(self) -> TrackingConfig:
        config = self._motion.config
        if config.tracking is None:
            raise NotSupported(
                f"axis {config.name} is not configured for tracking",
                axis=config.name,
                remedy="configure [bus.axis.tracking]",
            )
        return config.tracking

    def _check_rate(self, before: "SetPoint | None", bounds: TrackingConfig) -> None:
        now_s, period_s = self._motion.clock.now_s(), 1.0 / bounds.rate
        due_s = before._due_s + period_s if before else now_s  # noqa: SLF001 - the same stream
        if now_s < due_s - EARLY * period_s:
            raise TooManyRequests(
                f"axis {self._motion.config.name}: more than {bounds.rate:g} set-points a second",
                axis=self._motion.config.name,
                limit=bounds.rate,
                remedy="send them more slowly",
            )
        # a stream that was late gets no credit for it
        self._due_s = max(due_s, now_s)

    def _check_step(self, target: int, last: int, bounds: TrackingConfig) -> None:
        motion = self._motion
        step = (target - last) / motion.scale.counts_per_unit
        if abs(step) > bounds.step:
            nearest = motion.scale.position(last) + (bounds.step if step > 0 else -bounds.step)
            raise ValueOutOfRange(
                f"axis {motion.config.name}: set-point {self._request.position:g} is {abs(step):g} from the last one,"
                f" the limit is {bounds.step:g}",
                axis=motion.config.name,
                value=self._request.position,
                limit=bounds.step,
                nearest=nearest,
            )
