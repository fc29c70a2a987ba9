"""A line opened by itself, without a daemon: for tools that examine it or try its drives."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TypeVar

from ldcnd.contract.errors import BusDown
from ldcnd.contract.health import Finding
from ldcnd.line.adapter import ports
from ldcnd.line.bus import Bus

__all__ = ["ports", "show_findings", "with_line"]

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


async def show_findings(bus: Bus, port: str, findings: AsyncIterator[Finding], show: Callable[[Finding], None]) -> None:
    """Open a line, show what is found on it, and close it.

    Raises:
        BusDown: the port does not open.
    """

    async def show_all() -> None:
        async for finding in findings:
            show(finding)

    await with_line(bus, port, show_all)
