"""A daemon whose line hangs on an adapter that can be unplugged, on the jumping clock."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from ldcnd.config.rig import RigConfig
from ldcnd.contract.samples import LinkState
from ldcnd.sim.chain import Chain, Delivery
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.plant import MotorPlant
from tests.support.chain_rig import ChainRig, drive, rig_on, simulated_config
from tests.support.serial_adapter import AT_ONCE, Holding, Plug

MODELS = ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")
RATES = {"rates": {"position": 4, "velocity": 4, "adc": 1, "state": 4}}
X, Y = 1, 2
"""Addresses."""
ENDLESS = MotorPlant(reverse_limit_counts=-(10**9), forward_limit_counts=10**9)
"""What moves round after round must not come to rest because it has reached the end of its travel."""


@dataclass(frozen=True)
class Plugged:
    """A daemon, the drives, and the adapter between them."""

    rig: ChainRig
    chain: Chain
    plug: Plug

    async def outage(self, for_s: float = 1.0, *, name: str | None = None) -> None:
        """Pull the plug, and push it in again after a while; the line is up again afterwards."""
        self.plug.pull()
        await self.rig.until("x", lambda state: state.link is LinkState.DOWN)
        await asyncio.sleep(for_s)
        self.plug.push(name)
        await self.back()

    async def back(self) -> None:
        """Wait until every axis is up."""
        for axis in ("x", "y", "z", "c"):
            await self.rig.until(axis, lambda state: state.link is LinkState.UP)

    async def stands(self, address: int) -> bool:
        """Tell whether a drive truly stands."""
        before = drive(self.chain, address).shaft.position_counts
        await asyncio.sleep(0.5)
        return abs(drive(self.chain, address).shaft.position_counts - before) < 2


def slow_config(**axes: object) -> RigConfig:
    """Return the simulated rig for slow adapters, with these settings of all its axes."""
    return simulated_config({**RATES, **axes}, margin_ms=25, overload="skip")


@asynccontextmanager
async def plugged(holding: Holding = AT_ONCE, settings: RigConfig | None = None) -> AsyncIterator[Plugged]:
    """Run a daemon on an adapter until the context ends; its line is up when the context begins.

    Args:
        holding: what the adapter does with replies.
        settings: the rig; `slow_config` if missing.
    """
    chain = build_chain(ChainSpec(tuple(ModuleSpec(model, ENDLESS) for model in MODELS), delivery=Delivery.BYTEWISE))
    plug = Plug(chain, holding)
    async with rig_on(chain, settings or slow_config(), opener=plug.open) as rig:
        line = Plugged(rig, chain, plug)
        await line.back()
        yield line
