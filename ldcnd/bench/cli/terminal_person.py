"""The person in front of a terminal: questions and answers; a key that is held lets an axis move."""

import asyncio
import io
import os
import stat
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from typing_extensions import override

from ldcnd.bench.person import Left, Person
from ldcnd.cli.names import typed
from ldcnd.cli.output import HELD, Keyboard, keys, show_lines
from ldcnd.contract.errors import ConfigError, RemedyCommand

PART_BYTES = 4096


class TerminalPerson(Person):
    """Asks on standard error, reads standard input.

    Args:
        for_s: how long a key counts as held where there is none, seconds; None for the keyboard.
    """

    def __init__(self, for_s: float | None) -> None:
        self._for_s = for_s
        self._typed = b""

    @override
    def tell(self, *lines: str) -> None:
        if lines:
            show_lines(*lines, err=True)

    @override
    def named(self, command: RemedyCommand, axis: str | None) -> str:
        return typed(command, axis)

    @override
    async def ask(self, question: str) -> str:
        self._drop_typed()
        print(f"{question}: ", end="", file=sys.stderr, flush=True)
        line = await self._line()
        if not line:
            self.tell("")
            raise Left("no answer came")
        return line.strip()

    @override
    @asynccontextmanager
    async def holding(self, what: str) -> AsyncIterator[asyncio.Event]:
        released = asyncio.Event()
        if self._for_s is not None:
            self.tell(f"{what}, for {self._for_s:g} s at most")
            timer = asyncio.get_running_loop().call_later(self._for_s, released.set)
            try:
                yield released
            finally:
                timer.cancel()
            return
        if not sys.stdin.isatty():
            raise ConfigError("there is no keyboard here", remedy="say how long to run at most with --for SECONDS")
        with keys() as keyboard:
            self.tell(f"hold the space bar: {what}; any other key leaves")
            if not await keyboard.pressed(HELD):
                raise Left("another key was pressed")
            try:
                async with asyncio.TaskGroup() as group:
                    following = group.create_task(_follow(keyboard, released), name="held key")
                    try:
                        yield released
                    finally:
                        following.cancel()
            except BaseExceptionGroup as errors:
                if len(errors.exceptions) > 1:
                    raise
                raise errors.exceptions[0] from None

    def _drop_typed(self) -> None:
        """Drop what was typed on a terminal before there was a question to read; what is piped is a script's answer."""
        if sys.platform == "win32" or not sys.stdin.isatty():
            return
        import termios  # noqa: PLC0415 - a part of POSIX

        self._typed = b""
        with suppress(termios.error):  # of a terminal that was hung up, which ends the line that is read next
            termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)

    async def _line(self) -> str:
        """Return what is typed until the next line feed, without blocking the loop; nothing at the end of input."""
        try:
            descriptor = sys.stdin.fileno()
        except io.UnsupportedOperation:
            return sys.stdin.readline()
        if sys.platform == "win32":  # its loops watch sockets only
            return await asyncio.to_thread(sys.stdin.readline)
        if not _can_wait(descriptor):
            return sys.stdin.readline()
        while b"\n" not in self._typed:
            part = await _part(descriptor)
            if not part:
                break
            self._typed += part
        line, feed, self._typed = self._typed.partition(b"\n")
        return (line + feed).decode(errors="replace")


class AssentingPerson(TerminalPerson):
    """Says yes to everything, as `--yes` has asked for."""

    @override
    async def confirm(self, question: str) -> bool:
        return True


async def _follow(keyboard: Keyboard, released: asyncio.Event) -> None:
    async for _ in keyboard.repetitions(HELD):
        pass
    released.set()


def _can_wait(descriptor: int) -> bool:
    """Tell whether a descriptor can be watched for input; files and /dev/null cannot, and never block."""
    mode = os.fstat(descriptor).st_mode
    return os.isatty(descriptor) or stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)


async def _part(descriptor: int) -> bytes:
    """Return bytes as soon as there are any; none at the end."""
    loop = asyncio.get_running_loop()
    ready: asyncio.Future[None] = loop.create_future()

    def readable() -> None:
        if not ready.done():
            ready.set_result(None)

    loop.add_reader(descriptor, readable)
    try:
        await ready
    finally:
        loop.remove_reader(descriptor)
    return os.read(descriptor, PART_BYTES)
