"""Reading the trace memories of one drive, piece by piece, so that polls and commands keep their turns in between.

Each piece is one exchange of the background lane, sent when the polls have caught up: a poller that reads several words
has its next one ready only a moment after the last, too late to go before a piece that waits already. So a poll waits
for one piece at most, unless the line has no time to spare: then a piece goes all the same, but seldom. The checksum of
a string may not cover its data, so a piece counts when two readings of it agree.
Source: manual 2.2, data string reference command; 4, settings 9.
"""

import asyncio
import contextlib
from collections.abc import Callable

from ldcnd.contract.errors import BadReply, ByteCountRefused, ReplyTimeout
from ldcnd.drives.smartstep.commands import ChecksumPin, Refusal, StringReply, string_reference
from ldcnd.drives.smartstep.profiles import SmartStepProfile, StringChecksum
from ldcnd.drives.smartstep.trace_data import Chunk, chunk_plan, split_words
from ldcnd.drives.smartstep.words import Words
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, Lane

ROUNDS = 4
"""Maximum readings of a piece until two agree, and maximum time-outs of one reading."""

REPORTED_EACH = 0.01
"""Least growth of the share that has been read between two reports."""
IDLE_PERIOD_S = 0.005
LONGEST_REST_S = 5.0
"""Maximum pause between two pieces on a line that is never idle, seconds; in it others send some 700 characters."""


class TraceUpload:
    """One upload; remembers what it has learnt of the drive's strings."""

    def __init__(self, bus: Bus, words: Words, profile: SmartStepProfile) -> None:
        self._bus = bus
        self._words = words
        self._profile = profile
        self._pin = ChecksumPin()

    @property
    def string_checksum(self) -> StringChecksum:
        """Which variant was found or is taken; AUTO while the replies leave a choice."""
        if self._profile.unit.trace.string_checksum is StringChecksum.AUTO:
            return self._pin.pinned
        return self._profile.unit.trace.string_checksum

    async def fetch(self, trace: int, read: Callable[[float], None] = lambda _: None) -> tuple[int, ...]:
        """Return the words of trace memory 1 or 2, in the order of the memory.

        Args:
            trace: 1 or 2.
            read: called with the share of the memory that has been read, whenever that has grown by a percent.

        Raises:
            BadReply: the drive's strings are not as the profile says, or no two readings agree.
            DriveFault: the drive declined.
            BusError: the line failed.
        """
        data, reported = b"", 0.0
        chunks = chunk_plan(trace, self._profile.unit.trace.chunk_bytes)
        whole = sum(chunk.byte_count for chunk in chunks)
        for chunk in chunks:
            data += await self._fetch(chunk)
            if len(data) / whole >= reported + REPORTED_EACH:
                reported = len(data) / whole
                read(reported)
        return split_words(data, self._profile.unit.trace.byte_order)

    async def _fetch(self, chunk: Chunk) -> bytes:
        """Return the bytes of a chunk, in smaller pieces when the drive refuses that length."""
        try:
            return await self._agreed(chunk)
        except ByteCountRefused:
            # the longest string is not documented, and a drive that refuses one says no other number
            halves = chunk.halves()
            if halves is None:
                raise
        first, second = halves
        return await self._fetch(first) + await self._fetch(second)

    async def _agreed(self, chunk: Chunk) -> bytes:
        data = await self._read(chunk)
        if not self._profile.unit.trace.verify:
            return data
        for _ in range(ROUNDS):
            again = await self._read(chunk)
            if again == data:
                return data
            data = again
        raise BadReply(
            f"axis {self._words.axis}: {chunk.byte_count} bytes at {chunk.address:04X}H read differently each time"
        )

    async def _read(self, chunk: Chunk) -> bytes:
        # once it is known, a reply that fits another variant is damaged
        profile = self._profile.with_trace(string_checksum=self.string_checksum)
        exchange = string_reference(self._words.unit, chunk.address, chunk.byte_count, profile)
        for _ in range(ROUNDS - 1):
            with contextlib.suppress(ReplyTimeout):
                return await self._ask(exchange)
        return await self._ask(exchange)

    async def _ask(self, exchange: Exchange[StringReply | Refusal]) -> bytes:
        await self._wait_for_idle_line()
        reply = await self._words.ask(exchange, Lane.BACKGROUND)
        self._pin.take(reply)
        return reply.data

    async def _wait_for_idle_line(self) -> None:
        """Return when nothing was sent for a moment, or after the longest rest."""
        loop = asyncio.get_running_loop()
        at_the_latest_s = loop.time() + LONGEST_REST_S
        statistics = self._bus.statistics
        while loop.time() < at_the_latest_s:
            before = statistics.exchanges
            await asyncio.sleep(IDLE_PERIOD_S)
            # idle now, and all the time since: a poll between two looks would not show otherwise
            if self._bus.is_idle and statistics.exchanges == before:
                return
