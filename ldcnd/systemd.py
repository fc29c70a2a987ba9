"""The service manager's side door: datagrams that say how a program is, and how often they are expected.

Only the protocol, and what every program beside a daemon says; what the daemon has to say is in `daemon/service.py`.
Source: sd_notify(3), sd_watchdog_enabled(3), systemd.service(5) "Type=notify-reload".
"""

import os
import socket
from collections.abc import Mapping

from ldcnd.log import get_lazy_logger

log = get_lazy_logger("systemd")

READY = "READY=1"
STOPPING = "STOPPING=1"
WATCHDOG = "WATCHDOG=1"


def reloading(monotonic_ns: int) -> str:
    """Say that a reload has begun, and when on CLOCK_MONOTONIC: systemd tells it from earlier ones by that."""
    return f"RELOADING=1\nMONOTONIC_USEC={monotonic_ns // 1000}"


def status(text: str) -> str:
    """Say in one line how things are; shown by `systemctl status`."""
    return "STATUS=" + " ".join(text.split())


class Notifier:
    """Tells the service manager, if there is one; never fails its program, and blocks only where that is wanted."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._failed = False
        self.watchdog_s = _watchdog_s(environment, os.getpid())

    @property
    def is_heard(self) -> bool:
        """Whether a service manager listens."""
        return bool(self._address)

    def tell(self, *messages: str, wait_s: float = 0.0) -> bool:
        """Send messages as one datagram; return whether it was taken or there is no service manager.

        Args:
            messages: what to say.
            wait_s: longest time to wait for a service manager that is too busy to take it, seconds.
        """
        if not self._address or not messages:
            return True
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as door:
                door.settimeout(wait_s)
                door.sendto("\n".join(messages).encode(), self._address)
        except OSError as error:
            if not self._failed:
                log.warning("service manager not notified", reason=str(error))
            self._failed = True
            return False
        self._failed = False
        return True


BUSY_S = 5.0
"""Longest time that a program beside a daemon waits for its service manager, seconds."""


class Beside:
    """A program beside a daemon as its service manager shows it: started once it serves, and what keeps it from that.

    The same is said to people, by whoever uses this.
    """

    def __init__(self, notifier: Notifier | None = None) -> None:
        self._notifier = notifier or Notifier()
        self._serves = ""
        self._lacks: str | None = None
        self._remarks: dict[str, str] = {}

    def serves(self, what: str) -> None:
        """Say that the program serves now, and what: whoever has started it may use it."""
        self._serves = what
        self._tell(READY)

    def lacks(self, problem: str | None) -> None:
        """Say what is missing, or None once nothing is."""
        self._lacks = problem
        self._tell()

    def remarks(self, remark: str | None, about: str = "login") -> None:
        """Say what is to be seen to though nothing is missing, or None once that is done.

        Args:
            remark: in words.
            about: what of the program it is about, of which there is one remark.
        """
        if remark:
            self._remarks[about] = remark
        else:
            self._remarks.pop(about, None)
        self._tell()

    def _tell(self, *messages: str) -> None:
        said = (self._lacks or self._serves, *self._remarks.values())
        self._notifier.tell(*messages, status("; ".join(filter(None, said))), wait_s=BUSY_S)


def _watchdog_s(environment: Mapping[str, str], pid: int) -> float | None:
    """Return the time-out of the watchdog, seconds; None when there is no watchdog."""
    if environment.get("WATCHDOG_PID", str(pid)) != str(pid):
        return None
    period_us = environment.get("WATCHDOG_USEC", "")
    return int(period_us) / 1e6 if period_us.isascii() and period_us.isdigit() and int(period_us) else None
