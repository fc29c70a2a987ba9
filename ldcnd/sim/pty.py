"""A simulated chain behind a pseudo-terminal, for hosts in other processes; paced by a thread or process of its own.

Blocking and single-threaded: it sleeps until shortly before the next event, then spins, because a sleep wakes up too
late for a line of a hundred microseconds per byte. The schedule is absolute, so that lateness does not add up. Nothing
else here reads a clock of the machine.

On a busy machine raise its priority (nice -20 rather than a real-time class).
"""

import itertools
import os
import select
import signal
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Protocol, Self

from ldcnd.line.line_discipline import actual_baud
from ldcnd.line.terminal_link import TerminalLink
from ldcnd.sim.chain import Chain

SPIN_S = 150e-6
LONGEST_SLEEP_S = 0.05
"""Longest delay of a request to stop, seconds."""
READ_BYTES = 4096


class LineObserver(Protocol):
    """Receives all bytes of the terminal; instants are seconds since it was opened."""

    def sent(self, at_s: float, data: bytes, baud: int | None) -> None:
        """Take bytes that the host wrote, and its rate, None when the line cannot tell it."""

    def received(self, at_s: float, data: bytes) -> None:
        """Take bytes that were delivered to the host."""

    def remarked(self, text: str) -> None:
        """Take what a module makes of the host's bytes where no reply shows it."""


class PtyLine:
    """A chain and the pseudo-terminal in front of it; a context manager that removes what it made.

    Attributes:
        path: the terminal that a host opens.
    """

    def __init__(
        self,
        chain: Chain,
        link: Path | None = None,
        *,
        baud_check: bool = False,
        observer: LineObserver | None = None,
    ) -> None:
        """Open the terminal.

        Args:
            chain: whose clock starts at 0 now; built with the same `baud_check`.
            link: symbolic link to make to the terminal; one that a simulator has left is replaced.
            baud_check: tell the chain the rate to which the host sets the terminal.
            observer: gets all bytes that pass.

        Raises:
            OSError: there is no terminal left, or the link cannot be made.
        """
        self._chain = chain
        self._baud_check = baud_check
        self._observer = observer
        chain.on_remark = observer.remarked if observer else None
        self._modules = itertools.cycle(chain.modules)
        self._started_s = time.perf_counter()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)  # our end of the slave stays open, so that a host may come and go
        os.set_blocking(self._master, False)
        self.path = Path(os.ttyname(self._slave))
        try:
            self._link = TerminalLink(link, self.path) if link else None
        except OSError:
            os.close(self._master)
            os.close(self._slave)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the terminal back and remove the link."""
        if self._link:
            self._link.close()
        os.close(self._master)
        os.close(self._slave)

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve the host until `stop` returns true; it is called at least every 50 ms."""
        while not stop():
            self._wait()
            self._take_requests()
            self._deliver()
            self._catch_up()

    def _now_s(self) -> float:
        return time.perf_counter() - self._started_s

    def _wait(self) -> None:
        """Sleep until the host sends or until shortly before the next event."""
        due_s = self._chain.next_event_s()
        left_s = LONGEST_SLEEP_S if due_s is None else due_s - self._now_s() - SPIN_S
        select.select([self._master], [], [], min(max(0.0, left_s), LONGEST_SLEEP_S))

    def _take_requests(self) -> None:
        with suppress(BlockingIOError):
            data = os.read(self._master, READ_BYTES)
            if self._baud_check:
                self._chain.baud = self._host_baud()
            now_s = self._now_s()
            self._chain.write(now_s, data)
            if self._observer:
                self._observer.sent(now_s, data, self._chain.baud if self._baud_check else None)

    def _deliver(self) -> None:
        due = b"".join(data for _, data in self._chain.advance(self._now_s()))
        if due:
            with suppress(BlockingIOError):  # the host does not read: a real line does not wait either
                os.write(self._master, due)
            if self._observer:
                self._observer.received(self._now_s(), due)

    def _catch_up(self) -> None:
        """Use the host's turn to advance one module after another, so that a long unused one replies in time."""
        if self._chain.next_event_s() is None:
            next(self._modules).catch_up(self._now_s())

    def _host_baud(self) -> int:
        """Return the rate that the host has set; the master side of a terminal reports the slave's settings."""
        return actual_baud(self._master) or 0


def serve_pty(
    chain: Chain,
    link: Path | None = None,
    *,
    baud_check: bool = False,
    stop: Callable[[], bool] | None = None,
    opened: Callable[[Path], None] | None = None,
    observer: LineObserver | None = None,
) -> None:
    """Serve a chain behind a pseudo-terminal; blocks.

    Args:
        chain: built with the same `baud_check`.
        link: symbolic link to make to the terminal.
        baud_check: frames at another rate than a module's are garbage to it.
        stop: called at least every 50 ms; true ends it. Without it SIGTERM and SIGINT end it; then only the main
            thread may call.
        opened: called with the terminal's path once it can be used.
        observer: gets all bytes that pass.

    Raises:
        OSError: there is no terminal left, or the link cannot be made.
    """
    with ExitStack() as stack:
        stopped = stop or stack.enter_context(_until_signalled())
        line = stack.enter_context(PtyLine(chain, link, baud_check=baud_check, observer=observer))
        if opened:
            opened(line.path)
        line.run(stopped)


@contextmanager
def _until_signalled() -> Iterator[Callable[[], bool]]:
    stopped = threading.Event()

    def stop(_signal: int, _frame: FrameType | None) -> None:
        stopped.set()

    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stopped.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
