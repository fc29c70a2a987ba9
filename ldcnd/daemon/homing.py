"""A search for the reference position: what to look for, how far, how long, and what then."""

from dataclasses import dataclass

from ldcnd.axis_config import AxisConfig, HomeConfig
from ldcnd.drivers.driver import AxisDriver, StopMode
from ldcnd.drivers.scaling import Scale
from ldcnd.errors import MalformedRequest, NotSupported
from ldcnd.model.requests import HomeMethod, HomeRequest, HomeStop

DEFAULT_TIMEOUT_S = 60.0
STOPS = {HomeStop.SMOOTH: StopMode.SMOOTH, HomeStop.ABRUPT: StopMode.ABRUPT, HomeStop.OFF: StopMode.OFF}


@dataclass(frozen=True, slots=True)
class HomeSearch:
    """One search.

    Attributes:
        method: what marks the reference position.
        velocity: units a second, signed.
        acceleration: units a second squared; None for the axis default.
        position: what the position is called there, in axis units.
        timeout_s: when to give up.
        distance: how far it may go, in axis units; None for as far as the velocity goes in that time.
        stop: how the motor stops there.
        move_to: where to go afterwards, in axis units; None stays.
        active_high: level of a limit switch input while the switch is actuated.
    """

    method: HomeMethod
    velocity: float
    acceleration: float | None
    position: float
    timeout_s: float
    distance: float | None
    stop: StopMode
    move_to: float | None
    active_high: bool

    def runs_onto_switch(self, scale: Scale) -> bool:
        """Tell whether the search moves towards the limit switch that it looks for."""
        forward = scale.to_counts(self.velocity) > 0
        return self.method is (HomeMethod.FORWARD_LIMIT if forward else HomeMethod.REVERSE_LIMIT)


def plan_search(config: AxisConfig, driver: AxisDriver, request: HomeRequest) -> HomeSearch:
    """Complete a request from the axis's configuration.

    Raises:
        MalformedRequest: neither says how to search, or it contradicts itself.
        NotSupported: the drive cannot capture on that.
    """
    preset = config.home
    method = request.method or (preset.method if preset else None)
    velocity = request.velocity if request.velocity is not None else (preset.velocity if preset else None)
    if method is None or velocity is None:
        missing = "method" if method is None else "velocity"
        raise MalformedRequest(
            f"axis {config.name}: home needs a {missing}; neither the request nor the configuration has one",
            axis=config.name,
            remedy=f"send {missing}, or configure [bus.axis.home]",
        )
    if method not in driver.home_methods:
        raise NotSupported(
            f"axis {config.name}: {config.model} cannot home on {method}; it can on"
            f" {', '.join(sorted(driver.home_methods))}",
            axis=config.name,
            value=method.value,
        )
    defaults = preset or HomeConfig(method=method, velocity=velocity, timeout_s=DEFAULT_TIMEOUT_S)
    stop = request.stop or defaults.stop
    move_to = request.move_to if request.move_to is not None else defaults.move_to
    if stop is HomeStop.OFF and move_to is not None:
        raise MalformedRequest(
            f"axis {config.name}: home cannot both open the loop and move to {move_to:g} afterwards",
            axis=config.name,
            remedy="leave out move_to, or stop otherwise",
        )
    return HomeSearch(
        method=method,
        velocity=velocity,
        acceleration=request.acceleration,
        position=request.position if request.position is not None else defaults.position,
        timeout_s=request.timeout_s or defaults.timeout_s,
        distance=request.distance or defaults.distance,
        stop=STOPS[stop],
        move_to=move_to,
        active_high=defaults.switch_active == "high",
    )
