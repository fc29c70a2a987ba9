import re

import pytest

from ldcnd.axis import guards
from ldcnd.axis.faults import STOP_UNCONFIRMED, entry_of
from ldcnd.axis.rest import RestEvidence
from ldcnd.axis.status import OpenStop
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import (
    AccelerationLimit,
    AxisUnreachable,
    NotReferenced,
    PositionLimit,
    StopLatched,
    StopNotConfirmed,
    VelocityLimit,
    WrongState,
)
from ldcnd.contract.meta import AxisLimits
from ldcnd.contract.samples import AxisState, FaultEntry, LinkState
from ldcnd.drives.driver import StopMode
from tests.support.axis_bench import tracked


def ready(*faults: str, **changes: object) -> AxisTracker:
    """Return an axis that stands and is powered, but for what is changed."""
    entries = tuple(FaultEntry(code=text, text=text, since=0, source="drive") for text in faults)
    stands = {"state": AxisState.STANDSTILL, "enabled": True, "referenced": True, "link": LinkState.UP}
    return tracked(faults=entries, **(stands | changes))


READY = ready()
LIMITS = AxisLimits(position_min=-10, position_max=10, velocity=5, acceleration=50)


def test_an_axis_that_stands_and_is_powered_may_move():
    guards.check(Verb.MOVE_RELATIVE, READY)


@pytest.mark.parametrize(
    ("change", "error", "remedy"),
    [
        ({"link": LinkState.DOWN}, AxisUnreachable, "power"),
        ({"stop_latched": True}, StopLatched, "reset"),
        ({"stop": OpenStop(StopMode.SMOOTH, entry_of(STOP_UNCONFIRMED, 0))}, StopNotConfirmed, "wait"),
        ({"state": AxisState.ERROR_STOP}, WrongState, "reset"),
        ({"state": AxisState.DISABLED, "enabled": False}, WrongState, "power"),
        ({"state": AxisState.DISCRETE_MOTION}, WrongState, "halt"),
        ({"state": AxisState.CONTINUOUS_MOTION}, WrongState, "halt"),
        ({"state": AxisState.HOMING}, WrongState, "wait until it is homed"),
        ({"state": AxisState.STOPPING}, WrongState, "wait until it stands"),
    ],
)
def test_a_refusal_names_the_axis_and_the_way_out(change, error, remedy):
    with pytest.raises(error) as refusal:
        guards.check(Verb.MOVE_RELATIVE, ready(**change))

    assert "axis x" in refusal.value.message
    assert refusal.value.axis == "x"
    assert remedy in refusal.value.remedy


def test_a_faulted_axis_says_what_its_fault_is():
    with pytest.raises(WrongState, match="overheat"):
        guards.check(Verb.MOVE_RELATIVE, ready("overheat", state=AxisState.ERROR_STOP))


SILENT = FaultEntry(code="link_lost", text="the drive does not answer", since=0, source="daemon")


def test_a_fault_that_is_over_is_not_said_to_be_there():
    answers_again = ready(state=AxisState.ERROR_STOP, first_fault=SILENT, rest=RestEvidence(rests=True))

    with pytest.raises(WrongState, match="in error stop because of link lost, which is over") as refusal:
        guards.check(Verb.MOVE_RELATIVE, answers_again)

    assert "does not answer" not in refusal.value.message
    assert refusal.value.remedy == "send reset"


def test_a_fault_of_an_axis_that_is_not_seen_is_not_said_to_be_over():
    with pytest.raises(WrongState, match="in error stop: the drive does not answer") as refusal:
        guards.check_not_in_error(ready(state=AxisState.ERROR_STOP, link=LinkState.DOWN, first_fault=SILENT))

    assert "remove the cause" in refusal.value.remedy


def test_an_unreferenced_axis_takes_no_absolute_target():
    with pytest.raises(NotReferenced) as refusal:
        guards.check_referenced(ready(referenced=False))

    assert "home" in refusal.value.remedy


@pytest.mark.parametrize(("target", "nearest"), [(10.001, 10), (-11, -10)])
def test_a_target_outside_the_limits_names_the_nearest_inside(target, nearest):
    with pytest.raises(PositionLimit) as refusal:
        guards.check_position(READY, LIMITS, target)

    assert (refusal.value.value, refusal.value.limit, refusal.value.nearest) == (target, nearest, nearest)
    assert "mm" in refusal.value.message


def test_the_limits_themselves_are_allowed():
    guards.check_position(READY, LIMITS, 10)
    guards.check_position(READY, LIMITS, -10)
    guards.check_velocity(READY, LIMITS, -5)
    guards.check_acceleration(READY, LIMITS, 50)


@pytest.mark.parametrize("beyond", [1e-7, 1e-4])
def test_a_target_hardly_beyond_its_limit_does_not_read_as_the_limit(beyond):
    with pytest.raises(PositionLimit) as refused:
        guards.check_position(READY, LIMITS, LIMITS.position_max + beyond)

    target, limit = re.findall(r"[\d.]+(?= mm)", refused.value.message)
    assert float(target) > float(limit)


def test_without_limits_everything_is_allowed():
    guards.check_position(READY, AxisLimits(), 1e9)
    guards.check_velocity(READY, AxisLimits(), 1e9)
    guards.check_acceleration(READY, AxisLimits(), 1e9)


def test_a_velocity_above_the_limit_keeps_its_sign_in_the_nearest():
    with pytest.raises(VelocityLimit) as refusal:
        guards.check_velocity(READY, LIMITS, -6)

    assert refusal.value.nearest == -5


def test_an_acceleration_above_the_limit_is_refused():
    with pytest.raises(AccelerationLimit) as refusal:
        guards.check_acceleration(READY, LIMITS, 51)

    assert refusal.value.limit == 50


def test_a_lost_position_gets_no_meaning_before_reset():
    guards.check_position_kept(READY)

    with pytest.raises(WrongState, match="its position is lost: the counter wrapped") as refusal:
        guards.check_position_kept(ready("the counter wrapped", position_lost=True))

    assert refusal.value.remedy == "send reset first"
