"""A terminal: keys as they are pressed and held."""

import asyncio
import sys
import termios
import tty
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager

FIRST_REPEAT_S = 0.8
"""A keyboard begins to repeat a key that is held within this time."""
NEXT_REPEAT_S = 0.25
"""Longest time between its repetitions; after a longer silence the key counts as released."""


@contextmanager
def keys() -> Iterator["asyncio.Queue[str]"]:
    """Yield the keys that are pressed, one by one, as they come."""
    pressed: asyncio.Queue[str] = asyncio.Queue()
    loop, terminal = asyncio.get_running_loop(), sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    loop.add_reader(terminal, lambda: pressed.put_nowait(sys.stdin.read(1)))
    try:
        yield pressed
    finally:
        loop.remove_reader(terminal)
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


async def repetitions(pressed: "asyncio.Queue[str]", key: str) -> AsyncIterator[None]:
    """Yield at each repetition of a key that is held, until it is released or another one is pressed."""
    within_s = FIRST_REPEAT_S
    while True:
        try:
            async with asyncio.timeout(within_s):
                if await pressed.get() != key:
                    return
        except TimeoutError:
            return
        within_s = NEXT_REPEAT_S
        yield
