"""The kernel's data of a serial port's adapter: its driver, how long it keeps bytes back, its errors.

Sources: Linux, Documentation/ABI/testing/sysfs-tty (rx_trig_bytes), drivers/usb/serial/ftdi_sio.c (latency_timer),
include/uapi/linux/serial.h (struct serial_icounter_struct).
"""

import contextlib
import struct
from dataclasses import dataclass
from pathlib import Path

SYS_TTY = Path("/sys/class/tty")
BY_ID = Path("/dev/serial/by-id")
TIOCGICOUNT = 0x545D
ICOUNTS = struct.Struct("20i")
# in `struct serial_icounter_struct` behind cts, dsr, rng, dcd, rx and tx
_FRAME, _OVERRUN, _PARITY, _BREAK, _BUFFER_OVERRUN = range(6, 11)


@dataclass(frozen=True, slots=True)
class LineErrors:
    """A driver's counters since it was loaded.

    Attributes:
        frame: bytes without a stop bit: another rate, noise, a short circuit, no bias on an idle line.
        overrun: bytes that the chip lost because they were not fetched in time.
        parity: bytes of the wrong parity.
        breaks: a line that stays low: a broken wire, no bias.
        buffer_overrun: bytes that the kernel lost because no program read them.
    """

    frame: int
    overrun: int
    parity: int
    breaks: int
    buffer_overrun: int

    def since(self, before: "LineErrors") -> "LineErrors":
        """Return what has been counted since."""
        return LineErrors(
            self.frame - before.frame,
            self.overrun - before.overrun,
            self.parity - before.parity,
            self.breaks - before.breaks,
            self.buffer_overrun - before.buffer_overrun,
        )

    def __bool__(self) -> bool:
        return any((self.frame, self.overrun, self.parity, self.breaks, self.buffer_overrun))

    def __str__(self) -> str:
        return (
            f"{self.frame} frame, {self.parity} parity, {self.overrun} overrun, {self.buffer_overrun} buffer overrun"
            f" errors, {self.breaks} breaks"
        )


@dataclass(frozen=True, slots=True)
class Adapter:
    """A serial port's adapter.

    Attributes:
        node: its name in /dev, which may be another one when it is plugged in again.
        driver: of the kernel; empty for a pseudo-terminal.
        stable_name: a link to it that stays, if there is one.
        latency_timer_ms: how long it keeps a short reply back at most; FTDI only.
        rx_trig_bytes: how many bytes it collects before it hands them over; 16550A only.
    """

    node: str
    driver: str
    stable_name: str | None
    latency_timer_ms: int | None
    rx_trig_bytes: int | None

    @property
    def latency_file(self) -> Path:
        """Where the latency timer is set."""
        return Path("/sys/bus/usb-serial/devices") / self.node / "latency_timer"

    @property
    def trigger_file(self) -> Path:
        """Where the trigger of the FIFO is set."""
        return SYS_TTY / self.node / "rx_trig_bytes"


def adapter_of(path: Path, sys_tty: Path = SYS_TTY, by_id: Path = BY_ID) -> Adapter | None:
    """Return the data of the adapter behind a device path; None where the kernel has no such port.

    Args:
        path: a node or a link to one.
        sys_tty: where the kernel tells of its terminals.
        by_id: where udev puts names that stay.
    """
    node = path.resolve().name
    device = sys_tty / node / "device"
    # sysfs knows nothing of pseudo-terminals
    if path.resolve().parent.name == "pts":
        return Adapter(node, "", None, None, None)
    if not device.exists():
        return None
    driver = device / "driver"
    stable = stable_names(by_id).get(node)
    return Adapter(
        node,
        driver.resolve().name if driver.exists() else "",
        str(path) if path.is_symlink() else (str(stable) if stable else None),
        _number(device / "latency_timer"),
        _number(sys_tty / node / "rx_trig_bytes"),
    )


def stable_names(by_id: Path = BY_ID) -> dict[str, Path]:
    """Return the names that udev keeps, by the node to which each leads now."""
    return {link.resolve().name: link for link in _entries(by_id)}


def line_errors(descriptor: int) -> LineErrors | None:
    """Return what the driver of an open port has counted; None where it counts nothing."""
    import fcntl  # noqa: PLC0415 - a part of POSIX, and clients import this module for its classes

    with contextlib.suppress(OSError):
        counts = ICOUNTS.unpack(fcntl.ioctl(descriptor, TIOCGICOUNT, bytes(ICOUNTS.size)))
        return LineErrors(counts[_FRAME], counts[_OVERRUN], counts[_PARITY], counts[_BREAK], counts[_BUFFER_OVERRUN])
    return None


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _number(file: Path) -> int | None:
    try:
        return int(file.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
