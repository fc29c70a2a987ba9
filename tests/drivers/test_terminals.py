"""The daemon on terminals of the kernel, through an adapter that is unplugged and comes back under another name."""

import asyncio
import random
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from ldcnd.contract.commands import MoveAbsolute, MoveVelocity, Power, Reset, SetPosition
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import LinkState, Moving
from ldcnd.line.port_url import port_opener
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.pty import PtyLine
from tests.support.chain_rig import ChainRig, rig_on, simulated_config
from tests.support.plugged_rig import ENDLESS, MODELS, RATES
from tests.support.position_judge import PositionJudge
from tests.support.rig import EPOCH_NS
from tests.support.serial_adapter import LatencyTimer, TerminalAdapter, terminal_adapter

pytestmark = pytest.mark.real_time

AXES = ("x", "y", "z", "c")
DRIVEN = ("x", "y")
TURN_S = 0.05
BACK_TURNS = 2400
"""Turns of the loop, not seconds: on a busy machine daemon, drives and adapter have as few of them as this test."""
REST_S = 2.0
SETTLED_S = 0.7
SEEN_LATE_S = 0.3
TRIES = 5
UNPLUGS = 200


@dataclass(frozen=True)
class Bench:
    """A daemon, its drives in a thread of their own, and the adapter between them."""

    rig: ChainRig
    drives: tuple[SimulatedDrive, ...]
    adapter: TerminalAdapter

    async def up(self) -> None:
        """Wait until every axis is up."""
        for _ in range(BACK_TURNS):
            trackers = [self.rig.daemon.rig.axes[axis].tracker for axis in AXES]
            if all(tracker.status.link is LinkState.UP for tracker in trackers):
                return
            await asyncio.sleep(TURN_S)
        raise AssertionError(f"not back: {[tracker.status.link for tracker in trackers]}")

    async def moving(self, axis: str, velocity: float) -> None:
        """Let an axis move slowly towards the end of its travel."""
        client = self.rig.client
        await client.command(axis, Power(on=True))
        if not (await client.state(axis)).referenced:  # a slow host did not see it at rest after its reset
            await client.command(axis, SetPosition(position=0.0))
        await client.command(axis, MoveAbsolute(position=90.0, velocity=velocity))

    async def stand(self, *numbers: int) -> bool:
        """Tell whether drives truly stand."""
        before = [self.drives[number].shaft.position_counts for number in numbers]
        await asyncio.sleep(0.5)
        return all(
            abs(self.drives[number].shaft.position_counts - was) <= 2
            for number, was in zip(numbers, before, strict=True)
        )


@asynccontextmanager
async def bench(folder: Path, policy: str) -> AsyncIterator[Bench]:
    chain = build_chain(ChainSpec(tuple(ModuleSpec(model, ENDLESS) for model in MODELS), baud_check=True))
    config = simulated_config({**RATES, "loss": {"bus": policy}}, margin_ms=200, overload="skip", stop_probe_hz=0)
    stopped = threading.Event()
    link = folder / "ldcn-FT4ABCDE-00"
    with PtyLine(chain, baud_check=True) as line:
        thread = threading.Thread(target=line.run, args=(stopped.is_set,), name="line")
        thread.start()
        try:
            with terminal_adapter(line.path, link, LatencyTimer(0.001)) as adapter:
                opener = port_opener(str(link), 19_200, working_baud=115_200)
                async with rig_on(chain, config, opener=opener) as rig:
                    drives = tuple(module for module in chain.modules if isinstance(module, SimulatedDrive))
                    made = Bench(rig, drives, adapter)
                    await made.up()
                    yield made
        finally:
            stopped.set()
            thread.join(5)


@pytest.mark.long
async def test_a_stop_while_the_adapter_is_unplugged_is_carried_out_under_its_new_name(tmp_path: Path):
    async with bench(tmp_path, "run_to_target") as on:
        await on.moving("x", 1.5)
        await on.moving("y", 5.0)
        first = on.adapter.link.readlink()
        on.adapter.pull()
        await on.rig.until("x", lambda state: state.link is LinkState.DOWN)
        with suppress(LdcndError):
            await on.rig.client.stop()
        assert not await on.stand(1)
        on.adapter.push()
        await on.up()
        await asyncio.sleep(REST_S)

        assert await on.stand(0)
        assert await on.stand(1)
        assert [(await on.rig.client.state(axis)).stop_latched for axis in ("x", "y")] == [True, True]
        assert on.rig.line.bus.statistics.openings == 2
        assert on.adapter.link.readlink() != first or first.exists()


@pytest.mark.long
async def test_slow_motion_is_halted_when_the_adapter_is_back(tmp_path: Path):
    async with bench(tmp_path, "halt") as on:
        await on.moving("x", 1.5)
        on.adapter.pull()
        await on.rig.until("x", lambda state: state.link is LinkState.DOWN)
        on.adapter.push()
        await on.up()
        await asyncio.sleep(REST_S)

        assert await on.stand(0)
        await on.rig.until("x", lambda state: state.moving is Moving.NO)  # a busy machine may lose a reply just now


async def ready(on: Bench, judge: PositionJudge, axis: str) -> None:
    """Clear what the last round left, and give the axis a reference; on a busy machine a reply may come too late."""
    client = on.rig.client
    for left in reversed(range(TRIES)):
        try:
            await client.stop(axis)
            await on.rig.until(axis, lambda state: state.moving is Moving.NO)
            await client.command(axis, Reset())
            await client.command(axis, Power(on=True))
            judge.zero.pop(axis, None)
            await client.command(axis, SetPosition(position=0.0))
            judge.set_zero(axis)
        except LdcndError:
            if not left:
                raise
        else:
            return


async def stop(on: Bench) -> None:
    """Stop everything; what is not carried out yet is said, and stays latched."""
    with suppress(LdcndError):
        await on.rig.client.stop()


@pytest.mark.soak
@pytest.mark.timeout(7200)
async def test_two_hundred_unplugs_at_random_instants_lose_no_stop_and_publish_nothing_wrong(tmp_path: Path):
    seed = random.SystemRandom().randrange(1_000_000)
    print(f"seed {seed}")
    dice = random.Random(seed)
    loop = asyncio.get_running_loop()
    moving = lost = 0
    async with bench(tmp_path, "run_to_target") as on, asyncio.TaskGroup() as group:
        judge = PositionJudge(
            on.rig,
            DRIVEN,
            lambda axis: on.drives[DRIVEN.index(axis)],
            late_s=lambda sample: SEEN_LATE_S + loop.time() - (sample.t - EPOCH_NS) * 1e-9,
        )
        watching = group.create_task(judge.watch(), name="judge")
        for number in range(UNPLUGS):
            what = f"seed {seed}, round {number}"
            for axis in DRIVEN:
                await ready(on, judge, axis)
            for axis in DRIVEN:
                velocity = dice.choice([0.8, 5.0, 40.0])
                with suppress(LdcndError):
                    if dice.random() < 0.5:
                        await on.rig.client.command(axis, MoveVelocity(velocity=velocity))
                    else:
                        await on.rig.client.command(axis, MoveAbsolute(position=-90.0, velocity=velocity))
            when = dice.choice(["before", "away", "away", "after"])
            await asyncio.sleep(dice.uniform(0.0, 0.3))
            stopping = group.create_task(stop(on), name="stop") if when == "before" else None
            await asyncio.sleep(dice.uniform(0.0, 0.01))
            moving += sum(drive.shaft.velocity_counts != 0 for drive in on.drives[: len(DRIVEN)])
            on.adapter.pull()
            await asyncio.sleep(dice.choice([0.0, 0.05, dice.uniform(0.1, 1.0)]))
            if when == "away":
                stopping = group.create_task(stop(on), name="stop")
                await asyncio.sleep(dice.uniform(0.0, 0.05))
            on.adapter.push()
            await asyncio.sleep(2 * TURN_S)  # else it may not have been seen to go
            await on.up()
            await (stopping or stop(on))
            await asyncio.sleep(SETTLED_S)
            assert await on.stand(0, 1), what
            for axis in DRIVEN:
                state = await on.rig.until(axis, lambda state: state.moving is Moving.NO)
                assert state.stop_latched, f"{what}, {axis}"
                lost += not state.referenced
            assert judge.wrong == [], what
            if number % 20 == 19:
                print(f"{number + 1} rounds, {moving} axes moved, positions judged {judge.judged}", flush=True)
        watching.cancel()
        assert on.rig.line.bus.statistics.openings > UNPLUGS / 2
    print(f"{moving} axes moved, {lost} references lost, positions judged {judge.judged}")
    assert moving > UNPLUGS
    assert min(judge.judged.values()) > UNPLUGS / 4
