"""Output, endings and keys of commands: nothing from the network steers a terminal, no error shows a traceback."""

import asyncio
import io
import math
import os
import select
import signal
import sys
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import contextmanager, suppress

import click

from ldcnd.cli.names import typed
from ldcnd.contract.errors import ConfigError, LdcndError, SessionError
from ldcnd.parts import ENDS, missing_wing, on_signals
from ldcnd.printable import printable

DONE = 0
FAILED = 1
"""The daemon refused, or something failed; the message says what."""
UNREACHABLE = 3
"""No daemon answered."""
WRONG_CONFIG = 78
"""The configuration cannot work (EX_CONFIG)."""
INTERRUPTED = 130
"""By Ctrl-C."""
WRONG_USAGE = 2
"""As click has it."""
EXIT_CODES = {
    DONE: "done",
    FAILED: "refused or failed; the message says why",
    WRONG_USAGE: "wrong usage",
    UNREACHABLE: "no daemon answers",
    WRONG_CONFIG: "the configuration cannot work",
    INTERRUPTED: "interrupted by Ctrl-C; what was waited for was halted, or the message says how to halt it",
}
"""All of them, with what they mean."""


EXPECTED = (click.ClickException, click.Abort, KeyboardInterrupt, BrokenPipeError, LdcndError, ModuleNotFoundError)
"""What commands end by."""


def print_under_any_encoding() -> None:
    """Let nothing that is printed fail for its characters, or because a standard stream is closed.

    A command may have sent a motion by then, so it must get to its end, which halts or names what goes on.
    """
    for name in ("stdin", "stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # also keeps a socket from becoming standard output
            setattr(sys, name, open(os.devnull, "r+", encoding="utf-8"))  # noqa: SIM115, PTH123 - for as long as the process
        elif isinstance(stream, io.TextIOWrapper) and name != "stdin":
            stream.reconfigure(errors="backslashreplace")


def show_lines(*lines: str, err: bool = False) -> None:
    """Print lines of text."""
    print("\n".join(map(printable, lines)), file=sys.stderr if err else sys.stdout, flush=True)


def show_passing(text: str) -> None:
    """Show one line on a terminal that the next one replaces; nothing where there is no terminal."""
    if sys.stderr.isatty():
        print(f"\r{printable(text)}\x1b[K", end="", file=sys.stderr, flush=True)


def exit_code(error: BaseException) -> int:
    """Say how a command has ended; return its exit code. An unexpected error is raised again."""
    match error:
        case BaseExceptionGroup():
            codes = [exit_code(each) for each in _of_each_kind(error)]
            return INTERRUPTED if INTERRUPTED in codes else codes[0]
        case click.ClickException():
            error.show()
            return error.exit_code
        case click.Abort() | KeyboardInterrupt():
            return INTERRUPTED
        case BrokenPipeError():
            # what is still buffered has no reader either: without this the interpreter complains at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return FAILED
        case ConfigError():
            show_lines(*error.message.splitlines(), *_remedy(error), err=True)
            return WRONG_CONFIG
        case ModuleNotFoundError() if missing := missing_wing(error):
            return exit_code(missing)
        case LdcndError():
            show_error(error)
            return UNREACHABLE if isinstance(error, SessionError) else FAILED
    raise error


def show_error(error: LdcndError, whose: str = "") -> None:
    """Print an error as every command does: what, to whom, what to do, and where more is said."""
    page = [f"  more: ldcnd fault {error.page.rpartition('/')[2]}"] if error.page else []
    notes = getattr(error, "__notes__", ())
    show_lines(f"{whose}{error.message} [{error.code}]", *notes, *_remedy(error), *page, err=True)


def _remedy(error: LdcndError) -> list[str]:
    return [f"  {error.remedy.phrased(lambda step: typed(step, error.axis))}"] if error.remedy else []


def leaves_of(error: BaseException) -> list[BaseException]:
    """Return what an error is made of: what each of a group of tasks failed for, or the error itself."""
    if not isinstance(error, BaseExceptionGroup):
        return [error]
    return [leaf for each in error.exceptions for leaf in leaves_of(each)]


def _of_each_kind(group: BaseExceptionGroup[BaseException]) -> Iterable[BaseException]:
    """Return what a group of tasks failed for, the first of each kind; with what is unexpected the group is raised."""
    of_kind: dict[type[BaseException], BaseException] = {}
    for leaf in leaves_of(group):
        of_kind.setdefault(type(leaf), leaf)
    if len(of_kind) > 1 and not all(issubclass(kind, EXPECTED) for kind in of_kind):
        raise group
    return of_kind.values()


TERMINAL_DESCRIPTORS = (0, 1, 2)


def end_as_interrupted() -> None:
    """Let SIGTERM and the end of the terminal end a command as Ctrl-C does: what it has under way is ended first."""
    for number in (getattr(signal, name) for name in ENDS if name != "SIGINT" and hasattr(signal, name)):
        signal.signal(number, lambda *_: signal.raise_signal(signal.SIGINT))


def on_end(told: Callable[[], None]) -> None:
    """Call `told` at SIGTERM, SIGINT and the end of the terminal, on the running loop, instead of being killed."""
    on_signals(told, *ENDS)


class Terminal:
    """The terminal on which this program was started, if it was."""

    def __init__(self) -> None:
        self._descriptors = [each for each in TERMINAL_DESCRIPTORS if _is_terminal(each)]

    @property
    def has_gone(self) -> bool:
        """Whether it was closed since: SIGHUP then says so, and otherwise whatever the sender means by it."""
        return bool(self._descriptors) and not any(map(_is_terminal, self._descriptors))


def _is_terminal(descriptor: int) -> bool:
    with suppress(OSError):
        if os.isatty(descriptor):
            os.get_terminal_size(descriptor)  # one that was hung up is still called a terminal
            return True
    return False


FIRST_REPEAT_S = 0.8
"""A keyboard begins to repeat a key that is held within this time."""
NEXT_REPEAT_S = 0.25
"""Longest time between its repetitions; after a longer silence the key counts as released."""
BURST_BYTES = 4096
"""As much as a terminal keeps."""
HELD = " "
"""The key that lets an axis move while it is held: the space bar."""


class Keyboard:
    """The keys that are pressed, as they come: what has come since the loop looked last is one burst.

    Args:
        down: something was typed before anybody looked, so that a key may be down.
    """

    def __init__(self, *, down: bool = False) -> None:
        self._bursts: asyncio.Queue[tuple[str, float]] = asyncio.Queue()
        self._last_s = asyncio.get_running_loop().time() if down else -math.inf

    def take(self, burst: str) -> None:
        """Take what has come; nothing stands for the end of the terminal."""
        now_s = asyncio.get_running_loop().time()
        self._bursts.put_nowait((burst, now_s - self._last_s))
        self._last_s = now_s

    async def burst(self) -> str:
        """Return the next keys, which may have come before; nothing when none will come any more."""
        burst, _ = await self._bursts.get()
        return burst

    async def pressed(self, key: str) -> bool:
        """Wait until a key is pressed from now on; return False once another one is, or was, or the terminal has gone.

        Only what comes alone and behind a silence is pressed now: a key that is down already repeats itself, and what
        comes together was held up on its way, so the hand may be off by now.
        """
        before = self._bursts.qsize()
        while True:
            burst, silence_s = await self._bursts.get()
            if set(burst) != {key}:
                return False
            before -= 1
            if before < 0 and burst == key and silence_s >= NEXT_REPEAT_S:
                return True

    async def repetitions(self, key: str) -> AsyncIterator[None]:
        """Yield at each repetition of a key that is held, until it is released or another one is pressed.

        That one is left to the next question.
        """
        within_s = FIRST_REPEAT_S
        while True:
            try:
                async with asyncio.timeout(within_s):
                    burst, silence_s = await self._bursts.get()
            except TimeoutError:
                return
            if set(burst) != {key}:
                self._bursts.put_nowait((burst, silence_s))
                return
            within_s = NEXT_REPEAT_S
            yield


@contextmanager
def keys() -> Iterator[Keyboard]:
    """Yield the keys that are pressed; what was typed before is dropped.

    Raises:
        ConfigError: this system has no terminals of POSIX.
    """
    try:
        import termios  # noqa: PLC0415 - a part of POSIX
        import tty  # noqa: PLC0415 - likewise
    except ModuleNotFoundError:
        raise ConfigError(
            "keys that are held are read on POSIX systems only", remedy="say how long to run at most with --for SECONDS"
        ) from None
    loop, terminal = asyncio.get_running_loop(), sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    try:
        tty.setcbreak(terminal, termios.TCSANOW)  # what waits there is kept, because it tells of a key that is down
        waits, _, _ = select.select([terminal], [], [], 0)
        keyboard = Keyboard(down=bool(waits and _read(terminal)))

        def read() -> None:
            burst = _read(terminal)
            if not burst:
                loop.remove_reader(terminal)
            keyboard.take(burst)

        loop.add_reader(terminal, read)
        yield keyboard
    finally:
        loop.remove_reader(terminal)
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _read(terminal: int) -> str:
    """Return all that waits at a terminal; nothing at its end. The buffer of Python would give it out in parts."""
    try:
        return os.read(terminal, BURST_BYTES).decode(errors="replace")
    except OSError:  # it was hung up
        return ""
