"""Which pipe a configured port stands for: a device path, a pattern of one, or an address of a serial server."""

import asyncio
import re
from pathlib import Path
from urllib.parse import urlsplit

from ldcnd.contract.errors import ConfigError, TransportLost
from ldcnd.line.ports_here import port_matching
from ldcnd.line.rfc2217_port import open_rfc2217_port
from ldcnd.line.tcp_port import open_tcp_port
from ldcnd.line.transport import Framing, Opener, Rs485Config, Transport
from ldcnd.own_thread import OwnThread

SOCKET, RFC2217, MATCHING = "socket://", "rfc2217://", "hwgrep://"
KINDS = f"a device path, {SOCKET}host:port, {RFC2217}host:port or {MATCHING}PATTERN"
"""In words, what a port can be; a simulated one is none."""


def port_opener(
    port: str, baud: int, framing: Framing = "8n1", *, working_baud: int | None = None, rs485: Rs485Config | None = None
) -> Opener:
    """Return what opens the port; nothing is opened yet.

    Args:
        port: a device path, hwgrep:// with a regular expression that fits one, or socket://host:port or
            rfc2217://host:port with an IPv6 address in brackets.
        baud: the rate of a port; a serial server behind socket:// keeps its own.
        framing: the framing of a port; a serial server behind socket:// keeps its own.
        working_baud: the rate that a port is changed to later.
        rs485: have the kernel switch the transmitter of a device.

    Raises:
        ConfigError: the port is none of these.
    """
    check_port(port)
    if is_here(port):

        async def open_here() -> Transport:
            # clients read configurations too, also where there are no terminals of POSIX
            from ldcnd.line.serial_port import SerialSettings, open_serial_port  # noqa: PLC0415

            # a pattern is looked for in sysfs, which must not hold up the loop
            path = await asyncio.get_running_loop().run_in_executor(OwnThread("ports"), _device, port)
            return await open_serial_port(SerialSettings(path, baud, framing, working_baud=working_baud, rs485=rs485))

        return open_here
    host, number = _server(port)
    if port.startswith(RFC2217):
        bauds = (working_baud, baud) if working_baud else (baud,)
        return lambda: open_rfc2217_port(host, number, framing, bauds)
    return lambda: open_tcp_port(host, number)


def check_port(port: str) -> None:
    """Refuse what no port can be.

    Raises:
        ConfigError: it is none of `KINDS`.
    """
    try:
        if port.startswith(MATCHING):
            re.compile(port.removeprefix(MATCHING))
        elif not port.startswith("/"):
            _server(port)
    except (ValueError, re.error) as error:
        message, remedy = f"port {port!r} is not {KINDS}: {error}", "correct the port"
        if "://" not in port:  # a daemon has a folder of its own, in which a path would mean another place
            message, remedy = (
                f"port {port!r} is not {KINDS}",
                f"write a device with its whole path: {Path(port).absolute()}",
            )
        raise ConfigError(message, value=port, remedy=remedy) from None


def is_here(port: str) -> bool:
    """Tell whether a port is one of this machine."""
    return port.startswith(("/", MATCHING))


def device_of(port: str) -> Path | None:
    """Return the device of a port of this machine; None for one elsewhere, and where no device fits a pattern."""
    try:
        return Path(_device(port)) if is_here(port) else None
    except TransportLost:
        return None


def _device(port: str) -> str:
    return port_matching(port.removeprefix(MATCHING)) if port.startswith(MATCHING) else port


def _server(port: str) -> tuple[str, int]:
    parts = urlsplit(port)
    if port.startswith((SOCKET, RFC2217)) and parts.hostname and parts.port and not parts.path + parts.query:
        return parts.hostname, parts.port
    raise ValueError("it has no host and port")
