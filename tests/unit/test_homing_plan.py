"""What a homing request becomes, and which bounds of the special modes the configuration takes."""

import pytest
from pydantic import ValidationError

from ldcnd.axis.procedures.home import plan_search, runs_onto_switch
from ldcnd.contract.commands import Home, HomeMethod, HomeStop
from ldcnd.contract.errors import MalformedRequest, NotSupported
from ldcnd.drives.axis_config import AxisConfig

PRESET = {
    "method": "reverse_limit",
    "velocity": -5.0,
    "position": 3.0,
    "distance": 40.0,
    "stop": "abrupt",
    "move_to": 1,
}


class _Drive:
    """All that planning asks of a driver."""

    home_methods = frozenset({HomeMethod.INDEX, HomeMethod.REVERSE_LIMIT})
    capture_s = 0.000512

    async def captured_home(self):
        raise NotImplementedError

    def stands_on(self, limit, reading):
        raise NotImplementedError


def axis(**more):
    return AxisConfig.model_validate(
        {
            "name": "x",
            "address": 1,
            "model": "ls-182ap",
            "unit": "mm",
            "counts_per_unit": 1000,
            "velocity": 20,
            "acceleration": 200,
            "gains": {"kp": 350, "el": 4000},
        }
        | more
    )


def planned(request, **more):
    return plan_search(axis(**more), _Drive(), request)


def test_what_a_request_leaves_out_comes_from_the_configuration():
    search = planned(Home(), home=PRESET)

    assert (search.method, search.velocity, search.position) == (HomeMethod.REVERSE_LIMIT, -5.0, 3.0)
    assert (search.distance, search.stop, search.move_to, search.timeout_s) == (40.0, HomeStop.ABRUPT, 1.0, 60.0)
    assert search.switch_active == "high"


def test_what_a_request_says_goes_before_the_configuration():
    request = Home(method="index", velocity=1.0, position=0.0, timeout_s=5, distance=2, stop="smooth", move_to=0.0)

    search = planned(request, home=PRESET)

    assert (search.method, search.velocity, search.position) == (HomeMethod.INDEX, 1.0, 0.0)
    assert (search.distance, search.stop, search.move_to, search.timeout_s) == (2.0, HomeStop.SMOOTH, 0.0, 5.0)


@pytest.mark.parametrize(("request_", "missing"), [(Home(velocity=1.0), "method"), (Home(method="index"), "velocity")])
def test_a_search_without_method_or_velocity_says_which_is_missing(request_, missing):
    with pytest.raises(MalformedRequest, match=f"needs a {missing}"):
        planned(request_)


def test_a_capture_that_the_drive_lacks_is_refused_with_those_it_has():
    with pytest.raises(NotSupported, match="it can on index, reverse_limit"):
        planned(Home(method="current", velocity=1.0))


@pytest.mark.parametrize(
    ("method", "velocity", "reverse", "onto"),
    [
        ("reverse_limit", -1.0, False, True),
        ("reverse_limit", 1.0, False, False),
        ("forward_limit", 1.0, False, True),
        ("forward_limit", 1.0, True, False),
        ("reverse_limit", 1.0, True, True),
        ("index", 1.0, False, False),
    ],
)
def test_limit_switches_are_those_of_the_drive_whatever_the_axis_calls_forward(method, velocity, reverse, onto):
    drive = _Drive()
    drive.home_methods = frozenset(HomeMethod)
    search = plan_search(axis(), drive, Home(method=method, velocity=velocity))

    assert runs_onto_switch(search, -1000 if reverse else 1000) is onto


def test_a_tracking_step_that_would_trip_the_drive_is_no_configuration():
    with pytest.raises(ValidationError, match=r"tracking.step is 4000 counts, not below gains.el 4000"):
        axis(tracking={"step": 4.0, "rate": 10})

    assert axis(tracking={"step": 3.9, "rate": 10}).tracking.rate == 10


def test_tracking_that_outruns_the_velocity_limit_is_no_configuration():
    with pytest.raises(ValidationError, match=r"tracking.step x rate 30 mm/s is above limits.velocity 25 mm/s"):
        axis(tracking={"step": 3.0, "rate": 10}, limits={"velocity": 25})


@pytest.mark.parametrize("duty", [0.0, 1.1])
def test_a_duty_bound_is_a_share(duty):
    with pytest.raises(ValidationError):
        axis(pwm={"duty": duty})
