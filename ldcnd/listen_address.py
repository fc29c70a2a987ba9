"""Where a server listens: HOST:PORT."""

import ipaddress
from dataclasses import dataclass

from ldcnd.contract.errors import ConfigError

HIGHEST_PORT = 0xFFFF


@dataclass(frozen=True, slots=True)
class ListenAddress:
    """Where to listen.

    Attributes:
        host: a name or an IP address, without brackets.
        port: 0 is any free one.
    """

    host: str
    port: int

    @property
    def is_loopback(self) -> bool:
        """No other machine can connect to it."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def in_url(self) -> str:
        """The host as it stands in a URL and in the Host header."""
        return f"[{self.host}]" if ":" in self.host else self.host


def parse_listen_address(text: str) -> ListenAddress:
    """Return the address that is written as HOST:PORT, an IPv6 address in brackets or without.

    Raises:
        ConfigError: it is not.
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isdecimal() or int(port) > HIGHEST_PORT:
        raise ConfigError(f"{text!r} is not HOST:PORT", value=text, remedy="write it like 127.0.0.1:8470 or [::1]:8470")
    return ListenAddress(host, int(port))
