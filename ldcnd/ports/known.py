"""Ports of guests, for the configuration and the daemon: which lines can have one, and how it is served."""

import asyncio
from collections.abc import Sequence
from contextlib import AsyncExitStack

from ldcnd.config.ports import GuestHost, PortConfig
from ldcnd.contract.keys import RIG_ITSELF
from ldcnd.drives.driver import Drive
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.network import IoDriver
from ldcnd.drives.smartstep.drive import SmartStepAxis
from ldcnd.line.bus import Bus, caused_by
from ldcnd.listen_address import parse_listen_address
from ldcnd.log import get_logger
from ldcnd.ports.door import Door
from ldcnd.ports.guest import Guest
from ldcnd.ports.guest_units import UnitsGuest
from ldcnd.ports.tcp import GuestSocket
from ldcnd.ports.terminal import GuestTerminal

log = get_logger("ports")

TRIED_AGAIN_S = 5.0
"""How often a port that cannot be opened is tried again, seconds."""


FAMILIES = ("ldcn", "smartstep")


def check(port: PortConfig, line: BusConfig) -> None:
    """Refuse a port of another family; raises ValueError."""
    if line.family not in FAMILIES:
        raise ValueError(
            f"port {port.name}: bus {line.name} is of the family {line.family}; ports are for {' and '.join(FAMILIES)}"
        )


async def serve(port: PortConfig, bus: Bus, drives: Sequence[Drive], ios: Sequence[IoDriver], host: GuestHost) -> None:
    """Serve a guest on a terminal or a TCP address until cancelled; a failure ends its port and nothing else."""
    said = ""
    while True:
        try:
            await _serve_once(port, bus, drives, ios, host)
        except (OSError, LookupError) as error:
            if (reason := str(error)) != said:
                said = reason
                log.error("the port cannot be served and is tried again", guest=port.name, reason=reason)
                host.refuse(RIG_ITSELF, f"the port {port.name} is not served and is tried again: {reason}", port.name)
            host.show(port.name, None, f"not served, tried again: {reason}")
            await asyncio.sleep(TRIED_AGAIN_S)
        except Exception:
            log.exception("port ended", guest=port.name, bus=port.bus)
            host.refuse(RIG_ITSELF, f"the port {port.name} has ended by a fault of its own", port.name)
            host.show(port.name, None, "has ended by a fault of its own, see the daemon's log")
            return


async def _serve_once(
    port: PortConfig, bus: Bus, drives: Sequence[Drive], ios: Sequence[IoDriver], host: GuestHost
) -> None:
    """Open a port and serve it until cancelled.

    Raises:
        OSError, LookupError: it cannot be opened.
    """
    async with AsyncExitStack() as opened:
        opened.enter_context(caused_by(port.name))
        door, where = await _open(port, opened)
        async with asyncio.TaskGroup() as group, AsyncExitStack() as stack:
            guest: Guest | UnitsGuest
            if any(isinstance(drive, SmartStepAxis) for drive in drives):
                guest = UnitsGuest(port, bus, drives, host, group)
            else:
                guest = Guest(port, bus, drives, ios, host, group)
            stack.callback(guest.close)
            stack.callback(host.show, port.name, None)

            def closed(left: bytes, baud: int | None) -> None:
                if not guest.ended:
                    guest.leave(left, baud)
                    group.create_task(guest.gone(), name=f"guest {port.name} gone")

            guest.receive, guest.hang_up, door.take, door.closed = door.write, door.leave, guest.send, closed
            host.show(port.name, guest)
            log.info("port", guest=port.name, bus=port.bus, access=port.access, **where)
            if port.beyond_loopback:
                log.warning("every machine that reaches this address can use the port", guest=port.name, **where)
            await asyncio.Event().wait()


async def _open(port: PortConfig, stack: AsyncExitStack) -> tuple[Door, dict[str, str]]:
    """Open where the program comes in; return that, and what the log says of it."""
    if port.link is not None:
        terminal = GuestTerminal(port.link, int(port.mode, 8), port.group)
        stack.callback(terminal.close)
        return terminal, {"link": str(port.link), "terminal": str(terminal.path)}
    door = GuestSocket(rfc2217=port.rfc2217)
    server = await door.listen(parse_listen_address(port.listen or ""))
    stack.callback(server.close)
    stack.callback(door.leave)
    return door, {"listen": port.listen or ""}
