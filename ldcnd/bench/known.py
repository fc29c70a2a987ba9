"""The families that the bench knows, the one list of them, and lines opened by themselves, without a daemon."""

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from contextlib import aclosing
from typing import Any, TypeVar

from ldcnd.bench.family import BenchFamily
from ldcnd.config.rig import RigConfig
from ldcnd.config.simulated import simulator
from ldcnd.contract.errors import BusDown
from ldcnd.contract.health import Finding
from ldcnd.drives.family import UnopenedLine
from ldcnd.drives.known import FAMILIES, ByName
from ldcnd.drives.line_config import BusConfig
from ldcnd.line.bus import Bus
from ldcnd.line.ports_here import ports_here

__all__ = ["BENCHES", "HOMES", "line_of", "ports_here", "show_findings", "with_line"]

OPEN_TIME_S = 5.0
ResultT = TypeVar("ResultT")


async def _opened(bus: Bus, port: str) -> None:
    """Wait until a line is open."""
    try:
        async with asyncio.timeout(OPEN_TIME_S):
            await bus.wait_opened()
    except TimeoutError:
        why = bus.loss_reason or f"{port} did not open within {OPEN_TIME_S:g} s"
        remedy = "end the daemon that has it, or correct the port"
        raise BusDown(f"bus {bus.settings.name}: {why}", remedy=remedy) from None


async def with_line(bus: Bus, port: str, use: Callable[[], Awaitable[ResultT]]) -> ResultT:
    """Open a line, use it, and close it.

    Raises:
        BusDown: the port does not open.
    """
    name = bus.settings.name
    try:
        async with asyncio.TaskGroup() as group:
            owner = group.create_task(bus.run(), name=f"bus {name}")
            try:
                await _opened(bus, port)
                return await use()
            finally:
                owner.cancel()
    except BaseExceptionGroup as errors:  # what `use` raises is no group to its caller
        if len(errors.exceptions) > 1:
            raise
        raise errors.exceptions[0] from None


async def show_findings(
    bus: Bus, port: str, findings: AsyncGenerator[Finding], show: Callable[[Finding], None]
) -> None:
    """Open a line, show what is found on it, and close it.

    Raises:
        BusDown: the port does not open.
    """

    async def show_all() -> None:
        async with aclosing(findings):  # what they have begun ends while the line is open, whatever becomes of `show`
            async for finding in findings:
                show(finding)

    await with_line(bus, port, show_all)


HOMES = {"ldcn": "ldcnd.bench.ldcn.family:LDCN_BENCH", "smartstep": "ldcnd.bench.smartstep.family:SMARTSTEP_BENCH"}
"""The module of what the bench does with each family, and behind the colon its name there."""
BENCHES: Mapping[str, BenchFamily[Any]] = ByName(HOMES)


def line_of(rig: RigConfig, settings: BusConfig) -> UnopenedLine:
    """Return a line of a configuration that is not open yet, also a simulated one.

    Raises:
        ConfigError: it is simulated, and there is no simulator.
    """
    opener = simulator().opener_of(settings, rig.sim) if settings.simulated else None
    return FAMILIES[settings.family].open_lines(None)(settings, opener)
