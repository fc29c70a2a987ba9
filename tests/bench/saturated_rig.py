"""A whole daemon on the jumping clock whose line is asked for more polls than it can carry."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from ldcnd.config.rig import RigConfig
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.rig import RunningRig, running_rig

ResultT = TypeVar("ResultT")


def saturating(drives: int, **bus_settings: object) -> RigConfig:
    """Return a rig that wants more polls than its line can carry, with other settings of its line."""
    axes = [
        {
            "name": f"a{number}",
            "address": number,
            "model": "ls-182ap",
            "velocity": 1.0,
            "acceleration": 1.0,
            "rates": {"position": 2000.0, "velocity": 2000.0, "adc": 2000.0, "state": 1.0},
        }
        for number in range(1, drives + 1)
    ]
    bus = {"name": "line0", "port": "sim:line0", "baud": 115_200, "overload": "skip", "axis": axes, **bus_settings}
    modules = [{"model": "ls182ap"}] * drives
    return RigConfig.model_validate({"rig": "bench", "bus": [bus], "sim": [{"name": "line0", "module": modules}]})


def saturating_smartsteps() -> RigConfig:
    """Return a rig of two SmartSteps that wants more words than their line can carry."""
    rates = {"position": 10.0, "velocity": 50.0, "state": 20.0}
    axes = [{"name": f"s{unit}", "address": unit, "model": "smartstep", "rates": rates} for unit in (1, 2)]
    bus = {"name": "steps", "port": "sim:steps", "family": "smartstep", "axis": axes}
    sim = {"name": "steps", "unit": [{"number": unit} for unit in (1, 2)]}
    return RigConfig.model_validate({"rig": "bench", "bus": [bus], "sim": [sim]})


def on_jumping_clock(config: RigConfig, work: Callable[[RunningRig], Awaitable[ResultT]]) -> ResultT:
    """Run a rig on a loop of its own for as long as some work takes."""

    async def within() -> ResultT:
        async with running_rig(config) as rig:
            return await work(rig)

    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        return runner.run(within())
