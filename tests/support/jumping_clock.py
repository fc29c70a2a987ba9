"""An event loop whose clock jumps to its next timer instead of waiting, and that reports a deadlock as an error.

For everything that stays inside the process: the daemon, the simulated line, the memory session. Not for real Zenoh,
ptys or sockets: their bytes would arrive after the clock has jumped past every deadline.
"""

import asyncio
import selectors
from typing import Any


class _JumpingSelector(selectors.SelectSelector):
    """Never waits: with nothing ready, the clock moves on to the next timer."""

    now_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready:
            return ready
        if timeout is None:
            raise RuntimeError("deadlock: nothing is ready and no timer is pending")
        self.now_s += max(0.0, timeout)
        return ready


class JumpingLoop(asyncio.SelectorEventLoop):
    """A selector loop in virtual time, starting at 0."""

    def __init__(self) -> None:
        self._jumping = _JumpingSelector()
        super().__init__(self._jumping)
        self._clock_resolution = 1e-9

    def time(self) -> float:
        """Return virtual seconds since the loop was made."""
        return self._jumping.now_s

    def hold_up(self, duration_s: float) -> None:
        """Let time pass as if the callback that runs now had taken so long."""
        self._jumping.now_s += duration_s

    def run_in_executor(self, _executor: Any, func: Any, *args: Any) -> "asyncio.Future[Any]":  # type: ignore[override]
        """Run at once: a thread's work takes no virtual time."""
        future: asyncio.Future[Any] = self.create_future()
        try:
            future.set_result(func(*args))
        except BaseException as error:  # noqa: BLE001 - a future carries any exception of its work
            future.set_exception(error)
        return future
