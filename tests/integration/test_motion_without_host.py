"""Every motion that a verb can start ends within its bound when the daemon is killed, but for those named here."""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import (
    AxisCommand,
    CommandReply,
    Home,
    Jog,
    MoveAbsolute,
    MoveAnalog,
    MoveRelative,
    MoveVelocity,
    Power,
    Probe,
    SetPwm,
    Track,
)
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.rig_commands import AxisMove, MoveTogether
from ldcnd.contract.samples import AxisState
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain, model
from ldcnd.sim.plant import MotorPlant
from tests.support.dialect_rig import (
    CMC,
    COUNTS_PER_MM,
    GAINS,
    LS_173AP,
    LS_182AP,
    LS_182AP_22,
    SC,
    V1,
    V2,
    V4,
    Dialect,
)
from tests.support.mortal_rig import MortalRig, mortal_rig

HORIZON_S = 2.0
BRAKING_S = 0.6
"""To come to rest and to settle behind a bound."""
STILL_MM = 0.01
PLANT = MotorPlant(
    reverse_limit_counts=-8_000,
    forward_limit_counts=8_000,
    stop_margin_counts=60_000,
    pot_span_counts=(-90_000, 90_000),
    index_at_counts=-3_700,
    index_spacing_counts=100_000,
)
"""Behind the limit switches there is room, so that nothing but its bound ends a motion."""
AXIS = {
    "jog_horizon_s": HORIZON_S,
    "tracking": {"step": 0.5, "rate": 50},
    "pwm": {"duty": 0.1, "duration_s": HORIZON_S},
}
MODELS = (V1, V2, V4, CMC, SC, LS_173AP, LS_182AP, LS_182AP_22)
names = {"ids": lambda each: each.name if isinstance(each, Dialect) else each}


@dataclass(frozen=True, slots=True)
class Case:
    """One verb in one use, and how long after its start everything must stand, without a host."""

    command: AxisCommand[CommandReply] | MoveTogether
    bound_s: float
    axis: dict[str, object]
    before: AxisCommand[CommandReply] | None = None


def case(command: AxisCommand[CommandReply] | MoveTogether, bound_s: float, **axis: object) -> Case:
    return Case(command, bound_s, axis)


BOUNDED = {
    "move_absolute": case(MoveAbsolute(position=15.0, velocity=10.0), 1.6),
    "move_absolute, positive": case(MoveAbsolute(position=9.0, velocity=10.0, direction="positive"), 1.0, modulo=10.0),
    "move_absolute, negative": case(MoveAbsolute(position=1.0, velocity=10.0, direction="negative"), 1.0, modulo=10.0),
    "move_absolute, new goal": replace(
        case(MoveAbsolute(position=-4.0, velocity=10.0, buffer_mode="aborting"), 1.5),
        before=MoveAbsolute(position=6.0, velocity=10.0),
    ),
    "move_relative": case(MoveRelative(distance=-10.0, velocity=10.0), 1.1),
    "move_velocity": case(MoveVelocity(velocity=5.0), HORIZON_S),
    "move_velocity, switches": case(MoveVelocity(velocity=8.0), 1.2, limit_switches="stop", jog_horizon_s=60.0),
    "jog": case(Jog(velocity=5.0, hold_s=1.0), HORIZON_S, jog_reach_s=HORIZON_S),
    "move_together": case(
        MoveTogether(moves=[AxisMove(axis=axis, position=10.0, velocity=10.0) for axis in ("x", "y")]), 1.1
    ),
    "move_together, straight": case(
        MoveTogether(
            path="linear",
            moves=[AxisMove(axis="x", position=10.0, velocity=10.0), AxisMove(axis="y", position=4.0, velocity=10.0)],
        ),
        1.2,
    ),
    "move_absolute, approached": case(
        MoveAbsolute(position=-4.0, velocity=10.0), 1.4, approach={"direction": "positive", "distance": 2.0}
    ),
    "home, index": case(Home(method="index", velocity=-1.0, timeout_s=HORIZON_S), 1.1 * HORIZON_S),
    "home, switch": case(Home(method="forward_limit", velocity=6.0, timeout_s=HORIZON_S), 1.1 * HORIZON_S),
    "home, two speeds": case(
        Home(method="forward_limit", velocity=2.0, find_velocity=8.0, distance=9.0, timeout_s=HORIZON_S), 4.6
    ),
    "home, guarded": case(
        Home(method="index", velocity=-1.0, timeout_s=HORIZON_S), 1.1 * HORIZON_S, limit_switches="stop"
    ),
    "probe, switch": case(Probe(sources=["forward_limit"], distance=15.0, velocity=10.0), 1.6),
    "probe, index": case(Probe(sources=["index"], distance=-1.0, velocity=1.0), 1.1),
    "probe, guarded": case(
        Probe(sources=["index"], distance=12.0, velocity=1.0, acceleration=200.0), 12.1, limit_switches="stop"
    ),
    "track": case(Track(position=0.4), 0.2),
}
UNBOUNDED = {
    "set_pwm": case(SetPwm(duty=0.05, duration_s=HORIZON_S), HORIZON_S),
    "move_analog": case(MoveAnalog(target=3, velocity=2.0, timeout_s=HORIZON_S), HORIZON_S),
}
SWITCHES_ON = ("home, switch", "home, two speeds", "probe, switch")
UNABLE = (
    {
        (dialect.name, name)
        for dialect in (LS_173AP,)
        for name in BOUNDED
        if name in SWITCHES_ON or BOUNDED[name].axis.get("limit_switches")
    }
    | {(dialect.name, name) for dialect in (V1, V2) for name in BOUNDED if BOUNDED[name].axis.get("limit_switches")}
    | {(V1.name, "track")}
)
"""What a model cannot, or its configuration refuses."""


def config_of(dialect: Dialect, axis: dict[str, object]) -> RigConfig:
    """Return a rig of two axes of this model, which are a group."""
    each = {
        "model": dialect.profile,
        "unit": "mm",
        "counts_per_unit": COUNTS_PER_MM,
        "velocity": 20,
        "acceleration": 200,
        "reference": "at_reset",
        "gains": GAINS,
        "rates": {"position": 20, "velocity": 20, "adc": 5, "state": 20},
    } | axis
    axes = [each | {"name": name, "address": address} for address, name in enumerate("xy", 1)]
    bus = {"name": "line", "port": "sim:line", "baud": 115_200, "axis": axes}
    return RigConfig.model_validate(
        {
            "rig": "mortal",
            "sim": [{"name": "line", "module": [{"model": dialect.module}] * 2}],
            "bus": [bus | {"group": [{"name": "both", "axes": ["x", "y"]}]}],
        }
    )


@asynccontextmanager
async def powered(dialect: Dialect, axis: dict[str, object]) -> AsyncIterator[MortalRig]:
    settings = model(dialect.module)[1].model_copy(update={"version": dialect.version})
    chain = build_chain(ChainSpec((ModuleSpec(dialect.module, PLANT, settings),) * 2))
    async with mortal_rig(config_of(dialect, AXIS | axis), chain) as rig:
        for name in "xy":
            async with asyncio.timeout(10), rig.client.samples(name, "state") as states:
                async for _, state in states:
                    if state.state is AxisState.DISABLED:
                        break
            await rig.client.command(name, Power(on=True))
        yield rig


async def killed_after(rig: MortalRig, tried: Case, instant_s: float) -> None:
    """Send the command, and kill the daemon so much later: among its packets, its steps, or in mid-motion."""

    async def send() -> None:
        with contextlib.suppress(LdcndError):
            if isinstance(tried.command, MoveTogether):
                await rig.client.ask(tried.command)
            else:
                await rig.client.command("x", tried.command)

    if tried.before:
        await rig.client.command("x", tried.before)
        await asyncio.sleep(0.3)
    sending = asyncio.create_task(send(), name="command")
    await asyncio.sleep(instant_s)
    await rig.kill()
    sending.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await sending


async def travelled(rig: MortalRig, for_s: float) -> float:
    """Return how far the shafts turn from now on, in mm."""
    before = [drive.shaft.position_counts for drive in rig.drives()]
    await asyncio.sleep(for_s)
    after = [drive.shaft.position_counts for drive in rig.drives()]
    return max(abs(b - a) for a, b in zip(before, after, strict=True)) / COUNTS_PER_MM


async def ends_when_killed(dialect: Dialect, name: str, instant_s: float) -> None:
    tried = BOUNDED[name]
    async with powered(dialect, tried.axis) as rig:
        await killed_after(rig, tried, instant_s)
        await asyncio.sleep(tried.bound_s + BRAKING_S)

        assert await travelled(rig, 2.0) < STILL_MM, f"{dialect.name}, {name}: killed after {instant_s} s"


def instants(dialect: Dialect, name: str, count: int) -> list[float]:
    """Return instants at random, half of them among the packets that start the motion."""
    dice = random.Random(f"{dialect.name} {name}")
    return [dice.uniform(0.0, 0.02) if at % 2 else dice.uniform(0.02, BOUNDED[name].bound_s) for at in range(count)]


@pytest.mark.promise("motions-without-end")
@pytest.mark.parametrize("dialect", MODELS, **names)
@pytest.mark.parametrize("name", BOUNDED)
@pytest.mark.sweep(25)
async def test_a_motion_ends_within_its_bound_when_the_daemon_is_killed(dialect, name):
    if (dialect.name, name) in UNABLE:
        pytest.skip("the model has no such motion")
    for instant_s in instants(dialect, name, 2):
        await ends_when_killed(dialect, name, instant_s)


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("dialect", MODELS, **names)
@pytest.mark.parametrize("name", BOUNDED)
async def test_a_motion_ends_within_its_bound_whenever_the_daemon_is_killed(dialect, name):
    if (dialect.name, name) in UNABLE:
        pytest.skip("the model has no such motion")
    for instant_s in instants(dialect, name, 40):
        await ends_when_killed(dialect, name, instant_s)


@pytest.mark.parametrize("name", UNBOUNDED)
async def test_the_two_motions_that_the_docs_name_run_on_without_a_host(name):
    dialect = LS_173AP if name == "move_analog" else V4
    async with powered(dialect, {}) as rig:
        await killed_after(rig, UNBOUNDED[name], 0.3)

        assert await travelled(rig, HORIZON_S + BRAKING_S) > 1.0


@pytest.mark.parametrize(("dialect", "runs_on"), [(SC, False), (V4, True), (LS_182AP, True)], **names)
async def test_a_jog_that_was_changed_on_its_way_ends_without_a_host_on_sc_alone(dialect, runs_on):
    changed = Case(MoveVelocity(velocity=3.0), HORIZON_S, {}, MoveVelocity(velocity=2.0))
    async with powered(dialect, {}) as rig:
        await killed_after(rig, changed, 0.3)
        await asyncio.sleep(HORIZON_S + BRAKING_S)

        assert (await travelled(rig, 2.0) > 1.0) is runs_on


@pytest.mark.promise("jog-ends-in-drive")
@pytest.mark.parametrize(("dialect", "bound_s"), [(SC, 1.0), (V4, HORIZON_S), (LS_182AP, HORIZON_S)], **names)
@pytest.mark.sweep(2)
async def test_a_jog_that_is_held_ends_at_its_goal_in_the_drive_when_the_daemon_is_killed(dialect, bound_s):
    async with powered(dialect, {"jog_reach_s": HORIZON_S}) as rig:
        jog = await rig.client.command("x", Jog(velocity=4.0, hold_s=0.4))
        for _ in range(15):
            await asyncio.sleep(0.1)
            await rig.client.command("x", Jog(velocity=4.0, hold_s=0.4, renews=jog.command_id))
        await rig.kill()
        await asyncio.sleep(bound_s)  # twice `hold_s` with PIC-SERVO SC, `jog_reach_s` otherwise, and the ramp

        assert await travelled(rig, 2.0) < STILL_MM
