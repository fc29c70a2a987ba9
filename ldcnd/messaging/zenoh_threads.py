"""Zenoh's own threads beside the event loop: those that send wait for it.

Source: thread names of eclipse-zenoh 1.10.2, looked up in a running process.
"""

import asyncio
import contextlib
import os
from pathlib import Path

THREADS = Path("/proc/self/task")
SENDERS = "tx-"
"""What the names of Zenoh's sending threads begin with; the first link makes them."""
LOOK_S = 1.0


async def senders_wait() -> None:
    """Have Zenoh's sending threads wait until the bus loop has nothing to do; return once that is arranged.

    Each sample that is published wakes one, and as an equal it takes the processor at once, sends that sample alone and
    sleeps again. As a batch thread it has its share of the processor, but interrupts nobody: what belongs to one poll
    leaves together. Under a real-time policy threads do not interrupt each other anyway.
    """
    while True:
        if _let_senders_wait():
            return
        await asyncio.sleep(LOOK_S)


def _let_senders_wait() -> bool:
    """Tell whether there were any."""
    found = False
    for thread in THREADS.iterdir():
        with contextlib.suppress(OSError):  # it has ended, or may not be changed
            if (thread / "comm").read_text().startswith(SENDERS):
                found = True
                if os.sched_getscheduler(int(thread.name)) == os.SCHED_OTHER:
                    os.sched_setscheduler(int(thread.name), os.SCHED_BATCH, os.sched_param(0))
    return found
