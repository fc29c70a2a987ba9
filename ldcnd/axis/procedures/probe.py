"""A probe: a move that the drive ends at an input, and the position that it has latched there.

The drive's home capture latches (manuals, "Set Homing Mode"); the reference of the axis stays as it is. The move has a
target, so it ends in the drive also when no input comes and this host is dead.
"""

import math

from ldcnd.axis import guards
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.axis.plans import MotionPlan
from ldcnd.axis.procedure import Procedure
from ldcnd.axis.status import Completion
from ldcnd.axis.unmoved import homing
from ldcnd.contract.commands import CommandReply, HomeMethod, Probe, ProbeStop
from ldcnd.contract.errors import MalformedRequest, NotSupported, VelocityLimit
from ldcnd.contract.samples import AxisState, LatchSample
from ldcnd.drives.driver import AxisReading, HomeCapture, StopMode

INDEX_SHARE = 0.75
"""Highest velocity as a fraction of that at which an index pulse lasts one servo cycle: shafts turn unevenly."""
STOPS = {ProbeStop.SMOOTH: StopMode.SMOOTH, ProbeStop.ABRUPT: StopMode.ABRUPT}


class ProbeMove(Procedure):
    """One such move; its only step is to read what was latched, or to say that nothing was."""

    def __init__(self, motion: AxisMotion, permit: Permit, request: Probe) -> None:
        self.permit = permit
        self._motion = motion
        self._request = request
        self._stop = STOPS[request.stop]
        self._error_counts = 0.0
        self._methods = tuple(HomeMethod(source) for source in request.sources)
        self._ahead = HomeMethod.FORWARD_LIMIT

    async def begin(self) -> CommandReply:
        """See `Procedure`.

        Raises:
            MalformedRequest: not exactly one of position and distance.
            NotSupported: the drive cannot latch on one of the sources.
            VelocityLimit: the index could be missed at this velocity.
        """
        motion = self._motion
        self.permit.check_state()
        self._check_sources()
        here = (await motion.read()).position_counts  # one reading alone may be wrong
        self.permit.still_wanted()
        self.permit.check_state()
        plan = self._plan(here)
        if HomeMethod.INDEX in self._methods:
            width = motion.config.home.index_width if motion.config.home else 1
            check_index_is_seen(motion, plan, width)
        target = plan.motion.target_counts or 0
        speed = plan.motion.velocity_counts_per_s
        # it is latched at the next servo cycle, and a count is no less than one
        self._error_counts = speed * homing(motion.driver).capture_s + 1
        self._ahead = HomeMethod.FORWARD_LIMIT if target > here else HomeMethod.REVERSE_LIMIT
        first, *others = self._methods
        capture = HomeCapture(first, self._stop, also=frozenset(others), guarded=True)
        await self.permit.load(plan.motion, home=capture)
        # what it is to meet may stop it before it is latched
        follows = HomeMethod.CURRENT not in self._methods
        await motion.start(self.permit, AxisState.DISCRETE_MOTION, Completion.PROCEDURE, plan=plan, follows=follows)
        return motion.reply(self.permit, plan)

    def calls_for_step(self, reading: AxisReading) -> bool:
        """See `Procedure`: something was latched, or the move has ended without."""
        return not reading.homing or (reading.profile_done and self._motion.tracker.status.at_rest)

    async def step(self) -> bool:
        """See `Procedure`: take what was latched; a drive that does not stop by itself is stopped here."""
        motion, reading = self._motion, self._motion.latest()
        await motion.driver.stop(self._stop if reading.captured else StopMode.SMOOTH)
        if not reading.captured:
            motion.comes_to_rest(self.permit, "no input came on the way")
            return False
        latched = await homing(motion.driver).captured_home()
        self.permit.still_wanted()
        if HomeMethod.CURRENT in self._methods:
            await motion.driver.clear_warnings()
        if self._ahead not in self._methods and homing(motion.driver).stands_on(self._ahead, reading):
            motion.comes_to_rest(self.permit, f"the drive stopped at the {self._ahead.value.replace('_', ' ')} switch")
            return False
        now_ns = motion.clock.now_ns()
        motion.telemetry.publish_latch(
            LatchSample(
                t=now_ns,
                t_error_ns=0,
                seq=0,
                quality=motion.tracker.status.quality,
                value=motion.scale.shown_at(latched),
                unit=motion.config.unit,
                counts=latched,
                error=self._error_counts / abs(motion.scale.counts_per_unit),
                sources=tuple(source.value for source in self._request.sources),
                command_id=self.permit.command_id,
            )
        )
        motion.comes_to_rest(self.permit)
        return False

    def _check_sources(self) -> None:
        motion = self._motion
        lacking = [method.value for method in self._methods if method not in homing(motion.driver).home_methods]
        if lacking:
            able = sorted(method.value for method in homing(motion.driver).home_methods - {HomeMethod.POSITION_ERROR})
            raise NotSupported(
                f"axis {motion.config.name}: {motion.config.model} cannot latch on {', '.join(lacking)}; it can on"
                f" {', '.join(able)}",
                axis=motion.config.name,
                value=lacking[0],
            )

    def _plan(self, here_counts: int) -> MotionPlan:
        """Plan the move as far as it goes when no input comes."""
        motion, request = self._motion, self._request
        match request.position, request.distance:
            case float() as position, None:
                guards.check_referenced(motion.tracker)
                position = motion.plans.unwrapped(position)
            case None, float() as distance:
                position = motion.scale.position(here_counts) + distance
            case _:
                raise MalformedRequest(
                    f"axis {motion.config.name}: a probe needs exactly one of position and distance",
                    axis=motion.config.name,
                )
        return motion.plans.to(position, request.velocity, request.acceleration)


def check_index_is_seen(motion: AxisMotion, plan: MotionPlan, width: int) -> None:
    """Refuse a search that the index pulse can slip through: the drive looks once in a servo cycle.

    LS-182AP manual, "Encoder Input": the velocity has "to guarantee index pulse longer then 512us".

    Args:
        motion: of the axis.
        plan: of the search.
        width: counts for which the pulse lasts.

    Raises:
        VelocityLimit: names the nearest velocity at which no pulse is missed.
    """
    sample_s = homing(motion.driver).capture_s
    if not sample_s:
        return
    limit = INDEX_SHARE * width / sample_s / abs(motion.scale.counts_per_unit)
    if abs(plan.velocity) > limit:
        raise VelocityLimit(
            f"axis {motion.config.name}: at {abs(plan.velocity):g} {motion.config.unit}/s the drive can miss an index"
            f" pulse of {width} counts: it looks every {1000 * sample_s:g} ms",
            axis=motion.config.name,
            value=plan.velocity,
            limit=limit,
            nearest=math.copysign(math.floor(limit * 1e6) / 1e6, plan.velocity),
            remedy="search more slowly, or configure index_width if the pulse is wider",
        )
