"""The service manager's side door: datagrams that say how the daemon is, and how often they are expected.

Only the protocol; what is worth saying is in service.py.
Source: sd_notify(3), sd_watchdog_enabled(3), systemd.service(5) "Type=notify-reload".
"""

import os
import socket
from collections.abc import Mapping

from ldcnd.log import get_logger

log = get_logger("systemd")

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
    """Tells the service manager, if there is one; never blocks, never fails the daemon."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._failed = False
        self.watchdog_s = _watchdog_s(environment, os.getpid())

    @property
    def is_heard(self) -> bool:
        """Whether a service manager listens."""
        return bool(self._address)

    def tell(self, *messages: str) -> bool:
        """Send messages as one datagram; return whether it was taken or there is no service manager."""
        if not self._address or not messages:
            return True
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC) as door:
                door.sendto("\n".join(messages).encode(), self._address)
        except OSError as error:
            if not self._failed:
                log.warning("service manager not notified", reason=str(error))
            self._failed = True
            return False
        self._failed = False
        return True


def _watchdog_s(environment: Mapping[str, str], pid: int) -> float | None:
    """Return the time-out of the watchdog, seconds; None when there is no watchdog."""
    if environment.get("WATCHDOG_PID", str(pid)) != str(pid):
        return None
    period_us = environment.get("WATCHDOG_USEC", "")
    return int(period_us) / 1e6 if period_us.isascii() and period_us.isdigit() and int(period_us) else None
