"""Zenoh's own threads beside the event loop: how many there are, and that those that send wait for it.

Source: thread names of eclipse-zenoh 1.10.2, looked up in a running process.
"""

import asyncio
import contextlib
import os
from pathlib import Path

THREADS = Path("/proc/self/task")
RUNTIME = "(rx: (worker_threads: 4), tx: (worker_threads: 8))"
"""Zenoh's default is one thread that sends. While it closes a link whose peer takes nothing (200 ms), the answers on
all other links wait; so there are more threads than such links at a time."""
SENDERS = "tx-"
"""Prefix of the names of Zenoh's sending threads; the first link makes them."""
CHECK_PERIOD_S = 1.0


def provide_threads() -> None:
    """Have Zenoh start as many threads as a daemon needs, unless the environment says so; before the first session."""
    os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)


async def senders_wait() -> None:
    """Have Zenoh's sending threads wait until the bus loop has nothing to do; return once that is arranged.

    Each sample that is published wakes one, and as an equal it takes the processor at once, sends that sample alone and
    sleeps again. As a batch thread it has its share of the processor, but preempts none: what belongs to one poll
    leaves together. Under a real-time policy threads do not interrupt each other anyway.
    """
    while True:
        found = _let_senders_wait()
        await asyncio.sleep(CHECK_PERIOD_S)
        if found:
            break
    _let_senders_wait()  # those that had just been started, and had no name yet


def _let_senders_wait() -> bool:
    """Tell whether there were any."""
    if not hasattr(os, "sched_setscheduler"):  # no Linux
        return True
    found = False
    for thread in THREADS.iterdir():
        with contextlib.suppress(OSError):  # it has ended, or may not be changed
            if (thread / "comm").read_text().startswith(SENDERS):
                found = True
                # who has given them another policy has meant it
                if os.sched_getscheduler(int(thread.name)) == os.SCHED_OTHER:
                    os.sched_setscheduler(int(thread.name), os.SCHED_BATCH, os.sched_param(0))
    return found
