"""Echoes, replies twice, replies to something older, a node that babbles: no false value, and stops go through."""

import asyncio
import random
from collections.abc import Callable
from functools import partial

import pytest

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.samples import PositionSample, Quality, TelemetryItem
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.rig import running_rig

ROUGH_FROM_S, ROUGH_FOR_S = 8.0, 20.0
PLACES = {"x": 30.0, "y": -30.0}
MODELS = ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")


def with_faults(*faults: LineFault, seed: int = 7) -> Chain:
    plan = FaultPlan(faults, seed=seed)
    return build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS), faults=plan, seed=seed))


def echoing() -> Chain:
    return with_faults(LineFault(FaultKind.ECHO, 0.3, from_s=ROUGH_FROM_S))


def duplicating() -> Chain:
    return with_faults(LineFault(FaultKind.REPLY_DUPLICATED, 0.3, from_s=ROUGH_FROM_S))


def swapping(seed: int = 7) -> Chain:
    """A reply that is later than its exchange may take (50 ms here) is heard after a later request."""
    return with_faults(LineFault(FaultKind.REPLY_DELAYED, 0.2, from_s=ROUGH_FROM_S, longest_s=0.1), seed=seed)


def babbling() -> Chain:
    chain, dice = with_faults(), random.Random(7)
    real = chain.advance

    def advance(now_s: float) -> list[tuple[float, bytes]]:
        heard = real(now_s)
        if now_s >= ROUGH_FROM_S and dice.random() < 0.1:
            heard.append((now_s, dice.randbytes(dice.randint(1, 4))))
        return heard

    chain.advance = advance  # type: ignore[method-assign]
    return chain


async def watched(client: RigClient, axis: str, found: list[PositionSample]) -> None:
    async with client.samples(axis, TelemetryItem.POSITION) as positions:
        async for _, sample in positions:
            assert isinstance(sample, PositionSample)
            found.append(sample)


AGREEING, AFTER_A_GAP = 40, 53
"""Seeds with which two late replies of the other axis agree, and with which one comes when an axis was out of reach."""


@pytest.mark.parametrize(
    "line",
    [
        echoing, duplicating, swapping, babbling,
        pytest.param(partial(swapping, AGREEING), id="agreeing"),
        pytest.param(partial(swapping, AFTER_A_GAP), id="after_a_gap"),
    ],
)  # fmt: skip
@pytest.mark.sweep(6)
async def test_a_rough_line_shows_no_false_position_and_lets_stops_through(line: Callable[[], Chain]):
    loop = asyncio.get_running_loop()
    found: dict[str, list[PositionSample]] = {axis: [] for axis in PLACES}
    async with running_rig(chains={"line0": line()}) as rig, asyncio.TaskGroup() as group:
        for axis, place in PLACES.items():
            await rig.until(axis, lambda state: state.link == "up")
            await rig.client.command(axis, Power(on=True))
            reply = await rig.client.command(axis, MoveAbsolute(position=place))
            await rig.client.wait_for_end(axis, reply.command_id)
        assert loop.time() < ROUGH_FROM_S - 1.0  # both stand before anything is wrong
        await asyncio.sleep(ROUGH_FROM_S - 1.0 - loop.time())
        watching = [group.create_task(watched(rig.client, axis, found[axis]), name=f"watch {axis}") for axis in PLACES]
        await asyncio.sleep(ROUGH_FOR_S)

        began_s = loop.time()
        stopped = await rig.client.stop("x", timeout_s=10.0)
        took_s = loop.time() - began_s
        state = await rig.client.state("x")
        for task in watching:
            task.cancel()

    false = [
        (axis, sample.value)
        for axis, place in PLACES.items()
        for sample in found[axis]
        if sample.quality is Quality.GOOD and abs(sample.value - place) > 0.05
    ]
    print(
        f"{ {axis: len(each) for axis, each in found.items()} } samples, stopped {stopped.confirmed} in {took_s:.3f} s"
    )
    assert all(len(samples) > 30 for samples in found.values())
    assert false == []
    assert took_s < 5.0
    assert state
    assert state.stop_latched
