"""The daemon's own driver as the host that comes after somebody else."""

import asyncio
import contextlib

from ldcnd.contract.errors import NetworkMismatch
from ldcnd.drives.driver import AxisSpec
from ldcnd.drives.ldcn.config import LineSpec, ModuleConfig
from ldcnd.drives.ldcn.network import ldcn_line
from ldcnd.drives.ldcn.profiles import Support
from ldcnd.drives.network import BringUpReport
from ldcnd.line.settings import BusSettings
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.module import SimulatedModule
from ldcnd.sim.line import open_simulated_line


async def bring_up(chain: Chain, baud: int = 115_200, attempts: int = 1) -> BringUpReport:
    """Bring a chain up from whatever state it is in, as the daemon does at start.

    Raises:
        LdcndError: it is not possible.
    """
    modules = [module for module in chain.modules if isinstance(module, SimulatedModule)]
    drives, others = [], []
    for address, module in enumerate(modules, 1):
        name, identity = module.profile.name, (module.profile.device_id, module.settings.version)
        if module.profile.support is Support.FULL:
            drives.append(AxisSpec(f"a{address}", address, name, None, identity))
        else:
            others.append(ModuleConfig(address=address, model=name, identity=identity))
    line = LineSpec(modules=tuple(others))
    settings = BusSettings("clean", 19_200)
    bus, network = ldcn_line(settings, lambda: open_simulated_line(chain), tuple(drives), baud, line)
    async with asyncio.TaskGroup() as group:
        running = group.create_task(bus.run(), name="bus")
        try:
            await bus.wait_opened()
            for _ in range(1, attempts):
                with contextlib.suppress(NetworkMismatch):
                    return await network.bring_up()
            return await network.bring_up()
        finally:
            running.cancel()
