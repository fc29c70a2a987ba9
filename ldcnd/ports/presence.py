"""The program at a port, whatever protocol it speaks: whether it is there, what it controls, what it was refused."""

import asyncio
from collections.abc import Callable

from ldcnd.config.ports import GuestHost, PortConfig
from ldcnd.ports.control import GuestControl, Visit

SAME_REFUSAL_S = 1.0
"""The same refusal of an axis is one event in this time: old programs repeat themselves."""


class Presence:
    """A program at a port.

    Attributes:
        receive: takes what is for the program.
        hang_up: closes the program's terminal or connection; see `Door.leave`.
        ended: nothing begins any more: its port ends.
        since_s: when the program that is there sent its first byte, in loop time; None without one.
        packets: how many of its packets it was to get a reply to, since the port is served.
        refused: how many of its commands were answered and not done, likewise.
    """

    def __init__(self, port: PortConfig, host: GuestHost, group: asyncio.TaskGroup) -> None:
        self.receive: Callable[[bytes], None] = lambda _: None
        self.hang_up: Callable[[], None] = lambda: None
        self.ended = False
        self.since_s: float | None = None
        self.packets = self.refused = 0
        self._name, self._host, self._group = port.name, host, group
        self._loop = asyncio.get_running_loop()
        self._told: dict[tuple[str, str], float] = {}
        self._visit: Visit | None = None
        self._control = GuestControl(port.name, host, port.idle_s) if port.access == "control" else None
        if self._control:
            group.create_task(self._control.watch(self._fall_silent), name=f"guest {port.name} control")

    @property
    def axes(self) -> frozenset[str]:
        """The axes that it controls."""
        return self._control.axes if self._control else frozenset()

    def close(self) -> None:
        """Nothing begins any more: its port ends."""
        self.ended = True

    def leave(self, left: bytes, baud: int | None) -> None:  # noqa: ARG002 - only chains have a stop in it
        """The program has gone: nothing begins any more by what it has sent; see `Door.closed`."""
        if self._visit:
            self._visit.ended = True
        self._visit = self.since_s = None

    async def gone(self) -> None:
        """The program has gone, see `leave`: what it has commanded and has not begun is dropped, and control ends."""
        if self._control:
            await self._control.end(gone=True)

    async def send_away(self) -> None:
        """Close the program's terminal or connection; it has gone afterwards.

        Raises:
            OSError: there is no other terminal; the program stays.
        """
        self.hang_up()
        await self._fall_silent()

    async def _fall_silent(self) -> None:
        self.leave(b"", None)
        await self.gone()

    def _heard(self) -> bool:
        """Take note that the program has sent something; return whether it has come with it."""
        if self._control:
            self._control.heard()
        if self._visit is not None:
            return False
        self._visit, self.since_s = Visit(), self._loop.time()
        return True

    def _refuse(self, about: str, what: str, why: str, *, unknown: bool = False) -> None:
        """Count what was answered and not done, or perhaps not, and enter it among the events."""
        self.refused += 1
        now_s = self._loop.time()
        if now_s - self._told.get((about, what), -SAME_REFUSAL_S) >= SAME_REFUSAL_S:
            self._told[about, what] = now_s
            came = "it may have been done" if unknown else "nothing was done"
            self._host.refuse(about, f"{what}: {why}; the guest has its answer, {came}", self._name)
