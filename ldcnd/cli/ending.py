"""Ending a command: by Ctrl-C, by the service manager, by the end of the terminal."""

import asyncio
import os
import signal
import termios
from collections.abc import Callable
from contextlib import suppress

TERMINAL_DESCRIPTORS = (0, 1, 2)


def end_as_interrupted() -> None:
    """Let SIGTERM and the end of the terminal end a command as Ctrl-C does: what it has under way is ended first."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: signal.raise_signal(signal.SIGINT))


def on_end(told: Callable[[], None]) -> None:
    """Call `told` at SIGTERM, SIGINT and the end of the terminal, on the running loop, instead of being killed."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, told)


class Terminal:
    """The terminal on which this program was started, if it was."""

    def __init__(self) -> None:
        self._descriptors = [each for each in TERMINAL_DESCRIPTORS if _is_terminal(each)]

    @property
    def has_gone(self) -> bool:
        """Whether it was closed since: SIGHUP then says so, and otherwise whatever the sender means by it."""
        return bool(self._descriptors) and not any(map(_is_terminal, self._descriptors))


def _is_terminal(descriptor: int) -> bool:
    with suppress(OSError, termios.error):
        if os.isatty(descriptor):
            termios.tcgetattr(descriptor)  # one that was hung up is still called a terminal
            return True
    return False
