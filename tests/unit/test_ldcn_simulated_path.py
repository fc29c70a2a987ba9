"""Path mode of PIC-SERVO SC and CMC, cycle by cycle, and every switch for what the data sheet leaves open."""

from itertools import pairwise

import pytest

from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.commands import Node, add_path_points, start_path
from ldcnd.drives.ldcn.controls import IoOption, StopControl
from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, StatusFlag
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.drives.ldcn.registers import FRACTION, encode_gains
from ldcnd.drives.ldcn.trajectory import PathPoint, ProfileMode, Trajectory, encode_point
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.quirks import HalfPoint, LimitInPath, PathOverflow, PathWithoutServo
from ldcnd.sim.plant import MotorPlant
from tests.support.ldcn_decoding import decode_point
from tests.support.simulated_axis import ON, ONE, UTILITY_GAINS
from tests.support.simulated_host import SimulatedHost
from tests.support.simulated_path import PathAxis

ADVANCED_ON = ON | StopControl.ABRUPT | StopControl.ADVANCED


def cmc(**quirks):
    axis = PathAxis("pic-servo-cmc", **quirks)
    axis.stop(ADVANCED_ON)
    return axis


def points_left(axis):
    return axis.look().bit7


# -- points as words (5.2) --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cycles", "fast_path", "most"), [(64, False, 16383), (32, False, 8191), (32, True, 8191), (16, True, 4095)]
)
def test_the_largest_step_of_a_period_fits_and_one_more_is_refused(cycles, fast_path, most):
    for counts in (most, -most, 0, 1, -1):
        word = encode_point(PathPoint(counts, cycles), fast_path=fast_path)
        assert decode_point(word, fast_path=fast_path) == PathPoint(counts, cycles)
    with pytest.raises(ValueOutOfRange, match=str(most)):
        encode_point(PathPoint(most + 1, cycles), fast_path=fast_path)


@pytest.mark.parametrize(("cycles", "fast_path"), [(16, False), (64, True), (33, False)])
def test_a_period_that_the_option_does_not_offer_is_refused(cycles, fast_path):
    with pytest.raises(ValueOutOfRange, match="cycles"):
        encode_point(PathPoint(1, cycles), fast_path=fast_path)


def test_older_drives_have_no_path_mode():
    for name in ("pic-servo-v4", "ls-182ap"):
        with pytest.raises(NotSupported, match="path mode"):
            add_path_points(Node(1, PROFILES[name]), [PathPoint(1, 64)])
        with pytest.raises(NotSupported, match="path mode"):
            start_path(Node(1, PROFILES[name]))


# -- walking (4.4.5) --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cycles", "fast_path", "option"), [(64, False, 0), (32, False, 0), (32, True, 0x40), (16, True, 0x40)]
)
def test_a_point_moves_its_step_in_its_cycles_at_constant_velocity(cycles, fast_path, option):
    axis = PathAxis()
    axis.send(1, CommandCode.IO_CONTROL, option)
    axis.add(101, -37, cycles=cycles, fast_path=fast_path)
    axis.start()

    trajectory = axis.drive.loop.trajectory
    axis.drive.catch_up(axis.now_s)
    while trajectory.path.running:
        axis.drive.loop.run(1)
    end = trajectory.position

    axis.add(101, -37, cycles=cycles, fast_path=fast_path)
    trajectory.start_path()
    positions = [end]
    while trajectory.path.running:
        axis.drive.loop.run(1)
        positions.append(trajectory.position)
    assert end == 64 * ONE
    assert len(positions) == 2 * cycles + 1
    assert positions[cycles] - end == 101 * ONE
    assert positions[-1] - end == 64 * ONE
    steps = {after - before for before, after in pairwise(positions)}
    assert steps == {101 * ONE // cycles, -37 * ONE // cycles}


def test_a_path_shows_in_its_bit_and_in_the_points_left():
    axis = PathAxis()
    axis.add(*[50] * 10)
    loaded = axis.look()

    axis.start()
    axis.cycles(64 * 3)
    running = axis.look()
    axis.cycles(64 * 10)
    over = axis.look()

    assert (loaded.bit7, bool(loaded.aux & AuxFlag.PATH_MODE)) == (10, False)
    assert 4 <= running.bit7 <= 6
    assert running.aux & AuxFlag.PATH_MODE
    assert running.flags & StatusFlag.MOVE_DONE
    assert (over.bit7, bool(over.aux & AuxFlag.PATH_MODE)) == (0, False)
    assert axis.commanded == 500


def test_points_may_be_added_while_the_path_runs():
    axis = PathAxis()
    axis.add(*[20] * 7)
    axis.start()

    for _ in range(5):
        axis.cycles(64)
        axis.add(20, 20)
    axis.wait(2.0)

    assert axis.commanded == 17 * 20


def test_an_underrun_stops_at_the_last_point_without_a_ramp_and_later_points_wait():
    axis = PathAxis()
    axis.add(*[320] * 4)
    axis.start()
    axis.wait(0.5)
    stopped = axis.commanded

    axis.add(320)
    axis.wait(0.2)

    assert (stopped, axis.commanded) == (1280, 1280)
    assert points_left(axis) == 1
    assert not axis.walks()
    axis.start()
    axis.wait(0.2)
    assert axis.commanded == 1600


def test_an_underrun_at_speed_trips_a_tight_error_limit():
    axis = PathAxis()
    axis.send(1, CommandCode.SET_GAIN, *encode_gains(axis.profile, Gains(20, 3000, 0, 0, 250, 0, 40, 1)))
    axis.add(*range(40, 1240, 40), *[1240] * 10)

    axis.start()
    axis.wait(2.0)

    assert axis.status().flags & StatusFlag.POSITION_ERROR


def test_a_group_starts_its_axes_with_one_packet():
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("pic-servo-sc"),) * 3)))
    host.address_all()
    for address, group in ((1, 0x01), (2, 0x81), (3, 0x81)):
        host.send(address, CommandCode.SET_GAIN, *encode_gains(PROFILES["pic-servo-sc"], UTILITY_GAINS))
        host.send(address, CommandCode.STOP_MOTOR, 0x05)
        host.send(address, CommandCode.SET_ADDRESS, address, group)
        host.send(address, CommandCode.ADD_PATH_POINTS, *(400).to_bytes(2, "little"))

    reply = host.send(0x81, CommandCode.ADD_PATH_POINTS)
    host.wait(0.2)
    positions = []
    for module in host.chain.modules:
        module.catch_up(host.now_s)
        positions.append(module.loop.trajectory.position // FRACTION)

    assert len(reply) == 2
    assert positions == [50, 50, 50]


# -- what ends a path -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("control", [StopControl.ABRUPT, StopControl.SMOOTH, StopControl.MOTOR_OFF])
@pytest.mark.parametrize("cleared", [True, False])
def test_stop_motor_ends_a_path_and_what_becomes_of_the_rest_is_a_switch(control, cleared):
    axis = PathAxis(path_cleared_by_stop=cleared)
    axis.add(*[50] * 20)
    axis.start()
    axis.cycles(64 * 5)

    axis.stop(ON | control)
    status = axis.look()

    assert not status.aux & AuxFlag.PATH_MODE
    assert (status.bit7 == 0) is cleared


@pytest.mark.parametrize("ends", [True, False])
def test_whether_the_enable_bit_alone_ends_a_path_is_a_switch(ends):
    axis = PathAxis(path_ended_by_enable=ends)
    axis.add(*[50] * 20)
    axis.start()

    axis.stop(ON)

    assert axis.walks() is not ends


def test_another_motion_ends_a_path():
    axis = PathAxis()
    axis.add(*[50] * 20)
    axis.start()
    axis.cycles(64 * 5)

    axis.load(Trajectory(velocity=ONE, acceleration=2000, mode=ProfileMode.VELOCITY, start_now=True))
    axis.wait(0.1)

    assert not axis.walks()
    assert axis.status().velocity == pytest.approx(1, abs=1)


@pytest.mark.parametrize("cleared", [True, False])
def test_a_fault_ends_a_path_and_what_becomes_of_the_rest_is_a_switch(cleared):
    axis = PathAxis(path_cleared_by_fault=cleared)
    axis.add(*[50] * 20)
    axis.start()

    axis.suffer(FaultCondition.MOTOR_POWER_OFF)
    status = axis.look()

    assert not status.aux & (AuxFlag.PATH_MODE | AuxFlag.SERVO_ON)
    assert status.bit7 == (0 if cleared else status.bit7)
    assert (status.bit7 > 0) is not cleared


@pytest.mark.parametrize(
    ("variant", "walks", "beyond"),
    [
        (LimitInPath.ENDS_PATH, False, False),
        (LimitInPath.KEEPS_PATH_MODE, True, False),
        (LimitInPath.NOTHING, True, True),
    ],
)
def test_what_limit_protection_does_to_a_path_is_a_switch(variant, walks, beyond):
    axis = PathAxis(plant=MotorPlant(forward_limit_counts=500), limit_in_path=variant)
    axis.send(1, CommandCode.IO_CONTROL, IoOption.LIMIT_STOP)
    axis.add(*[100] * 20)
    axis.start()

    axis.cycles(64 * 10)

    assert axis.walks() is walks
    assert (axis.commanded > 700) is beyond


# -- the buffer -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "capacity"), [("pic-servo-sc", 128), ("pic-servo-cmc", 96)])
@pytest.mark.parametrize(
    ("overflow", "left", "first"),
    [(PathOverflow.DROP_EXCESS, 0, 1), (PathOverflow.DROP_PACKET, -4, 1), (PathOverflow.OVERWRITE, 0, 4)],
)
def test_what_happens_to_points_too_many_is_a_switch(name, capacity, overflow, left, first):
    axis = PathAxis(name, path_overflow=overflow)
    axis.stop(ADVANCED_ON if name == "pic-servo-cmc" else ON | StopControl.ABRUPT)
    axis.add(*range(1, capacity - 3))

    axis.add(1, 1, 1, 1, 1, 1, 1)
    count = points_left(axis)
    axis.start()
    axis.drive.catch_up(axis.now_s)
    axis.drive.loop.run(64)

    assert count == capacity + left
    assert axis.drive.loop.trajectory.path.velocity * 64 in {first * ONE, (first + 1) * ONE}


@pytest.mark.parametrize(
    ("variant", "left"), [(HalfPoint.IGNORED, 1), (HalfPoint.COMPLETED, 2), (HalfPoint.PACKET_DROPPED, 0)]
)
def test_what_becomes_of_half_a_point_is_a_switch(variant, left):
    axis = PathAxis(half_point=variant)

    axis.send(1, CommandCode.ADD_PATH_POINTS, 0x92, 0x01, 0x00)

    assert points_left(axis) == left
    assert not axis.walks()


def test_half_a_point_alone_starts_nothing():
    axis = PathAxis()
    axis.add(50)

    axis.send(1, CommandCode.ADD_PATH_POINTS, 0x92)

    assert not axis.walks()


@pytest.mark.parametrize(("begins", "moved"), [(False, 0), (True, 50)])
def test_whether_a_start_with_an_empty_buffer_waits_for_points_is_a_switch(begins, moved):
    axis = PathAxis(path_starts_empty=begins)
    axis.start()
    walks = axis.walks()

    axis.add(50)
    axis.wait(0.2)

    assert walks is begins
    assert axis.commanded == moved


@pytest.mark.parametrize(
    ("variant", "left", "walks"),
    [
        (PathWithoutServo.WAITS, {20}, False),
        (PathWithoutServo.POINTS_REFUSED, {0}, False),
        (PathWithoutServo.RUNS, set(range(1, 20)), True),
    ],
)
def test_what_path_mode_does_with_the_servo_off_is_a_switch(variant, left, walks):
    axis = PathAxis(path_without_servo=variant)
    axis.stop(ON | StopControl.MOTOR_OFF)

    axis.add(*[50] * 20)
    axis.start()

    assert axis.walks() is walks
    assert points_left(axis) in left
    axis.wait(1.0)
    assert not axis.walks()
    assert axis.commanded == 0


@pytest.mark.parametrize(("restarts", "moved"), [(False, 500), (True, pytest.approx(475, abs=20))])
def test_whether_another_start_goes_on_to_the_next_point_is_a_switch(restarts, moved):
    axis = PathAxis(path_restarts=restarts)
    axis.add(*[50] * 10)
    axis.start()

    axis.cycles(64 * 3 + 32)
    axis.start()
    axis.wait(1.0)

    assert axis.commanded == moved
    assert not axis.walks()


@pytest.mark.parametrize(("taken", "left"), [(True, 1), (False, 0)])
def test_whether_points_are_taken_during_another_motion_is_a_switch(taken, left):
    axis = PathAxis(path_takes_points_in_motion=taken)
    axis.move(5000)

    axis.add(50)

    assert points_left(axis) == left


def test_a_damaged_packet_adds_nothing():
    axis = PathAxis()

    axis.chain.write(axis.now_s, bytes.fromhex("aa 01 2d 92 01 3e"))
    reply = axis.wait(0.03)

    assert reply[0] & StatusFlag.CHECKSUM_ERROR
    assert points_left(axis) == 0


# -- what the status says ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("counts", "left"), [(True, 1), (False, 0)])
def test_whether_the_point_under_way_counts_is_a_switch(counts, left):
    axis = PathAxis(path_counts_point_under_way=counts)
    axis.add(50)

    axis.start()
    axis.drive.catch_up(axis.now_s)

    assert axis.drive.loop.trajectory.path.points_left == left


@pytest.mark.parametrize("early", [True, False])
def test_whether_path_mode_falls_with_the_last_point_or_after_it_is_a_switch(early):
    axis = PathAxis(path_ends_with_buffer=early)
    axis.add(50, 50)

    axis.start()
    axis.drive.catch_up(axis.now_s)  # the first point is nearly over
    axis.drive.loop.run(20)

    assert axis.drive.loop.trajectory.path.path_mode is not early


@pytest.mark.parametrize("shown", [True, False])
def test_move_done_and_slew_during_a_path_are_switches(shown):
    axis = PathAxis(path_move_done=shown, path_slew=shown)
    axis.add(*[50] * 20)
    axis.start()

    status = axis.look()

    assert bool(status.flags & StatusFlag.MOVE_DONE) is shown
    assert bool(status.aux & AuxFlag.SLEW_DONE) is shown


@pytest.mark.parametrize(("at_load", "counts"), [(True, 200), (False, 100)])
def test_when_the_fast_path_option_counts_is_a_switch(at_load, counts):
    axis = PathAxis(path_rate_at_load=at_load)
    axis.add(200, cycles=32)
    axis.send(1, CommandCode.IO_CONTROL, IoOption.FAST_PATH)

    axis.start()
    axis.wait(0.2)

    assert axis.commanded == counts


# -- PIC-SERVO CMC ----------------------------------------------------------------------------------------------------


def test_a_cmc_is_a_version_4_until_its_advanced_features_are_turned_on():
    axis = PathAxis("pic-servo-cmc")
    before = axis.send(1, CommandCode.READ_STATUS, 0xC9)
    axis.send(1, CommandCode.ADD_PATH_POINTS, *(400).to_bytes(2, "little"))

    axis.stop(ADVANCED_ON)

    assert len(before) == 2 + 5
    assert len(axis.send(1, CommandCode.READ_STATUS, 0xC9)) == 2 + 8
    assert points_left(axis) == 0


@pytest.mark.parametrize("sends", [True, False])
def test_whether_a_cmc_sends_the_new_items_before_is_a_switch(sends):
    axis = PathAxis("pic-servo-cmc", items_before_advanced=sends)

    assert len(axis.send(1, CommandCode.READ_STATUS, 0xC0)) == (5 if sends else 2)


@pytest.mark.parametrize("sticky", [True, False])
def test_whether_a_later_stop_revokes_the_advanced_features_is_a_switch(sticky):
    axis = cmc(advanced_sticky=sticky)

    axis.stop(ON)

    assert len(axis.send(1, CommandCode.READ_STATUS, 0x80)) == (3 if sticky else 2)


def test_a_cmc_walks_and_keeps_its_limit_pins():
    axis = cmc()
    axis.send(1, CommandCode.IO_CONTROL, 0x4C)
    axis.add(*[40] * 6, cycles=16, fast_path=True)

    axis.start()
    axis.wait(0.3)

    assert axis.commanded == 240


@pytest.mark.parametrize("ignores", [True, False])
def test_whether_the_divisor_slows_a_cmcs_path_is_a_switch(ignores):
    axis = cmc(path_ignores_divisor=ignores)
    slow = Gains(kp=350, kd=1000, ki=0, il=0, ol=250, cl=0, el=4000, sr=2)
    axis.send(1, CommandCode.SET_GAIN, *encode_gains(axis.profile, slow))
    axis.add(*[40] * 10)
    axis.start()

    axis.drive.catch_up(axis.now_s)
    before = axis.drive.loop.trajectory.position
    axis.drive.loop.run(128)
    moved = axis.drive.loop.trajectory.position - before

    assert moved == (80 if ignores else 40) * ONE


def test_sc_ignores_the_bit_that_turns_a_cmcs_features_on():
    axis = PathAxis()

    axis.stop(ADVANCED_ON)
    axis.add(40)
    axis.start()
    axis.wait(0.2)

    assert axis.commanded == 40
