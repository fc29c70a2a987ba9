"""Properties of every trapezoidal move, and of the servo loop that follows it."""

from dataclasses import replace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.profiles import HomingControl
from ldcnd.drives.ldcn.trajectory import ProfileMode
from ldcnd.sim.ldcn.power import FaultCondition, Trip
from ldcnd.sim.ldcn.servo import ArmedSearch, ServoLoop
from ldcnd.sim.ldcn.trajectory import ProfileGenerator
from ldcnd.sim.plant import MotorPlant
from tests.support.simulated_axis import ON, ONE, UTILITY_GAINS, SimulatedAxis


@settings(max_examples=50, deadline=None)
@given(
    counts=st.integers(-20_000, 20_000),
    speed=st.integers(ONE // 4, 60 * ONE),
    acceleration=st.integers(200, 8 * ONE),
)
@pytest.mark.long
def test_every_move_keeps_its_limits_and_ends_exactly_on_its_goal(counts, speed, acceleration):
    profiler = ProfileGenerator()
    profiler.go_to(counts, speed, acceleration)

    ticks, before = 0, 0
    while not profiler.done:
        profiler.step()
        ticks += 1
        assert abs(profiler.velocity) <= speed
        assert abs(profiler.velocity - before) <= acceleration
        before = profiler.velocity

    way = abs(counts) * ONE
    ideal = way / speed + speed / acceleration if way >= speed**2 / acceleration else 2 * (way / acceleration) ** 0.5
    assert profiler.position == counts * ONE
    assert profiler.at_rest
    assert ticks <= ideal + 4


@settings(max_examples=100, deadline=None)
@given(
    velocities=st.lists(st.integers(-30 * ONE, 30 * ONE), min_size=1, max_size=4), acceleration=st.integers(1, 10 * ONE)
)
def test_velocity_mode_integrates_its_velocity(velocities, acceleration):
    profiler = ProfileGenerator()

    travelled = 0
    for goal in velocities:
        profiler.run_at(goal, acceleration)
        for _ in range(50):
            before = profiler.velocity
            profiler.step()
            travelled += profiler.velocity
            assert abs(profiler.velocity - before) <= acceleration
            assert profiler.done == (profiler.velocity == goal)

    assert profiler.position == travelled


CHANGE = st.tuples(st.integers(-3000, 3000), st.integers(ONE // 4, 30 * ONE), st.integers(1, 300))
"""A goal, a velocity, and for how many ticks they are in force."""


@settings(max_examples=60, deadline=None)
@given(changes=st.lists(CHANGE, min_size=1, max_size=6), acceleration=st.integers(500, 4 * ONE))
def test_goal_and_velocity_may_change_at_any_time_and_the_limits_are_kept(changes, acceleration):
    """Every change begins with the velocity that is there; one above the new limit is only ever brought down."""
    profiler = ProfileGenerator()

    for counts, speed, ticks in changes:
        profiler.go_to(counts, speed, acceleration, from_velocity=True)
        for _ in range(ticks):
            before = profiler.velocity
            profiler.step()
            assert abs(profiler.velocity - before) <= acceleration
            assert abs(profiler.velocity) <= max(speed, abs(before) - min(acceleration, abs(before)))
    for _ in range(200_000):
        if profiler.done:
            break
        profiler.step()

    assert profiler.at_rest
    assert profiler.position == changes[-1][0] * ONE


class CycleByCycle(ServoLoop):
    """Runs every servo cycle on its own, whatever is in it."""

    _is_plain = False


def tight(axis, **gains):
    axis.drive.loop.set_gains(replace(UTILITY_GAINS, **gains))


DOINGS = {
    "move": lambda axis, size: axis.move(size * 40, velocity=3 * ONE + abs(size) * 500, acceleration=100 + abs(size)),
    "new goal": lambda axis, size: axis.move(-size, velocity=ONE, acceleration=2000),
    "jog": lambda axis, size: axis.jog(size * 300),
    "too fast": lambda axis, size: axis.jog(size * 10_000, acceleration=ONE * 60),
    "pwm": lambda axis, size: axis.drive_pwm(size // 8),
    "stop": lambda axis, _size: axis.stop(ON | StopControl.SMOOTH),
    "stop at once": lambda axis, _size: axis.stop(ON | StopControl.ABRUPT),
    "off": lambda axis, _size: axis.stop(ON | StopControl.MOTOR_OFF),
    "arm": lambda axis, _size: axis.arm(HomingControl.INDEX | HomingControl.LIMIT1 | HomingControl.STOP_SMOOTH),
    "hold": lambda axis, _size: axis.suffer(FaultCondition.STALLED),
    "stick": lambda axis, _size: axis.suffer(FaultCondition.ENCODER_STUCK),
    "let go": lambda axis, _size: [
        axis.recover(each) for each in (FaultCondition.STALLED, FaultCondition.ENCODER_STUCK)
    ],
    "push": lambda axis, size: setattr(axis.drive.shaft, "velocity_counts", size / 100),
    "renumber": lambda axis, size: axis.drive.loop.renumber(size * 500_000),
    "clear": lambda axis, _size: axis.clear(),
    "gains": lambda axis, size: tight(axis, sr=1 + abs(size) % 3, el=200 + abs(size)),
    "current limit": lambda axis, size: tight(axis, cl=1 + 2 * (abs(size) % 20)),
    "deadband": lambda axis, size: tight(axis, deadband=abs(size) % 30),
    "amplifier off": lambda axis, _size: axis.stop(StopControl.ABRUPT),
    "limits": lambda axis, _size: tight(axis),
}


def everything(axis):
    """Return all that can be told apart about a drive and its machine."""
    loop = axis.drive.loop
    parts = (loop, loop.trajectory, loop.trajectory.path, loop.shaft, loop.stage)
    plain = (int, float, bool, set, ArmedSearch, Gains, Trip, ProfileMode, type(None))
    return [{name: each for name, each in vars(part).items() if isinstance(each, plain)} for part in parts]


JOG = [("jog", 600, 200)]


@settings(max_examples=40, deadline=None)
@example("ls-182ap", [*JOG, ("hold", 0, 100), ("let go", 0, 9), ("hold", 0, 1), ("off", 0, 1), ("let go", 0, 9)])
@example("ls-182ap", [*JOG, ("hold", 0, 1500), ("clear", 0, 20)])
@example("ls-182ap", [("too fast", 900, 300), ("clear", 0, 20)])
@example("ls-182ap", [*JOG, ("push", -3000, 5), *[("limits", 0, 1)] * 40, ("push", 3000, 90), ("stop", 0, 90)])
@example("pic-servo-v4", [*JOG, ("gains", 500, 50), ("limits", 0, 1), ("stick", 0, 20), ("let go", 0, 20)])
@example("pic-servo-v4", [*JOG, ("deadband", 9, 50), ("current limit", 0, 100), ("limits", 0, 1), ("limits", 0, 50)])
@example("pic-servo-v4", [*JOG, ("hold", 0, 300), ("let go", 0, 100), ("amplifier off", 0, 100), ("stop", 0, 100)])
@example("pic-servo-sc", [*JOG, ("arm", 0, 200), ("stop at once", 0, 200), ("too fast", 900, 300)])
@example("pic-servo-v4", [("move", 50, 900), ("push", 900, 1), ("renumber", 700, 300), ("new goal", 5, 300)])
@example("pic-servo-v4", [("push", 900_000, 1), ("push", 900_000, 40), ("pwm", 900, 40), ("stop", 0, 100)])
@given(
    model=st.sampled_from(["ls-182ap", "pic-servo-v4", "pic-servo-sc"]),
    program=st.lists(
        st.tuples(st.sampled_from(sorted(DOINGS)), st.integers(-1000, 1000), st.integers(1, 300)),
        min_size=3,
        max_size=12,
    ),
)
@pytest.mark.long
def test_cycles_that_pass_at_once_are_those_that_pass_one_by_one(model, program):
    plant = MotorPlant(reverse_limit_counts=-9000, forward_limit_counts=9000, stop_margin_counts=900)
    quick, slow = (SimulatedAxis(model, plant=plant) for _ in range(2))

    for doing, size, cycles in program:
        for axis in (quick, slow):
            DOINGS[doing](axis, size)
            slow.drive.loop.__class__ = CycleByCycle  # also after a reset
            axis.wait(cycles * 0.000512)
            axis.drive.catch_up(axis.now_s)
        assert everything(quick) == everything(slow), doing
