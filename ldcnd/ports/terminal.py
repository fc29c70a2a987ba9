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
        self.take: Callable[[bytes, int | None], bool] = lambda _data, _baud: True
        self.closed: Callable[[], None] = lambda: None
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
        self.closed()

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
        if any(event & select.POLLHUP for _, event in self._poll.poll(0)):
            self._later = self._loop.call_later(LOOK_S, self._look)
        else:
            self._later = None
            self._loop.add_reader(self._master, self._read)

    def _read(self) -> None:
        from ldcnd.line.line_discipline import actual_baud  # noqa: PLC0415 - as above

        try:
            data = os.read(self._master, READ_BYTES)
        except BlockingIOError:
            return
        except OSError:  # EIO: nobody has it open any more
            self._loop.remove_reader(self._master)
            self._let_be_set()
            self.closed()
            self._look()
            return
        self._baud = actual_baud(self._master) or self._baud
        if not self.take(data, self._baud):
            self._loop.remove_reader(self._master)
            self._later = self._loop.call_later(FLOOD_PAUSE_S, self._look)
