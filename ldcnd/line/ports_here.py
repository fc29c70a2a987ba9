"""The serial ports of this machine: what they are, who has them, and which one a pattern means.

Sources: Linux, proc(5) for /proc/locks and /proc/PID/fd; pyserial, `serial.tools.list_ports`, which asks sysfs.
"""

import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ldcnd.contract.errors import TransportLost
from ldcnd.line.adapter import Adapter, adapter_of, stable_names

PROC = Path("/proc")


@dataclass(frozen=True, slots=True)
class PortHere:
    """A serial port of this machine.

    Attributes:
        port: what to write into a configuration: a name that stays where there is one.
        node: its device.
        what: maker, product and serial number, as the adapter says them.
        hardware: as pyserial writes it, such as `USB VID:PID=0403:6001 SER=FT4ABCDE LOCATION=1-2`.
        adapter: what the kernel says of it.
        held_by: programs that have it, as `NAME (PID)`; those of other users only if they have locked it.
    """

    port: str
    node: str
    what: str
    hardware: str
    adapter: Adapter | None
    held_by: tuple[str, ...]

    @property
    def keeps_back(self) -> str:
        """How long it keeps a short reply back, in words; empty where the driver does not say."""
        if self.adapter and self.adapter.latency_timer_ms is not None:
            return f"{self.adapter.latency_timer_ms} ms"
        if self.adapter and self.adapter.rx_trig_bytes is not None:
            return f"{self.adapter.rx_trig_bytes} bytes"
        return ""


def ports_here() -> list[PortHere]:
    """Return the serial ports of this machine on which drives may be; reads files only, and opens no port."""
    stable = stable_names()
    return [
        PortHere(str(stable.get(node, device)), node, what, hardware, adapter_of(Path(device)), held_by(Path(device)))
        for device, what, hardware in _listed(".")
        for node in [Path(device).name]
    ]


def port_matching(pattern: str) -> str:
    """Return the device of the one port whose device, description or hardware a pattern fits.

    Args:
        pattern: a regular expression, searched for in upper and lower case.

    Raises:
        TransportLost: no port fits, or several do: it might be another machine's adapter.
    """
    found = [device for device, _, _ in _listed(pattern)]
    if len(found) == 1:
        return found[0]
    why = f"several ports fit it: {', '.join(found)}" if found else "no port fits it"
    remedy = "`ldcnd scan` without a port lists what there is"
    raise TransportLost(f"hwgrep://{pattern} cannot be opened: {why}; {remedy}", value=pattern, remedy=remedy)


def held_by(device: Path, proc: Path = PROC, *, besides: int | None = None) -> tuple[str, ...]:
    """Return the programs that have a device open or locked, as far as this user may see them.

    Args:
        device: its path, or a link to it.
        proc: where the kernel tells of programs.
        besides: the process of one that is left out.
    """
    try:
        node = device.stat()
    except OSError:
        return ()
    # as /proc/locks writes it: device of the file system in hexadecimal, inode in decimal
    place = f"{os.major(node.st_dev):02x}:{os.minor(node.st_dev):02x}:{node.st_ino}"
    found = {pid for pid, locked in _locks(proc) if locked == place}
    itself = device.resolve()
    for program in proc.glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if any(_leads_to(link, itself) for link in (program / "fd").iterdir()):
                found.add(int(program.name))
    return tuple(f"{_name_of(pid, proc)} ({pid})" for pid in sorted(found) if pid != besides)


def _listed(pattern: str) -> Sequence[tuple[str, str, str]]:
    """Return device, description and hardware of the ports that a pattern fits, in the order of their devices."""
    from serial.tools import list_ports  # noqa: PLC0415 - fails where there is neither POSIX nor Windows

    return sorted((each.device, _described(each.description), each.hwid) for each in list_ports.grep(pattern))


def _described(text: str) -> str:
    return "" if text == "n/a" else text


def _locks(proc: Path) -> Iterator[tuple[int, str]]:
    """Yield process and file of each lock; a process of another container is 0 and is left out."""
    with contextlib.suppress(OSError):
        for line in (proc / "locks").read_text(encoding="ascii").splitlines():
            if found := re.search(r" (\d+) ([0-9a-f]+:[0-9a-f]+:\d+) ", line):
                pid = int(found[1])
                if pid:
                    yield pid, found[2]


def _leads_to(link: Path, device: Path) -> bool:
    try:
        return link.readlink() == device
    except OSError:
        return False


def _name_of(pid: int, proc: Path) -> str:
    try:
        return (proc / str(pid) / "comm").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return "a program"
