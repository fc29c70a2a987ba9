"""A receiver that keeps what it is given."""

import asyncio

WAIT_S = 5.0


class RecordingReceiver:
    """Keeps every byte and every loss; lets a test wait for them, for at most `WAIT_S`."""

    def __init__(self) -> None:
        self.data = b""
        self.losses: list[str] = []
        self._changed = asyncio.Event()

    def data_received(self, data: bytes) -> None:
        """See `Receiver`."""
        self.data += data
        self._changed.set()

    def transport_lost(self, reason: str) -> None:
        """See `Receiver`."""
        self.losses.append(reason)
        self._changed.set()

    async def wait_for(self, count: int) -> None:
        """Return once so many bytes have come."""
        async with asyncio.timeout(WAIT_S):
            while len(self.data) < count:
                await self._next_change()

    async def wait_lost(self) -> None:
        """Return once a loss was reported."""
        async with asyncio.timeout(WAIT_S):
            while not self.losses:
                await self._next_change()

    async def _next_change(self) -> None:
        self._changed.clear()
        await self._changed.wait()
