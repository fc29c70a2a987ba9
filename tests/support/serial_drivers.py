"""What serial drivers of Linux make of a port's settings, imposed on a pseudo-terminal that takes anything.

* `uart_8250`: drivers/tty/serial/serial_core.c, `uart_get_baud_rate`, called by 8250_port.c: a rate above a sixteenth
  of the clock becomes the one before it, or 9600; it is reported in the settings, and no error is.
* `rs485_port`: serial_core.c, `uart_sanitize_serial_rs485`: flags that the port does not support are dropped silently.

A pseudo-terminal itself is a driver without direction control (ENOTTY), as those of USB adapters are.
"""

import fcntl
import termios
from dataclasses import dataclass, field

import pytest

from ldcnd.line import line_discipline, serial_port
from ldcnd.line.line_discipline import SERIAL_RS485, TIOCGRS485, TIOCSRS485, actual_baud

UART_FALLBACK = 9600


def uart_8250(monkeypatch: pytest.MonkeyPatch, most_baud: int = 115_200) -> None:
    """Let every port have the driver of a UART whose clock makes `most_baud` at most."""
    reconfigure = serial_port._Serial._reconfigure_port  # type: ignore[attr-defined]

    def limited(port: serial_port._Serial, *arguments: object, **options: object) -> None:
        descriptor = port.fd
        assert descriptor is not None
        before = actual_baud(descriptor) or UART_FALLBACK
        reconfigure(port, *arguments, **options)
        if (actual_baud(descriptor) or 0) > most_baud:
            attributes = termios.tcgetattr(descriptor)
            kept = before if before <= most_baud else UART_FALLBACK
            attributes[4] = attributes[5] = getattr(termios, f"B{kept}")
            termios.tcsetattr(descriptor, termios.TCSANOW, attributes)

    monkeypatch.setattr(serial_port._Serial, "_reconfigure_port", limited)


@dataclass
class Rs485Driver:
    """A driver with direction control.

    Attributes:
        supported: flags that it takes; the others are dropped.
        taken: what it was set to last: flags, before, after.
    """

    supported: int
    taken: list[int] = field(default_factory=lambda: [0] * 8)

    def ioctl(self, descriptor: int, request: int, argument: bytes) -> bytes:
        """Serve `TIOCSRS485` and `TIOCGRS485`, and leave the rest to the kernel."""
        if request == TIOCSRS485:
            self.taken = list(SERIAL_RS485.unpack(argument))
            self.taken[0] &= self.supported
            return argument
        if request == TIOCGRS485:
            return SERIAL_RS485.pack(*self.taken)
        return fcntl.ioctl(descriptor, request, argument)


class _Fcntl:
    def __init__(self, driver: Rs485Driver) -> None:
        self.ioctl = driver.ioctl


def rs485_port(monkeypatch: pytest.MonkeyPatch, supported: int) -> Rs485Driver:
    """Let every port have a driver that supports these flags of `struct serial_rs485`."""
    driver = Rs485Driver(supported)
    monkeypatch.setattr(line_discipline, "fcntl", _Fcntl(driver))
    return driver
