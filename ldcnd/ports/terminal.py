"""The terminal of a port: a link that stays while programs open and close it, and whether one has it open."""

import asyncio
import os
import select
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ldcnd.ports.door import FLOOD_PAUSE_S

READ_BYTES = 4096
MOST_LEFT_BYTES = 1 << 20
"""More than a terminal keeps of what nobody reads."""
LOOK_S = 0.02
"""How often a terminal that nobody has open is looked at, seconds."""


class GuestTerminal:
    """A `Door`: a terminal behind a link, until it is closed.

    Attributes:
        path: of the terminal itself.
        take, closed: see `Door`.

    Raises:
        OSError, LookupError: it cannot be made, or there is no such group.
    """

    def __init__(self, link: Path, mode: int, group: str | None) -> None:
        self.take: Callable[[bytes, int | None], int] = lambda data, _baud: len(data)
        self.closed: Callable[[bytes, int | None], None] = lambda _data, _baud: None
        self._mode, self._group = mode, group
        self._loop = asyncio.get_running_loop()
        self._later: asyncio.TimerHandle | None = None
        # a configuration with a port can be read where there are no terminals
        from ldcnd.line.terminal_link import TerminalLink  # noqa: PLC0415

        self._master, self.path = self._open()
        try:
            self._linked = TerminalLink(link, self.path)
        except OSError:
            os.close(self._master)
            raise
        self._watch()

    def _open(self) -> tuple[int, Path]:
        """Make a terminal; return its master, and where it is."""
        import tty  # noqa: PLC0415

        master, slave = os.openpty()
        try:
            tty.setraw(slave)  # its settings stay while the master is open
            os.set_blocking(master, False)
            path = Path(os.ttyname(slave))
            if self._group is not None:
                shutil.chown(path, group=self._group)
            path.chmod(self._mode)
        except (OSError, LookupError):
            os.close(master)
            raise
        finally:
            os.close(slave)
        return master, path

    def _watch(self) -> None:
        self._baud: int | None = None
        self._present = False  # a program, as far as was seen
        self._kept = b""  # of what it has sent, what was not taken yet
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)
        self._look()

    def close(self) -> None:
        """Take the link away, and hang up on the program."""
        self._linked.close()
        self._drop()

    def leave(self) -> None:
        """Hang up on the program: the link leads to another terminal from now on; see `Door`."""
        master, path = self._open()
        try:
            self._linked.lead_to(path)
        except OSError:
            os.close(master)
            raise
        self._drop()
        self._master, self.path = master, path
        self._watch()
        self.closed(b"", None)

    def _let_be_set(self) -> None:
        """Leave something that the next program sets: CLOCAL, which says nothing of a terminal without a modem.

        A terminal has no parity, and a program that wants one and sets nothing else has an error (tried with glibc 2.36
        of Debian 12): it could open the port only once.
        """
        import termios  # noqa: PLC0415 - as above

        settings = termios.tcgetattr(self._master)
        settings[2] &= ~termios.CLOCAL
        termios.tcsetattr(self._master, termios.TCSANOW, settings)

    def _drop(self) -> None:
        self._loop.remove_reader(self._master)
        if self._later:
            self._later.cancel()
        os.close(self._master)

    def write(self, data: bytes) -> None:
        """Send to the program; what it does not read is lost, as on a line."""
        with suppress(BlockingIOError):
            os.write(self._master, data)

    def _look(self) -> None:
        """Read once somebody has it open: without, a master is always ready, and has hung up."""
        if self._hung_up():
            self._later = self._loop.call_later(LOOK_S, self._look)
            # also of a program that had it open between two looks
            if (left := self._left()) or self._present:
                self._gone(left)
        else:
            self._later, self._present = None, True
            self._loop.add_reader(self._master, self._read)
            if self._kept:  # there may be nothing more to read
                self._later = self._loop.call_later(0, self._read)

    def _read(self) -> None:
        if self._hung_up():  # before what is left: the next program must not begin what this one has sent
            self._loop.remove_reader(self._master)
            self._look()
            return
        with suppress(BlockingIOError, OSError):
            data = self._kept or os.read(self._master, READ_BYTES)
            self._kept = data[self.take(data, self._rate()) :]
            if self._kept:
                self._loop.remove_reader(self._master)
                self._later = self._loop.call_later(FLOOD_PAUSE_S, self._look)

    def _hung_up(self) -> bool:
        return any(event & select.POLLHUP for _, event in self._poll.poll(0))

    def _left(self) -> bytes:
        """Return what was sent by a program that has gone."""
        left, self._kept = self._kept, b""
        with suppress(OSError):  # EIO: that was all
            while len(left) < MOST_LEFT_BYTES and (data := os.read(self._master, READ_BYTES)):
                left += data
        return left

    def _gone(self, left: bytes) -> None:
        self._present = False
        baud = self._rate()
        self._let_be_set()
        self.closed(left, baud)

    def _rate(self) -> int | None:
        from ldcnd.line.line_discipline import actual_baud  # noqa: PLC0415 - as above

        self._baud = actual_baud(self._master) or self._baud
        return self._baud
