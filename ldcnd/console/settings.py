"""How the console is served, and what it refuses: from other machines it takes TLS and a token."""

import stat
from dataclasses import dataclass
from pathlib import Path

from ldcnd.console.rigs import Endpoint
from ldcnd.contract.errors import ConfigError
from ldcnd.listen_address import ListenAddress

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
SHORTEST_TOKEN = 32
"""Characters; as many random ones cannot be guessed."""
EVERY_ADDRESS = frozenset({"0.0.0.0", "::"})  # noqa: S104 - what is listened on is the operator's choice


@dataclass(frozen=True, slots=True)
class ConsoleSettings:
    """The settings of the console.

    Attributes:
        endpoints: the Zenoh endpoints of its sessions.
        rigs: these only; none means all that are found.
        address: where to listen.
        hosts: names under which browsers reach it, beside the address.
        certificate: PEM file with the chain; None serves plain HTTP.
        key: PEM file with its key.
        token: lets every browser in that has it; None hands out links that work once.
        as_json: print the link as a line of JSON.
        with_input: end when the standard input ends.
    """

    endpoints: tuple[Endpoint, ...]
    rigs: tuple[str, ...]
    address: ListenAddress
    hosts: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    token: str | None = None
    as_json: bool = False
    with_input: bool = False

    def __post_init__(self) -> None:
        """Refuse settings that would admit unauthorised visitors.

        Raises:
            ConfigError: says what is missing.
        """
        if (self.certificate is None) is not (self.key is None):
            raise ConfigError("--certificate and --key belong together")
        if self.address.is_loopback:
            return
        missing = [
            option for option, given in (("--certificate and --key", self.certificate), ("--token-file", self.token))
            if not given
        ]  # fmt: skip
        if missing:
            raise ConfigError(
                f"{self.address.host} can be reached from other machines; that takes {' and '.join(missing)}",
                value=self.address.host,
                remedy="listen on 127.0.0.1 and come through an SSH tunnel, or give what is missing",
            )
        if self.address.host in EVERY_ADDRESS and not self.hosts:
            raise ConfigError(
                f"{self.address.host} is every address of this machine; name those that browsers use with --host",
                value=self.address.host,
            )

    @property
    def scheme(self) -> str:
        """As in the console's URLs."""
        return "https" if self.certificate else "http"

    @property
    def known_hosts(self) -> tuple[str, ...]:
        """The host names and addresses that browsers may use for the console."""
        loopback = LOOPBACK_NAMES if self.address.is_loopback else ()
        return (self.address.in_url, *self.hosts, *loopback)

    @property
    def shown_host(self) -> str:
        """The host of the printed link."""
        return self.hosts[0] if self.hosts else self.address.in_url


def read_token(path: Path) -> str:
    """Return the token in a file.

    Raises:
        ConfigError: it cannot be read, others can read it, or the token is short enough to be guessed.
    """
    try:
        mode = path.stat().st_mode
        token = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"{path}: no token can be read: {error}") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(f"{path}: others than its owner can read the token", remedy=f"chmod 600 {path}")
    if len(token) < SHORTEST_TOKEN or not token.isalnum():
        raise ConfigError(
            f"{path}: a token is {SHORTEST_TOKEN} or more letters and digits",
            value=len(token),
            limit=SHORTEST_TOKEN,
            remedy=f"openssl rand -hex 32 > {path}",
        )
    return token
