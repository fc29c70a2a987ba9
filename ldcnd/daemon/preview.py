"""What a motion would do, worked out by the very code that would do it, and not done."""

from ldcnd.bus.bus import Bus
from ldcnd.daemon.axis_motion import AxisMotion
from ldcnd.daemon.motion_plan import MotionPlan
from ldcnd.errors import MalformedRequest, RequestRefused
from ldcnd.messaging.codec import error_reply
from ldcnd.model.preview import PlanReply, PlanRequest


def preview(motion: AxisMotion, bus: Bus, request: PlanRequest, obstacles: tuple[str, ...]) -> PlanReply:
    """Plan a motion without sending anything.

    Args:
        motion: of the axis.
        bus: its line.
        request: what is asked.
        obstacles: what else is in the way now.

    Raises:
        MalformedRequest: it does not say which motion is meant.
        WrongState: the position has not been read yet.
    """
    name = motion.config.name
    try:
        plan = _plan(motion, request)
    except MalformedRequest:
        raise
    except RequestRefused as error:
        return PlanReply(axis=name, refusal=error_reply(error), obstacles=obstacles)
    exchanges = motion.driver.exchanges(plan.motion)
    asked_velocity = motion.config.velocity if request.velocity is None else request.velocity
    asked_acceleration = motion.config.acceleration if request.acceleration is None else request.acceleration
    return PlanReply(
        axis=name,
        refusal=None,
        obstacles=obstacles,
        position=plan.position,
        velocity=plan.velocity,
        velocity_error=plan.velocity - asked_velocity,
        acceleration=plan.acceleration,
        acceleration_error=plan.acceleration - asked_acceleration,
        duration_s=plan.duration_s,
        packets=tuple(exchange.request.hex(" ") for exchange in exchanges),
        bus_s=sum(bus.longest_s(exchange) for exchange in exchanges),
    )


def _plan(motion: AxisMotion, request: PlanRequest) -> MotionPlan:
    match request.position, request.distance, request.velocity:
        case float() as position, None, velocity:
            return motion.plan_to(position, velocity, request.acceleration)
        case None, float() as distance, velocity:
            here = motion.telemetry.position(motion.latest().position_counts)
            return motion.plan_to(here + distance, velocity, request.acceleration)
        case None, None, float() as velocity:
            return motion.planner.at_velocity(motion.tracker.view(), velocity, request.acceleration)
    raise MalformedRequest(
        f"axis {motion.config.name}: a plan needs exactly one of position, distance, or velocity alone",
        axis=motion.config.name,
    )
