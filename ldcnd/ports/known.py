"""Ports of guests, for the configuration and the daemon: which lines can have one, and how it is served."""

import asyncio
from collections.abc import Sequence
from contextlib import ExitStack

from ldcnd.config.ports import GuestHost, PortConfig
from ldcnd.drives.driver import Drive
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.network import IoDriver
from ldcnd.line.bus import Bus
from ldcnd.log import get_logger
from ldcnd.ports.guest import Guest
from ldcnd.ports.terminal import GuestTerminal

log = get_logger("ports")


def check(port: PortConfig, line: BusConfig) -> None:
    """Refuse a port of another family; raises ValueError."""
    if line.family != "ldcn":
        raise ValueError(
            f"port {port.name}: bus {line.name} is of the family {line.family}; only ldcn lines have ports"
        )


async def serve(port: PortConfig, bus: Bus, drives: Sequence[Drive], ios: Sequence[IoDriver], host: GuestHost) -> None:
    """Serve a guest on a terminal until cancelled; a failure ends its port and nothing else."""
    try:
        async with asyncio.TaskGroup() as group:
            with ExitStack() as stack:
                terminal = GuestTerminal(port.link, int(port.mode, 8), stack)
                guest = Guest(port, bus, drives, ios, host, group)
                stack.callback(guest.close)

                def take(data: bytes, baud: int | None) -> None:
                    guest.chain.baud = baud or guest.chain.baud
                    guest.send(data)

                def closed() -> None:
                    group.create_task(guest.gone(), name=f"guest {port.name} gone")

                guest.receive, terminal.take, terminal.closed = terminal.write, take, closed
                log.info(
                    "port",
                    guest=port.name,
                    bus=port.bus,
                    link=str(port.link),
                    terminal=str(terminal.path),
                    access=port.access,
                )
                await asyncio.Event().wait()
    except Exception:
        log.exception("port ended", guest=port.name, bus=port.bus)
