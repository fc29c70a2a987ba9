"""A motion that follows another one on its way, at a lower acceleration, stays within the software limits all the same.

PIC-SERVO SC takes a new trapezoid in mid-move, and slows down at the new acceleration; other drives are halted first.
"""

import asyncio
import contextlib
import itertools
import random

import pytest

from ldcnd.contract.commands import (
    BufferMode,
    Halt,
    Jog,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    Reset,
    SetPosition,
)
from ldcnd.contract.errors import LdcndError, LeaseExpired
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.contract.samples import AxisState
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.plant import MotorPlant
from tests.support.dialect_rig import AXIS, LS_182AP, SC, V4, Dialect, DialectRig, dialect_rig

LIMIT_MM = 30.0
BEYOND_MM = 0.3
"""What a shaft may follow its profile by, and overshoot."""
WIDE = MotorPlant(stop_margin_counts=400_000, reverse_limit_counts=-400_000, forward_limit_counts=400_000)
RATES = {"velocity": 45.0, "acceleration": 800.0}
LIMITS = RATES | {"position_min": -LIMIT_MM, "position_max": LIMIT_MM}
ABORTING = {"buffer_mode": BufferMode.ABORTING, "acceleration": 20.0}
dialects = pytest.mark.parametrize("dialect", [SC, V4, LS_182AP], ids=lambda dialect: dialect.name)


async def farthest_mm(rig: DialectRig, for_s: float) -> float:
    """Watch the shaft for a time; return how far from 0 it was."""
    loop, most = asyncio.get_running_loop(), 0.0
    until_s = loop.time() + for_s
    while loop.time() < until_s:
        most = max(most, abs(rig.position_mm))
        await asyncio.sleep(0.01)
    return most


async def places_mm(rig: DialectRig, for_s: float) -> list[float]:
    """Watch the shaft for a time; return where it was."""
    loop, places = asyncio.get_running_loop(), []
    until_s = loop.time() + for_s
    while loop.time() < until_s:
        rig.drive.catch_up(loop.time())
        places.append(rig.position_mm)
        await asyncio.sleep(0.005)
    return places


def turned_back_mm(places: list[float]) -> float:
    """Return how far a shaft that turns forward was behind its farthest place before."""
    return max(most - place for place, most in zip(places, itertools.accumulate(places, max), strict=True))


async def at_speed(rig: DialectRig, place_mm: float) -> None:
    """Run forward at 40 mm/s as far as a place."""
    await rig.power_on()
    await rig.send(MoveVelocity(velocity=40.0, acceleration=400.0))
    while rig.position_mm < place_mm:
        await asyncio.sleep(0.005)


@dialects
@pytest.mark.parametrize(
    "request_",
    [
        MoveVelocity(velocity=-1.0, duration_s=0.5, **ABORTING),
        MoveVelocity(velocity=1.0, **ABORTING),
        MoveVelocity(velocity=-40.0, **ABORTING),
        MoveAbsolute(position=0.0, velocity=10.0, **ABORTING),
        MoveAbsolute(position=29.0, velocity=40.0, **ABORTING),
        MoveRelative(distance=-5.0, velocity=40.0, **ABORTING),
    ],
    ids=lambda request_: f"{request_.verb.value}",
)
@pytest.mark.sweep(7)
async def test_a_motion_that_could_not_turn_before_the_limit_begins_from_rest(dialect: Dialect, request_):
    async with dialect_rig(dialect, WIDE, limits=LIMITS) as rig:
        await at_speed(rig, 20.0)
        reply = await rig.send(request_)
        most = await farthest_mm(rig, 8.0)
        state = await rig.rig.client.state(AXIS)

    assert reply.command_id
    assert most < LIMIT_MM + BEYOND_MM
    assert state.state is not AxisState.ERROR_STOP
    if isinstance(request_, MoveAbsolute):
        assert rig.position_mm == pytest.approx(request_.position, abs=0.1)


@pytest.mark.parametrize("velocity", [-1.0, 1.0, -40.0])
@pytest.mark.sweep(3)
async def test_another_velocity_needs_no_buffer_mode_to_begin_from_rest_where_it_could_not_turn_in_time(velocity):
    """Other drives are held to the limit by the daemon, in velocity mode."""
    async with dialect_rig(SC, WIDE, limits=LIMITS) as rig:
        await at_speed(rig, 20.0)
        reply = await rig.send(MoveVelocity(velocity=velocity, acceleration=20.0, duration_s=0.5))
        most = await farthest_mm(rig, 8.0)
        state = await rig.rig.client.state(AXIS)

    assert reply.velocity == pytest.approx(velocity, rel=0.01)
    assert most < LIMIT_MM + BEYOND_MM
    assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)


SLOW = {"position": 1, "velocity": 1, "state": 1}


@pytest.mark.parametrize("mode", [BufferMode.REFUSE, BufferMode.ABORTING])
@pytest.mark.parametrize("polled_before_s", [0.2, 0.7])
@pytest.mark.parametrize("velocity", [1.0, 40.0], ids=["slower", "sent again"])
@pytest.mark.sweep(3)
async def test_a_velocity_forward_turns_no_shaft_back_that_turns_forward(mode, velocity, polled_before_s):
    """Its end lies ahead of where the shaft can have it, and not ahead of where it was at the last poll."""
    async with dialect_rig(SC, WIDE, limits=RATES, rates=SLOW) as rig:
        await asyncio.sleep(polled_before_s)
        await at_speed(rig, 35.0)
        await rig.send(MoveVelocity(velocity=velocity, duration_s=0.1, buffer_mode=mode))
        places = await places_mm(rig, 3.0)

    assert turned_back_mm(places) < BEYOND_MM


@pytest.mark.parametrize("slowed", ["renewed", "by the override"])
@pytest.mark.sweep(2)
async def test_a_jog_that_is_made_slower_never_turns_back(slowed):
    async with dialect_rig(SC, WIDE, limits=RATES) as rig:
        await rig.power_on()
        jog = Jog(velocity=40.0, acceleration=200.0, hold_s=1.0)
        held = {"renews": (await rig.send(jog)).command_id}
        while rig.position_mm < 20.0:
            await asyncio.sleep(0.005)
        if slowed == "renewed":
            held["velocity"] = 1.5
        else:
            await rig.rig.client.ask(SetSpeedOverride(percent=3.75))
        places = []
        for _ in range(10):
            await rig.send(jog.model_copy(update=held))
            places += await places_mm(rig, 0.2)
        state = await rig.rig.client.state(AXIS)

    assert turned_back_mm(places) < BEYOND_MM
    assert state.state is AxisState.CONTINUOUS_MOTION


@dialects
@pytest.mark.parametrize("polled_before_s", [0.2, 0.7])
@pytest.mark.parametrize(
    ("place_mm", "request_"),
    [
        (20.0, MoveVelocity(velocity=-1.0, duration_s=0.5, acceleration=100.0, buffer_mode=BufferMode.ABORTING)),
        (28.0, MoveVelocity(velocity=40.0, acceleration=400.0)),
    ],
    ids=["follows", "changes"],
)
async def test_what_follows_in_mid_move_counts_from_where_the_axis_is_by_then(
    dialect: Dialect, place_mm, request_, polled_before_s
):
    """Where it was at the last poll may be a second ago, and the limit that much nearer."""
    async with dialect_rig(dialect, WIDE, limits=LIMITS, rates=SLOW) as rig:
        await asyncio.sleep(polled_before_s)
        await at_speed(rig, place_mm)
        with contextlib.suppress(LdcndError):
            await rig.send(request_)
        most = await farthest_mm(rig, 4.0)

    assert most < LIMIT_MM + BEYOND_MM


@dialects
@pytest.mark.sweep(2)
async def test_a_jog_that_could_not_turn_before_the_limit_comes_to_rest_first(dialect: Dialect):
    async with dialect_rig(dialect, WIDE, limits=LIMITS) as rig:
        await rig.power_on()
        jog = Jog(velocity=40.0, acceleration=400.0, hold_s=1.0)
        began = await rig.send(jog)
        while rig.position_mm < 20.0:
            await asyncio.sleep(0.005)
        slow = Jog(velocity=-1.0, acceleration=20.0, hold_s=1.0, renews=began.command_id)
        await rig.send(slow)
        most = await farthest_mm(rig, 4.0)

    assert most < LIMIT_MM + BEYOND_MM


@dialects
async def test_a_jog_that_comes_to_rest_before_it_turns_gets_no_goal_meanwhile(dialect: Dialect):
    """Its drive would take the goal at once, and slow down at the acceleration that is too low for that."""
    async with dialect_rig(dialect, WIDE, limits=LIMITS) as rig:
        await rig.power_on()
        jog = Jog(velocity=20.0, acceleration=60.0, hold_s=0.2)
        held = {"renews": (await rig.send(jog)).command_id}
        while rig.position_mm < 17.5:
            await rig.send(jog.model_copy(update=held))
            await asyncio.sleep(0.005)
        back, most = Jog(velocity=-1.0, acceleration=4.0, hold_s=0.2).model_copy(update=held), 0.0
        for _ in range(40):
            await rig.send(back)
            most = max(most, await farthest_mm(rig, 0.1))

    assert most < LIMIT_MM + BEYOND_MM


@dialects
@pytest.mark.parametrize(("acceleration", "velocity"), [(100.0, -1.0), (100.0, -10.0), (400.0, -5.0), (50.0, 5.0)])
@pytest.mark.sweep(2)
async def test_a_motion_that_turns_on_its_way_has_its_velocity_for_as_long_as_was_asked_for(
    dialect: Dialect, acceleration, velocity
):
    async with dialect_rig(dialect, WIDE, limits=RATES) as rig:
        loop = asyncio.get_running_loop()
        await at_speed(rig, 10.0)
        reply = await rig.send(
            MoveVelocity(velocity=velocity, duration_s=0.5, acceleration=acceleration, buffer_mode=BufferMode.ABORTING)
        )
        at_s, most = loop.time(), 0.0
        while (await rig.rig.client.state(AXIS)).state is not AxisState.STANDSTILL:
            most = max(most, rig.position_mm)
            await asyncio.sleep(0.01)
        took_s = loop.time() - at_s

    slewing_s = (40.0 + 2 * abs(velocity)) / acceleration
    assert 0.4 < took_s < 0.5 + slewing_s + 0.6
    if dialect is SC:  # the others halt, and begin anew
        assert reply.duration_s == pytest.approx(took_s, abs=0.3)  # with settling
    assert velocity < 0 or rig.position_mm >= most - BEYOND_MM  # no way back


SOAK = tuple(pytest.param(seed, marks=pytest.mark.soak) for seed in range(100, 300))


@dialects
@pytest.mark.parametrize("seed", [*range(4), *SOAK])
@pytest.mark.sweep(2)
async def test_no_row_of_motions_that_follow_each_other_leaves_the_limits(dialect: Dialect, seed: int):
    dice = random.Random(seed)

    def drawn() -> MoveAbsolute | MoveVelocity:
        rates = {"acceleration": 10.0 ** dice.uniform(1.0, 2.9), "buffer_mode": BufferMode.ABORTING}
        velocity = dice.uniform(0.5, 45.0)
        if dice.random() < 0.5:
            return MoveAbsolute(position=dice.uniform(-LIMIT_MM, LIMIT_MM), velocity=velocity, **rates)
        return MoveVelocity(velocity=velocity * dice.choice((-1, 1)), **rates)

    done = 0
    async with dialect_rig(dialect, WIDE, limits=LIMITS) as rig:
        await rig.power_on()
        for _ in range(40):
            with contextlib.suppress(LdcndError):
                await rig.send(drawn())
                done += 1
            most = await farthest_mm(rig, dice.choice((0.05, 0.2, 0.6, 1.5)))
            assert most < LIMIT_MM + BEYOND_MM, f"seed {seed}: {most:.2f} mm"
            assert (await rig.rig.client.state(AXIS)).state is not AxisState.ERROR_STOP, f"seed {seed}"
    assert done > 20


@dialects
@pytest.mark.sweep(2)
async def test_a_jog_that_is_held_keeps_to_limits_that_a_reload_has_narrowed(dialect: Dialect):
    async with dialect_rig(dialect, WIDE, limits=LIMITS) as rig:
        await rig.power_on()
        jog = Jog(velocity=5.0, hold_s=1.0)
        renewal = jog.model_copy(update={"renews": (await rig.send(jog)).command_id})
        axis = rig.rig.daemon.rig.axes[AXIS]
        axis.reconfigure(
            axis.config.model_copy(update={"limits": axis.config.limits.model_copy(update={"position_max": 8.0})})
        )
        for _ in range(8):
            with contextlib.suppress(LeaseExpired):  # it has ended at the limit
                await rig.send(renewal)
            await asyncio.sleep(0.4)

    assert 7.9 < rig.position_mm < 8.0 + BEYOND_MM


@pytest.mark.parametrize("seed", [216, 275, 285, 0, *(each for each in SOAK if each.values[0] not in (216, 275, 285))])
@pytest.mark.sweep(4)
async def test_packets_that_come_late_lead_no_motion_out_of_the_limits(seed: int):
    """What is repeated takes longer than an axis may go on before it must slow down."""
    dice = random.Random(seed)
    lost = FaultPlan((LineFault(FaultKind.REQUEST_LOST, 0.25, from_s=5.0),), seed)
    tried = 0
    async with dialect_rig(SC, WIDE, faults=lost, line={"margin_ms": 150}, limits=LIMITS) as rig:
        await rig.power_on()
        for _ in range(25):
            if not await rested(rig):
                continue
            tried += 1
            side = -1 if rig.position_mm > 0 else 1
            for velocity, acceleration in ((40.0 * side, 400.0), (-side * 5.0, dice.choice((30.0, 60.0, 120.0)))):
                with contextlib.suppress(LdcndError):
                    await rig.send(MoveVelocity(velocity=velocity, acceleration=acceleration, buffer_mode="aborting"))
                most = await farthest_mm(rig, dice.uniform(0.1, 1.2))
                assert most < LIMIT_MM + BEYOND_MM, f"seed {seed}: {most:.2f} mm"
    assert tried


async def rested(rig: DialectRig) -> bool:
    """Bring the axis to rest and have it know where it is, as far as the line lets it."""
    with contextlib.suppress(LdcndError, TimeoutError):
        async with asyncio.timeout(10.0):
            await rig.send(Halt())
            await asyncio.sleep(3.0)
            await rig.send(Reset())
            await rig.send(Power(on=True))
            await rig.send(SetPosition(position=round(rig.position_mm, 3)))
            return (await rig.rig.client.state(AXIS)).referenced and abs(rig.position_mm) < LIMIT_MM
    return False
