"""The terminal of a port: a link that stays while programs open and close it, and whether one has it open."""

import asyncio
import os
import select
import shutil
from collections.abc import Callable
from contextlib import AsyncExitStack, suppress
from pathlib import Path

READ_BYTES = 4096
LOOK_S = 0.02
"""How often a terminal that nobody has open is looked at, seconds."""


class GuestTerminal:
    """One terminal behind a link, until the stack closes.

    Attributes:
        path: of the terminal itself.
        take: called with what the program has sent, and the rate that it has set, None for one that is none.
        closed: called when the program has closed it.
    """

    def __init__(self, link: Path, mode: int, group: str | None, stack: AsyncExitStack) -> None:
        # a configuration with a port can be read where there are no terminals
        import tty  # noqa: PLC0415

        from ldcnd.line.terminal_link import TerminalLink  # noqa: PLC0415

        self.take: Callable[[bytes, int | None], None] = lambda _data, _baud: None
        self.closed: Callable[[], None] = lambda: None
        self._loop = asyncio.get_running_loop()
        self._master, slave = os.openpty()
        stack.callback(os.close, self._master)
        tty.setraw(slave)  # its settings stay while the master is open
        os.set_blocking(self._master, False)
        self.path = Path(os.ttyname(slave))
        if group is not None:
            shutil.chown(self.path, group=group)
        self.path.chmod(mode)
        os.close(slave)
        stack.callback(TerminalLink(link, self.path).close)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)
        self._later: asyncio.TimerHandle | None = None
        self._look()
        stack.callback(self._stop)

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
            self.closed()
            self._look()
            return
        self.take(data, actual_baud(self._master))

    def _stop(self) -> None:
        self._loop.remove_reader(self._master)
        if self._later:
            self._later.cancel()
