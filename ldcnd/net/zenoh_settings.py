"""Settings of a Zenoh session, as paths into Zenoh's configuration; does not import zenoh.

Zenoh's own defaults are not fit for hardware: it listens on every interface, scouts by multicast and shares memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Endpoint of a daemon, and of programs that look for one where nothing names another."""
LEASE_MS = 2000
"""The others learn within this time that this process has frozen or that its cable was pulled."""

RETRY_MS = (100, 1000)
"""First and longest pause between attempts to connect to a peer that is late or lost, milliseconds."""

WAIT_BEFORE_CLOSE_US = 200_000
"""Maximum time that a peer takes nothing while something waits that must not be dropped; then its link is closed."""


@dataclass(frozen=True, slots=True)
class ZenohSettings:
    """How to join the network. Nothing is scouted for: one listens, others connect.

    Attributes:
        listen: endpoints to listen on, such as `tcp/127.0.0.1:7447`; none means not to listen.
        connect: endpoints to connect to; a peer keeps trying in the background, a client fails at once.
        mode: peers serve clients without any router; clients talk to one peer or router; None leaves it to the file.
        config_file: a Zenoh configuration to start from, for TLS and access control; its endpoints count when none are
            given here, and scouting is off unless it says otherwise. Relative file names in it count from its folder.
        instance: names this program to observers of the network.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    mode: Literal["peer", "client"] | None = "peer"
    config_file: Path | None = None
    instance: str = "ldcnd"

    def required(self) -> dict[str, object]:
        """Return what holds whatever the configuration file says."""
        return {
            **({"mode": self.mode} if self.mode else {}),
            # otherwise a session whose port is in use opens all the same, and listens nowhere
            "listen/exit_on_failure": True,
            # Zenoh's own pauses are 1 s and more: a router that is back would be found that much later
            "connect/retry": {"period_init_ms": RETRY_MS[0], "period_max_ms": RETRY_MS[1]},
            "metadata": {"name": self.instance},
            # every sample carries when it was true
            "timestamping/enabled": True,
            # a receiver that stalls loses queries in it, and opening it needs mlock
            "transport/shared_memory/enabled": False,
            # with it, listing the connected peers ends the program
            "transport/unicast/lowlatency": False,
            # each side announces its own: it is this process whose silence the others are to notice
            "transport/link/tx/lease": LEASE_MS,
            "transport/link/tx/queue/congestion_control/block/wait_before_close": WAIT_BEFORE_CLOSE_US,
            # Zenoh's default is 1 ms for each message that finds no room; a poll brings five, and the loop would wait
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
        }

    def optional(self) -> dict[str, object]:
        """Return what a configuration file may state otherwise, where it is false or empty here."""
        return {
            "listen/endpoints": self.listen,
            "connect/endpoints": self.connect,
            "scouting/multicast/enabled": False,
            # with gossip peers connect to each other, past the access rules of the router between them
            "scouting/gossip/enabled": False,
        }


def endpoint_of(written: str) -> str:
    """Return an endpoint that may be written as HOST:PORT."""
    return written if "/" in written else f"tcp/{written}"


def reached_at(listen: Sequence[str]) -> str:
    """Return where a program of the same machine reaches a daemon that listens at these endpoints."""
    return next(iter(listen), DEFAULT_ENDPOINT).replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def user_settings(
    connect: Sequence[str], listen: Sequence[str] = (), config_file: Path | str | None = None
) -> ZenohSettings:
    """Return how a program that uses rigs joins the network: at the default endpoint unless it names another way.

    Args:
        connect: endpoints, or HOST:PORT.
        listen: endpoints to listen on.
        config_file: a Zenoh configuration with a login; its endpoints count when none are given here.
    """
    endpoints = tuple(map(endpoint_of, connect)) or (() if listen or config_file else (DEFAULT_ENDPOINT,))
    return ZenohSettings(
        mode="client" if endpoints else None if config_file else "peer",
        connect=endpoints,
        listen=tuple(listen),
        config_file=Path(config_file) if config_file else None,
    )
