"""Which pipe a configured port stands for: a device path or `socket://host:port`."""

from urllib.parse import urlsplit

from ldcnd.contract.errors import ConfigError
from ldcnd.line.tcp_port import open_tcp_port
from ldcnd.line.transport import Framing, Opener, Rs485Config

SOCKET = "socket://"


def port_opener(
    port: str, baud: int, framing: Framing = "8n1", *, working_baud: int | None = None, rs485: Rs485Config | None = None
) -> Opener:
    """Return what opens the port; nothing is opened yet.

    Args:
        port: a device path, or socket://host:port with an IPv6 address in brackets.
        baud: the rate of a device; a serial server keeps its own.
        framing: the framing of a device; a serial server keeps its own.
        working_baud: the rate that a device is changed to later.
        rs485: have the kernel switch the transmitter of a device.

    Raises:
        ConfigError: the port is neither.
    """
    if port.startswith("/"):
        # clients read configurations too, also where there are no terminals of POSIX
        from ldcnd.line.serial_port import SerialSettings, open_serial_port  # noqa: PLC0415

        settings = SerialSettings(port, baud, framing, working_baud=working_baud, rs485=rs485)
        return lambda: open_serial_port(settings)
    host, number = _socket_address(port)
    return lambda: open_tcp_port(host, number)


def _socket_address(port: str) -> tuple[str, int]:
    try:
        parts = urlsplit(port) if port.startswith(SOCKET) else None
        if parts and parts.hostname and parts.port:
            return parts.hostname, parts.port
    except ValueError:
        pass
    raise ConfigError(
        f"port {port!r} is neither a device path nor socket://host:port", value=port, remedy="correct the port"
    )
