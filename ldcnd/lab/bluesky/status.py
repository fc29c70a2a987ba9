"""Statuses that a Bluesky plan waits for: the end of work that was begun on the devices' own loop."""

import asyncio
import concurrent.futures
from collections.abc import Callable, Generator
from typing import Any


class Status:
    """The state of some work, as `bluesky.protocols.Status` has it; may be used from any thread, or awaited.

    Attributes:
        name: what it is the status of, for people.
    """

    def __init__(self, name: str, work: concurrent.futures.Future[Any]) -> None:
        self.name = name
        self._work = work

    @property
    def done(self) -> bool:
        """The work has ended, well or not."""
        return self._work.done()

    @property
    def success(self) -> bool:
        """The work has ended well."""
        return self.done and self.exception() is None

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        """Return why the work failed, or None when it did not.

        Args:
            timeout: how long to wait for its end, in seconds; None for as long as it takes.

        Raises:
            TimeoutError: it has not ended in time.
        """
        try:
            return self._work.exception(timeout)
        except concurrent.futures.CancelledError:
            return asyncio.CancelledError(f"{self.name} was cancelled")

    def add_callback(self, callback: Callable[["Status"], None]) -> None:
        """Call `callback` with this status at the end of the work, at once if that is past; on any thread."""
        self._work.add_done_callback(lambda _: callback(self))

    def wrapped(self) -> "asyncio.Future[None]":
        """Return the work as a future of the running loop."""
        return asyncio.wrap_future(self._work)

    def __await__(self) -> Generator[object, None, None]:
        """Wait for the end of the work on the running loop."""
        return self.wrapped().__await__()

    def cancel(self) -> None:
        """Give the work up."""
        self._work.cancel()

    def wait(self, timeout: float | None = None) -> None:
        """Wait for the end of the work, and raise why it failed.

        Args:
            timeout: longest wait, in seconds; None for as long as it takes.

        Raises:
            TimeoutError: it has not ended in time.
            LdcndError: as the work ended.
        """
        error = self.exception(timeout)
        if error is not None:
            raise error

    def __repr__(self) -> str:
        ended = "done" if self.done and self.success else "failed" if self.done else "under way"
        return f"<{self.name}: {ended}>"


def finished(name: str) -> Status:
    """Return the status of what needed no time."""
    work: concurrent.futures.Future[None] = concurrent.futures.Future()
    work.set_result(None)
    return Status(name, work)
