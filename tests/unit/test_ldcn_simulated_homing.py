"""The search for home of a simulated servo drive."""

import pytest

from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag
from ldcnd.drives.ldcn.profiles import HomingControl
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.plant import MotorPlant
from tests.support.simulated_axis import ON, ONE, SOFT_GAINS, SimulatedAxis

NARROW = MotorPlant(reverse_limit_counts=-3000, forward_limit_counts=3000)


def homed(status):
    return not status.flags & StatusFlag.HOME_IN_PROGRESS


@pytest.mark.parametrize("name", ["ls182ap", "picservo-v4"])
def test_homing_on_the_index_captures_its_position_and_stops(name):
    axis = SimulatedAxis(name)
    axis.arm(HomingControl.INDEX | HomingControl.STOP_SMOOTH)
    searching = axis.status()

    axis.jog(ONE, acceleration=500)
    status = axis.wait_for(homed)
    axis.finish()

    assert searching.flags & StatusFlag.HOME_IN_PROGRESS
    assert status.home == pytest.approx(700, abs=2)
    assert axis.status().velocity == 0


@pytest.mark.parametrize(
    ("control", "velocity", "edge"),
    [(HomingControl.LIMIT2, 2 * ONE, 3000), (HomingControl.LIMIT1, -2 * ONE, -3000)],
    ids=["forward", "reverse"],
)
@pytest.mark.parametrize("name", ["ls182ap", "picservo-v4"])
def test_homing_on_a_limit_captures_its_edge_and_stops(name, control, velocity, edge):
    axis = SimulatedAxis(name, plant=NARROW)
    axis.arm(control | HomingControl.STOP_ABRUPT)

    axis.jog(velocity)
    status = axis.wait_for(homed)
    axis.wait(0.5)

    assert status.home == pytest.approx(edge, abs=3)
    stopped = axis.status()
    assert stopped.position == pytest.approx(edge, abs=20)
    assert stopped.flags & (StatusFlag.LIMIT2 if edge > 0 else StatusFlag.LIMIT1)


def test_homing_armed_on_the_switch_triggers_when_it_is_left():
    axis = SimulatedAxis(plant=NARROW)
    axis.move(3200)
    axis.finish()
    axis.arm(HomingControl.LIMIT2 | HomingControl.STOP_ABRUPT)
    axis.wait(0.5)
    still_searching = axis.status()

    axis.jog(-ONE)
    status = axis.wait_for(homed)

    assert still_searching.flags & StatusFlag.HOME_IN_PROGRESS
    assert status.home == pytest.approx(3000, abs=3)


def test_homing_may_be_armed_while_moving():
    axis = SimulatedAxis()
    axis.jog(ONE)
    axis.wait(0.1)

    axis.arm(HomingControl.INDEX)
    status = axis.wait_for(homed)

    assert status.home == pytest.approx(700, abs=2)
    assert axis.status().velocity == pytest.approx(1, abs=1)  # no stop was asked for


def test_homing_on_a_position_error_captures_the_obstacle():
    axis = SimulatedAxis(plant=MotorPlant(forward_limit_counts=1000, stop_margin_counts=500), gains=SOFT_GAINS)
    axis.arm(HomingControl.POSITION_ERROR)

    axis.jog(4 * ONE)
    status = axis.wait_for(homed)

    assert status.home == 1500
    assert not status.aux & AuxFlag.SERVO_ON


def test_homing_on_current_captures_the_obstacle_on_pic_servo():
    gains = Gains(kp=350, kd=3000, ki=0, il=0, ol=250, cl=101, el=16_000, sr=1)
    axis = SimulatedAxis(
        "picservo-v4", plant=MotorPlant(forward_limit_counts=1000, stop_margin_counts=500), gains=gains
    )
    axis.arm(HomingControl.CURRENT | HomingControl.MOTOR_OFF)

    axis.jog(4 * ONE, acceleration=200)
    status = axis.wait_for(homed)

    assert status.home == 1500
    assert status.flags & StatusFlag.OVERCURRENT
    assert not status.aux & AuxFlag.SERVO_ON


def test_zero_cancels_the_search():
    axis = SimulatedAxis()
    axis.arm(HomingControl.INDEX | HomingControl.STOP_SMOOTH)

    axis.arm(HomingControl(0))
    axis.jog(ONE)
    axis.wait(1.0)

    status = axis.status()
    assert not status.flags & StatusFlag.HOME_IN_PROGRESS
    assert status.home == 0
    assert status.velocity != 0


def test_source_that_the_device_lacks_starts_no_search():
    axis = SimulatedAxis("ls173ap")

    axis.arm(HomingControl.LIMIT1)

    assert not axis.status().flags & StatusFlag.HOME_IN_PROGRESS


def test_version_2_captures_home_but_does_not_stop():
    axis = SimulatedAxis("picservo-v2")
    axis.arm(HomingControl.INDEX | HomingControl.MOTOR_OFF)

    axis.jog(ONE)
    axis.wait_for(homed)

    assert axis.status().aux & AuxFlag.SERVO_ON


@pytest.mark.parametrize(("version", "locks"), [(20, False), (22, True)])
def test_homing_on_a_limit_locks_motion_from_version_22_on(version, locks):
    axis = SimulatedAxis(plant=NARROW, settings=ModuleSettings(version=version))
    axis.arm(HomingControl.LIMIT2 | HomingControl.STOP_ABRUPT)
    axis.jog(4 * ONE)
    axis.wait_for(homed)
    axis.wait(0.5)

    axis.move(0)
    axis.wait(0.5)
    status = axis.status()
    axis.stop(ON | StopControl.ABRUPT | StopControl.LOCK_DISABLE)
    axis.move(0)
    axis.finish()
    axis.wait(0.5)

    assert bool(status.aux & AuxFlag.MOTION_LOCKED) is locks
    assert (status.velocity == 0) is locks
    assert abs(axis.status().position) <= 1
