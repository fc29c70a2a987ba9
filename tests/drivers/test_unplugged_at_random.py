"""The plug is pulled at random instants of whatever a rig does.

No stop is lost, no wrong value passes for a good one, no reference is kept that is wrong, and the line is always back
without a restart of the daemon.
"""

import asyncio
import contextlib
import random

import pytest

from ldcnd.contract.commands import Halt, Home, MoveAbsolute, MoveVelocity, Power, Reset, SetPosition
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import AxisState, LinkState, Moving
from tests.support.chain_rig import drive
from tests.support.plugged_rig import Plugged, X, Y, plugged, slow_config
from tests.support.position_judge import PositionJudge

AXES = {"x": X, "y": Y}
BACK_S = 20.0
REST_S = 2.0
SEEN_LATE_S = 0.3
"""A position that is published as good is no older."""
AGAIN_S = 0.3
"""How long a run of unplugging takes at least: nothing may depend on a line that has come to rest."""


async def ready(line: Plugged, judge: PositionJudge, axis: str) -> None:
    """Clear what the last round left, and give the axis a reference in the middle of its travel."""
    client = line.rig.client
    await client.stop(axis)
    await line.rig.until(axis, lambda state: state.moving is Moving.NO)
    await client.command(axis, Reset())
    await client.command(axis, Power(on=True))
    await client.command(axis, SetPosition(position=0.0))
    judge.set_zero(axis)


async def act(line: Plugged, judge: PositionJudge, axis: str, dice: random.Random) -> None:
    """Begin something."""
    client = line.rig.client
    velocity = dice.choice([0.8, 1.5, 5.0, 40.0])
    match dice.choice(["move", "velocity", "home", "halt", "rest"]):
        case "move":
            target = dice.choice([-60.0, 60.0])
            await client.command(axis, MoveAbsolute(position=target, velocity=velocity))
        case "velocity":
            await client.command(axis, MoveVelocity(velocity=min(velocity, 5.0)))
        case "home":
            judge.zero.pop(axis)  # the reference is another one from now on, or none
            await client.command(axis, Home())
        case "halt":
            await client.command(axis, MoveAbsolute(position=60.0, velocity=velocity))
            await asyncio.sleep(dice.uniform(0.0, 0.4))
            await client.command(axis, Halt())


async def stop(line: Plugged, after_s: float) -> None:
    await asyncio.sleep(after_s)
    with contextlib.suppress(LdcndError):  # not carried out yet: the answer says so, the stop stays latched
        await line.rig.client.stop()


async def round_of(line: Plugged, judge: PositionJudge, dice: random.Random, *, halts: bool) -> None:
    """Let two axes do something, pull the plug meanwhile, stop before, during or after the outage or not at all."""
    loop = asyncio.get_running_loop()
    for axis in AXES:
        await ready(line, judge, axis)
    outage_s = dice.choice([0.0, 0.05, dice.uniform(0.1, 1.5)])
    stops_after_s = dice.choice([None, dice.uniform(0.0, 0.6), dice.uniform(0.0, 2.5)])
    restarts = outage_s > 0.1 and dice.random() < 0.15
    began_s = loop.time()
    async with asyncio.TaskGroup() as group:
        for axis in AXES:
            group.create_task(attempt(act(line, judge, axis, dice)), name=f"act {axis}")
        if stops_after_s is not None:
            group.create_task(stop(line, stops_after_s), name="stop")
        await asyncio.sleep(dice.uniform(0.0, 0.6))
        line.plug.pull()
        if restarts:
            line.chain.modules[X - 1].power(on=False, at_s=loop.time())
        await asyncio.sleep(outage_s)
        if restarts:
            line.chain.modules[X - 1].power(on=True, at_s=loop.time())
        line.plug.push(f"ttyUSB{dice.randrange(3)}")
    async with asyncio.timeout(BACK_S):
        await asyncio.sleep(max(0.0, began_s + AGAIN_S - loop.time()))
        for axis in ("x", "y", "z", "c"):
            await line.rig.until(axis, lambda state: state.link is LinkState.UP)
    await asyncio.sleep(REST_S)

    for axis, address in AXES.items():
        state = await line.rig.client.state(axis)
        what = f"{axis}: {state.state}, stop {stops_after_s}, outage {outage_s:.3f}, restarted {restarts}"
        if stops_after_s is not None:
            assert state.stop_latched, what
        if stops_after_s is not None or (halts and state.state is AxisState.ERROR_STOP):
            assert await line.stands(address), what
        assert not state.referenced, what  # what happened to the machine meanwhile is not known
    assert judge.wrong == []


async def attempt(action) -> None:
    with contextlib.suppress(LdcndError):
        await action


async def unplug(times: int, seed: int, policy: str) -> None:
    print(f"seed {seed}, loss.bus = {policy}")
    dice = random.Random(seed)
    async with plugged(settings=slow_config(loss={"bus": policy})) as line, asyncio.TaskGroup() as group:
        judge = PositionJudge(
            line.rig, tuple(AXES), lambda axis: drive(line.chain, AXES[axis]), late_s=lambda _sample: SEEN_LATE_S
        )
        watching = group.create_task(judge.watch(), name="judge")
        for number in range(times):
            try:
                await round_of(line, judge, dice, halts=policy == "halt")
            except AssertionError as error:
                raise AssertionError(f"seed {seed}, round {number}: {error}") from error
        watching.cancel()
        assert line.rig.line.bus.statistics.openings > times
        assert min(judge.judged.values()) > times


@pytest.mark.parametrize("policy", ["halt", "run_to_target"])
@pytest.mark.sweep(2)
async def test_a_rig_survives_a_plug_that_is_pulled_at_any_instant(policy):
    await unplug(times=8, seed=20, policy=policy)


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("policy", ["halt", "run_to_target"])
async def test_a_rig_survives_a_plug_that_is_pulled_two_hundred_times(policy):
    await unplug(times=200, seed=random.SystemRandom().randrange(1_000_000), policy=policy)
