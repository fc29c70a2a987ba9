"""The link that a simulated line makes to its terminal, and the proof that this terminal is still its own.

The kernel gives the number of a terminal to the next program that asks for one, as soon as a simulator is killed; the
link that it leaves then leads to a stranger. So beside the link there is a file, locked for as long as the simulator
runs: the kernel drops the lock however that ends. Links that other programs make are judged by their age.
"""

import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path

PSEUDO_TERMINALS = range(136, 144)
"""Major device numbers of Unix98 pseudo-terminals (Linux, admin-guide/devices.txt)."""
YOUNGER_S = 5.0
"""Longest time from a link to the rights of its terminal, with which the kernel dates it anew, seconds."""
LOOKS = 20
LOOK_S = 0.01
"""Whoever opens a port looks at the lock for a moment, so one that is about to be taken is tried again, seconds."""


def lock_of(link: Path) -> Path:
    """Return the file beside a link that is locked while its simulator runs."""
    return link.with_name(f"{link.name}.lock")


class TerminalLink:
    """A link to a terminal, for as long as this process serves it; replaces one that a simulator has left.

    Raises:
        OSError: it cannot be made, or another process serves it.
    """

    def __init__(self, link: Path, terminal: Path) -> None:
        self._link = link
        self._lock = os.open(lock_of(link), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            self._take()
            self.lead_to(terminal)
        except OSError:
            os.close(self._lock)
            raise

    def lead_to(self, terminal: Path) -> None:
        """Let the link lead to a terminal.

        Raises:
            OSError: it cannot.
        """
        os.truncate(self._lock, 0)
        os.pwrite(self._lock, f"{terminal}\n".encode(), 0)
        if self._link.is_symlink():
            self._link.unlink()
        self._link.symlink_to(terminal)
        self._terminal = terminal

    def close(self) -> None:
        """Remove it, unless it leads elsewhere by now."""
        if self._link.is_symlink() and self._link.readlink() == self._terminal:
            self._link.unlink()
        with suppress(OSError):
            # while it is held: afterwards the file could be the next simulator's
            lock_of(self._link).unlink()
        os.close(self._lock)

    def _take(self) -> None:
        for _ in range(LOOKS):
            with suppress(BlockingIOError):
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            time.sleep(LOOK_S)
        raise OSError(f"another program serves {self._link}")


def why_not_served(path: str) -> str:
    """Say why a port is not the terminal to which a program has linked it; empty when nothing contradicts that."""
    link = Path(path)
    if not link.is_symlink():
        return ""
    try:
        lock = os.open(lock_of(link), os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        # made by another program: there is no lock beside it
        return _why_younger(link)
    try:
        # this is refused as long as the simulator lives, which holds the lock for itself
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        its_own = os.pread(lock, 4096, 0).decode(errors="replace").strip()
        return "" if its_own == str(link.readlink()) else "the link does not lead to the terminal of its simulator"
    finally:
        os.close(lock)
    return "the simulator that has made this link runs no more, and its terminal may be another program's"


def _why_younger(link: Path) -> str:
    """Say whether a terminal is younger than the link to it: then it was given to another program since.

    The kernel changes `st_ctime` of a pseudo-terminal when it makes it, and not when bytes pass (Linux, fs/devpts).
    """
    try:
        terminal, made_s = link.stat(), link.lstat().st_mtime
    except OSError:
        return ""
    if os.major(terminal.st_rdev) not in PSEUDO_TERMINALS or terminal.st_ctime < made_s + YOUNGER_S:
        return ""
    return f"the link was made {terminal.st_ctime - made_s:.0f} s before its terminal, which may be another program's"
