"""Being told to end: what serves until somebody presses Ctrl-C or the service is stopped."""

import asyncio
import signal
from collections.abc import Callable


def end_as_interrupted() -> None:
    """Let SIGTERM end a command as Ctrl-C does: what it has under way is ended first."""
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))


def on_end(told: Callable[[], None]) -> None:
    """Call `told` at SIGTERM and SIGINT, on the running loop, instead of being killed."""
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, told)
