"""An axis as a motor record: what puts wait for that its samples show, a place of now and that it stands."""

import asyncio
from collections.abc import Callable
from contextlib import suppress

from ldcnd.client.rest import REST_S, until_at_rest
from ldcnd.contract.errors import CommandAborted, LdcndError
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import Sample
from ldcnd.lab.borrowed_control import BorrowedControl
from ldcnd.lab.epics.record import Defaults
from ldcnd.lab.epics.settable import SettableRecord

SHOWN_S = 2.0
"""Longest wait for a position and a state that say what a put has set, in seconds."""


class WatchedRecord(SettableRecord):
    """A record whose samples can be waited for; see `MotorRecord`."""

    def __init__(self, info: AxisInfo, defaults: Defaults | None) -> None:
        super().__init__(info, defaults)
        self.control: BorrowedControl  # set before the first put
        self._changed = asyncio.Event()

    async def take(self, sample: Sample, item: str = "") -> None:
        """Show a sample, and tell those who wait for a state."""
        await super().take(sample, item)
        self._changed.set()

    async def _news(self) -> None:
        """Wait until a sample is shown."""
        self._changed.clear()
        await self._changed.wait()

    async def _show_from_now_on(self) -> None:
        """Wait until the record shows a position and a state of now, but not for ever."""
        state_t, position_t = await self.control.published()
        with suppress(TimeoutError):
            async with asyncio.timeout(SHOWN_S):
                while self._measured <= position_t or (self.state and self.state.t < state_t):
                    await self._news()

    async def _rest(self) -> None:
        """Wait until the axis stands, but not for ever: DMOV says when it does."""
        with suppress(LdcndError):
            await until_at_rest(self.info.axis, lambda: self.state, self._news, REST_S)

    async def _stands_unless(self, is_over: Callable[[], bool]) -> None:
        """Wait until a state of from now on says that the axis stands, or until that is waited for no more.

        Raises:
            CommandAborted: it was stopped meanwhile; who clears the latch may not know of what waits here.
            LdcndError: it does not come to rest, or is out of sight.
        """

        async def news() -> None:
            await self._news()
            if self.state and self.state.stop_latched:
                raise CommandAborted(
                    f"axis {self.info.axis}: it was stopped before it came to rest",
                    axis=self.info.axis,
                    remedy="reset it, then put the distance again",
                )
            if is_over():
                raise _OverError

        await self._show_from_now_on()
        with suppress(_OverError):
            await until_at_rest(self.info.axis, lambda: self.state, news, REST_S)


class _OverError(Exception):
    """What was waited for does not matter any more."""
