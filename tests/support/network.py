"""Hosts and routers in network namespaces of this machine, with links that can be cut; needs root."""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.support.process import ROOT

ENDS_WITHIN_S = 15.0


class NoNamespaces(Exception):
    """This machine, or this user, cannot make network namespaces."""


@dataclass
class Network:
    """Namespaces and the links between them; each link is a subnet of its own, and nothing is forwarded.

    Attributes:
        address: of each end of a link, by namespace and the namespace at the other end.
    """

    prefix: str = field(default_factory=lambda: f"ldcnd{os.getpid()}")
    address: dict[tuple[str, str], str] = field(default_factory=dict)
    _hosts: list[str] = field(default_factory=list)

    def add_host(self, name: str) -> None:
        """Make a namespace with its loopback interface.

        Raises:
            NoNamespaces: it cannot be made.
        """
        try:
            _ip("netns", "add", self._namespace(name))
            self._hosts.append(name)
            _ip("-n", self._namespace(name), "link", "set", "lo", "up")
        except (OSError, subprocess.SubprocessError) as error:
            raise NoNamespaces(f"cannot make network namespaces: {error}") from error

    def add_link(self, one: str, other: str) -> None:
        """Connect two namespaces.

        Raises:
            NoNamespaces: the link cannot be made.
        """
        subnet = len(self.address) // 2 + 1
        try:
            _ip(
                "link", "add", f"to_{other}", "netns", self._namespace(one), "type", "veth",
                "peer", "name", f"to_{one}", "netns", self._namespace(other),
            )  # fmt: skip
        except subprocess.CalledProcessError as error:
            raise NoNamespaces(f"cannot connect network namespaces: {error}") from error
        for host, (here, there) in enumerate(((one, other), (other, one)), 1):
            self.address[here, there] = f"10.77.{subnet}.{host}"
            _ip("-n", self._namespace(here), "addr", "add", f"10.77.{subnet}.{host}/24", "dev", f"to_{there}")
            self.restore(here, there)

    def cut(self, here: str, there: str) -> None:
        """Pull the cable between two namespaces: nobody is told."""
        _ip("-n", self._namespace(here), "link", "set", f"to_{there}", "down")

    def restore(self, here: str, there: str) -> None:
        """Plug the cable in again."""
        _ip("-n", self._namespace(here), "link", "set", f"to_{there}", "up")

    @contextlib.contextmanager
    def running(self, host: str, words: Sequence[str], log: Path) -> Iterator["subprocess.Popen[bytes]"]:
        """Run a program on a host until the context ends; what it says is in `log`."""
        with log.open("ab") as output:
            process = subprocess.Popen(  # noqa: S603 - our own programs
                ["ip", "netns", "exec", self._namespace(host), *words],  # noqa: S607 - where it is depends on the system
                cwd=ROOT, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT,
            )  # fmt: skip
            try:
                yield process
            finally:
                process.terminate()
                try:
                    process.communicate(timeout=ENDS_WITHIN_S)
                finally:
                    process.kill()
                    process.communicate()

    def command(self, host: str, *words: str) -> tuple[str, ...]:
        """Return the words that run a program on a host."""
        return ("ip", "netns", "exec", self._namespace(host), *words)

    def remove(self) -> None:
        """Take everything down; links go with their namespaces."""
        for host in self._hosts:
            _ip("netns", "del", self._namespace(host))
        self._hosts.clear()

    def _namespace(self, host: str) -> str:
        return f"{self.prefix}-{host}"


ROUTER = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_file(sys.argv[1]))
sys.stdin.read()
session.close()
"""


def router_words(config: Path) -> tuple[str, ...]:
    """Return the words that run a Zenoh router with a configuration until its input ends."""
    return (sys.executable, "-c", ROUTER, str(config))


def router_config(file: Path, listen: Sequence[str], connect: Sequence[str], console: Path | None) -> Path:
    """Write what a router of a test runs with, from what `ldcnd pki` made for it.

    Args:
        file: from `ldcnd pki`.
        listen: endpoints for others.
        connect: other routers.
        console: a Unix socket on which whoever can open it is an operator.
    """
    config = json.loads(file.read_text())
    config["listen"]["endpoints"] = list(listen)
    config["connect"]["endpoints"] = list(connect)
    if console:
        config["listen"]["endpoints"].append(f"unixsock-stream/{console}")
        config["transport"]["link"]["protocols"].append("unixsock-stream")
        access = config["access_control"]
        access["subjects"].append({"id": "console", "link_protocols": ["unixsock-stream"]})
        (operators,) = (policy for policy in access["policies"] if policy["subjects"] == ["operators"])
        operators["subjects"].append("console")
    made = file.with_name(f"running-{file.name}")
    made.write_text(json.dumps(config))
    return made


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, timeout=10)  # noqa: S603, S607 - see above
