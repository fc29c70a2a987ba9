"""Being told to end: what serves until somebody presses Ctrl-C or the service is stopped."""

import asyncio
import signal
from collections.abc import Callable


def on_end(told: Callable[[], None]) -> None:
    """Call `told` at SIGTERM and SIGINT, on the running loop, instead of being killed."""
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, told)
