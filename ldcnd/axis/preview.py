"""What a motion would do: planned as the motion itself, and nothing is sent."""

from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.plans import MotionPlan, both_s
from ldcnd.contract.codec import error_reply
from ldcnd.contract.errors import MalformedRequest, RequestRefused
from ldcnd.contract.questions import Preview, PreviewReply
from ldcnd.line.bus import Bus


def preview(motion: AxisMotion, bus: Bus, request: Preview, obstacles: tuple[str, ...]) -> PreviewReply:
    """Plan a motion without sending anything.

    Args:
        motion: of the axis.
        bus: its line.
        request: the motion.
        obstacles: the other obstacles now.

    Raises:
        MalformedRequest: it does not say which motion is meant.
        WrongState: the position has not been read yet.
    """
    name = motion.config.name
    try:
        plan = _plan(motion, request)
        ends = motion.plans.run(None, plan)[1] if plan.position is None else None
        first = motion.plans.before_approach(plan, request.velocity, request.acceleration)
    except MalformedRequest:
        raise
    except RequestRefused as error:
        return PreviewReply(axis=name, refusal=error_reply(error), obstacles=obstacles)
    legs = [leg for leg in (first, plan) if leg]
    exchanges = [each for leg in legs for sent in motion.driver.exchanges(leg.motion) for each in (sent,) * sent.times]
    full_velocity = motion.config.velocity if request.velocity is None else request.velocity
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


def _plan(motion: AxisMotion, request: Preview) -> MotionPlan:
    match request.position, request.distance, request.velocity:
        case float() as position, None, velocity:
            return motion.plans.to(motion.plans.unwrapped(position, request.direction), velocity, request.acceleration)
        case None, float() as distance, velocity:
            return motion.plans.by(distance, velocity, request.acceleration)
        case None, None, float() as velocity:
            return motion.plans.at(velocity, request.acceleration)
    raise MalformedRequest(
        f"axis {motion.config.name}: a plan needs exactly one of position, distance, or velocity alone",
        axis=motion.config.name,
    )
