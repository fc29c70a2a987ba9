"""The daemon's process: its event loop, how awake its processor stays, what is not collected."""

import asyncio
import gc
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from ldcnd.config import RigConfig
from ldcnd.errors import ConfigError
from ldcnd.log import get_logger

log = get_logger("process")

CPU_LATENCY = Path("/dev/cpu_dma_latency")
"""Linux: whoever holds it open with a number of microseconds in it bounds how long the processor takes to wake up."""

LoopFactory = Callable[[], asyncio.AbstractEventLoop]


def loop_factory(*, uvloop: bool) -> LoopFactory:
    """Return what makes the event loop: uvloop's where it is wanted and installed, asyncio's otherwise."""
    if uvloop:
        try:
            import uvloop as fast  # noqa: PLC0415 - an optional package
        except ImportError:
            log.warning("no uvloop", remedy="install ldcnd[fast], or set uvloop = false")
        else:
            return _finely_timed(fast.Loop)
    return asyncio.new_event_loop


def require_writable(rig: RigConfig) -> None:
    """Check that the daemon can keep what must outlive it, before anything is opened.

    Raises:
        ConfigError: it may not write where the configuration says; names where a service manager lets it.
    """
    for key, directory in (("state_dir", rig.state_dir), ("captures.directory", rig.captures.directory)):
        if directory is None:
            continue
        there = next(place for place in (directory.absolute(), *directory.absolute().parents) if place.exists())
        if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
            allowed = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
            raise ConfigError(
                f"{key}: {directory} cannot be written by this user or service",
                value=str(directory),
                remedy=f'{key} = "{allowed}", where the service may write' if allowed else "choose a writable place",
            )


@contextmanager
def held_awake(*, wanted: bool, device: Path = CPU_LATENCY) -> Iterator[None]:
    """Keep the processor out of idle states that take long to leave, for as long as the context lasts.

    Where that is refused the daemon runs all the same, a little slower, and says so.
    """
    descriptor = _hold(device) if wanted else None
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


@contextmanager
def last_words(speak: Callable[[], object]) -> Iterator[None]:
    """Have something done when the process is aborted, as a service manager does whose watchdog was not fed.

    It is done wherever the interpreter is just then, also in an event loop that hangs; then the process dies as it
    would have without.
    """

    def aborted(number: int, _frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)
        try:
            speak()
        finally:
            os.kill(os.getpid(), number)

    before = signal.signal(signal.SIGABRT, aborted)
    try:
        yield
    finally:
        signal.signal(signal.SIGABRT, before)


def settle_heap() -> None:
    """Take what start-up has left behind out of the collector's sight: it lives as long as the process.

    A full collection of it would hold up several polls.
    """
    gc.collect()
    gc.freeze()


def _finely_timed(loop: type[asyncio.AbstractEventLoop]) -> LoopFactory:
    """Give a loop the clock of asyncio's own.

    uvloop tells the time in whole milliseconds, of when its present turn began. That is longer than many a packet: a
    reply would seem to come before its request was over. The zero of both clocks is the same.
    """

    class FinelyTimed(loop):  # type: ignore[valid-type, misc] # a class that is known at run time only
        time = staticmethod(time.monotonic)  # read several times for each exchange: no Python frame round it

    return FinelyTimed


def _hold(device: Path) -> int | None:
    try:
        descriptor = os.open(device, os.O_WRONLY | os.O_CLOEXEC)
    except OSError as error:
        log.warning(
            "processor not held awake",
            device=str(device),
            reason=error.strerror,
            remedy="give the daemon write access, or set hold_cpu_awake = false",
        )
        return None
    os.write(descriptor, bytes(4))
    log.info("processor held awake", device=str(device))
    return descriptor
