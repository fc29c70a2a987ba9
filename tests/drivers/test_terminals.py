"""The daemon on terminals of the kernel, through an adapter that is unplugged and comes back under another name."""

import asyncio
import random
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from ldcnd.errors import LdcndError
from ldcnd.model.commands import MoveAbsolute, Power, Reset
from ldcnd.model.samples import LinkState, Moving
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.pty import PtyLine
from ldcnd.transport.port_url import port_opener
from tests.support.chain_rig import ChainRig, rig_on, simulated_config
from tests.support.plugged_rig import MODELS, RATES
from tests.support.serial_adapter import LatencyTimer, TerminalAdapter, terminal_adapter

pytestmark = pytest.mark.real_time

AXES = ("x", "y", "z", "c")
BACK_S = 30.0
REST_S = 2.0


@dataclass(frozen=True)
class Bench:
    """A daemon, its drives in a thread of their own, and the adapter between them."""

    rig: ChainRig
    drives: tuple[SimulatedDrive, ...]
    adapter: TerminalAdapter

    async def up(self) -> None:
        """Wait until every axis is up."""
        async with asyncio.timeout(BACK_S):
            for axis in AXES:
                await self.rig.until(axis, lambda state: state.link is LinkState.UP)

    async def moving(self, axis: str, velocity: float) -> None:
        """Let an axis move slowly towards the end of its travel."""
        await self.rig.client.command(axis, Power(on=True))
        await self.rig.client.command(axis, MoveAbsolute(position=90.0, velocity=velocity))

    async def stands(self, number: int) -> bool:
        """Tell whether a drive truly stands."""
        before = self.drives[number].loop.position
        await asyncio.sleep(0.5)
        return abs(self.drives[number].loop.position - before) <= 2


@asynccontextmanager
async def bench(folder: Path, policy: str) -> AsyncIterator[Bench]:
    chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS), baud_check=True))
    config = simulated_config({**RATES, "loss": {"bus": policy}}, margin_ms=100, overload="skip", stop_probe_hz=0)
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


async def test_a_stop_while_the_adapter_is_unplugged_is_carried_out_under_its_new_name(tmp_path: Path):
    async with bench(tmp_path, "run_to_target") as on:
        await on.moving("x", 1.5)
        await on.moving("y", 5.0)
        first = on.adapter.link.readlink()
        on.adapter.pull()
        await on.rig.until("x", lambda state: state.link is LinkState.DOWN)
        with suppress(LdcndError):
            await on.rig.client.stop()
        assert not await on.stands(1)
        on.adapter.push()
        await on.up()
        await asyncio.sleep(REST_S)

        assert await on.stands(0)
        assert await on.stands(1)
        assert [(await on.rig.client.state(axis)).stop_latched for axis in ("x", "y")] == [True, True]
        assert on.rig.line.bus.statistics.openings == 2
        assert on.adapter.link.readlink() != first or first.exists()


async def test_slow_motion_is_halted_when_the_adapter_is_back(tmp_path: Path):
    async with bench(tmp_path, "halt") as on:
        await on.moving("x", 1.5)
        on.adapter.pull()
        await on.rig.until("x", lambda state: state.link is LinkState.DOWN)
        on.adapter.push()
        await on.up()
        await asyncio.sleep(REST_S)

        assert await on.stands(0)
        assert (await on.rig.client.state("x")).moving is Moving.NO


@pytest.mark.soak
@pytest.mark.timeout(3600)
async def test_two_hundred_unplugs_at_random_instants_lose_no_stop(tmp_path: Path):
    seed = random.SystemRandom().randrange(1_000_000)
    print(f"seed {seed}")
    dice = random.Random(seed)
    async with bench(tmp_path, "run_to_target") as on:
        for number in range(200):
            for axis in ("x", "y"):
                with suppress(LdcndError):
                    await on.rig.client.command(axis, Reset())
                    await on.moving(axis, dice.choice([0.8, 5.0, 40.0]) * dice.choice([1.0, 0.5]))
            await asyncio.sleep(dice.uniform(0.0, 0.3))
            stops_first = dice.random() < 0.3
            stopping = [on.rig.client.stop()] if stops_first else []
            for stop in stopping:
                with suppress(LdcndError):
                    await stop
            on.adapter.pull()
            await asyncio.sleep(dice.choice([0.0, 0.05, dice.uniform(0.1, 1.0)]))
            if not stops_first:
                with suppress(LdcndError):
                    await on.rig.client.stop()
            on.adapter.push()
            await on.up()
            await asyncio.sleep(REST_S)
            for drive in (0, 1):
                assert await on.stands(drive), f"seed {seed}, round {number}, drive {drive + 1}"
