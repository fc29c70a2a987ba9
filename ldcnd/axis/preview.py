"""What a motion would do: planned as the motion itself, and nothing is sent."""

from dataclasses import replace

from ldcnd.axis import guards
from ldcnd.axis.gains import AxisGains
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.plans import MotionPlan, both_s
from ldcnd.contract.codec import error_reply
from ldcnd.contract.commands import kind_of
from ldcnd.contract.errors import MalformedRequest, RequestRefused
from ldcnd.contract.questions import Preview, PreviewReply
from ldcnd.line.bus import Bus


def preview(
    motion: AxisMotion, gains: AxisGains, bus: Bus, request: Preview, obstacles: tuple[str, ...]
) -> PreviewReply:
    """Plan a motion without sending anything.

    Args:
        motion: of the axis.
        gains: of the axis.
        bus: its line.
        request: the motion.
        obstacles: the other obstacles now.

    Raises:
        MalformedRequest: it does not say which motion is meant.
        WrongState: the position has not been read yet.
    """
    name, plans = motion.config.name, motion.plans
    full_velocity = motion.config.velocity if request.velocity is None else request.velocity
    goes_on = guards.goes_on(request.motion, motion.tracker)
    try:
        plan = loaded = _plan(motion, request, goes_on=goes_on)
        first = plans.before_approach(plan, request.velocity, request.acceleration)
        ends: str | None = None
        if plan.position is None:
            in_motion = (
                goes_on
                and motion.driver.retargets
                and plans.follows_on(plan.motion.acceleration_counts_per_s2, None)  # it is halted first else
            )
            end, ends = plans.run(None, plan, in_motion=in_motion)
            # the drive is given this end, too, unless it goes on from another velocity and takes no new goal in motion
            if motion.driver.retargets or not goes_on:
                loaded = plans.to(end, abs(full_velocity), request.acceleration)
        here = motion.latest()
        # a motion that does not follow another begins from rest, with the gains of its kind
        due = None if goes_on else gains.loaded_before(kind_of(request.motion))
        here = here if goes_on else replace(here, velocity_counts_per_s=0.0)
        sent = motion.driver.exchanges([each.motion for each in (first, loaded) if each], here, due)
    except MalformedRequest:
        raise
    except RequestRefused as error:
        return PreviewReply(axis=name, refusal=error_reply(error), obstacles=obstacles)
    exchanges = [each for once in sent for each in (once,) * once.times]
    asked_velocity = full_velocity * motion.tracker.status.speed_share
    asked_acceleration = motion.config.acceleration if request.acceleration is None else request.acceleration
    return PreviewReply(
        axis=name,
        refusal=None,
        obstacles=obstacles,
        position=motion.plans.shown(plan.position),
        approach_from=motion.plans.shown(first.position) if first else None,
        ends=ends,
        velocity=plan.velocity,
        velocity_error=plan.velocity - asked_velocity,
        acceleration=plan.acceleration,
        acceleration_error=plan.acceleration - asked_acceleration,
        duration_s=both_s(first, plan) if first else plan.duration_s,
        packets=tuple(exchange.request.hex(" ") for exchange in exchanges),
        bus_s=sum(bus.longest_s(exchange) for exchange in exchanges),
    )


def _plan(motion: AxisMotion, request: Preview, *, goes_on: bool) -> MotionPlan:
    match request.position, request.distance, request.velocity:
        case float() as position, None, velocity:
            return motion.plans.to(motion.plans.unwrapped(position, request.direction), velocity, request.acceleration)
        case None, float() as distance, velocity:
            return motion.plans.by(distance, velocity, request.acceleration)
        case None, None, float() as velocity:
            return motion.plans.at(velocity, request.acceleration, in_motion=goes_on)
    raise MalformedRequest(
        f"axis {motion.config.name}: a plan needs exactly one of position, distance, or velocity alone",
        axis=motion.config.name,
    )
