"""The last seconds of one line, always on, and their form as text; and what is counted on a line.

Every byte is kept once, with the instant at which it was written or delivered, so that a log can be played back. One
line of text is one record: seconds, event, bytes in hexadecimal, and a remark behind a number sign; of a command its
text instead of bytes. A line that is empty or starts with a number sign is a comment.
"""

from array import array
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import accumulate, islice
from operator import itemgetter

from ldcnd.contract.errors import MalformedRequest
from ldcnd.contract.health import LineCounters

KEPT_S = 300.0
KEPT_BYTES = 16_000_000
BLOCK = 128
"""Number of records that are packed together: that takes less than a poll, 40 us."""
RECORD_BYTES = 32
"""Memory of a record besides its bytes, roughly: instant, kind, where its bytes end, and a reference to its remark."""
AT_ONCE_REMARK = " at once"
"""Ends the remark of a packet that waited for the reply before it."""
GUEST_REMARK = ": "
"""Behind the name of the guest that has caused a packet, before the rest of the remark."""
_NOTE = " # "


class WireEvent(StrEnum):
    """The kind of a record."""

    SENT = "sent"
    RECEIVED = "received"
    """The end of a reply, or all of it."""
    PART = "part"
    """Bytes of a reply that is not complete yet."""
    SETTLED = "settled"
    """Nothing more can come of the packet before: its reply is believed, or it has none."""
    TIMEOUT = "timeout"
    STRAY = "stray"
    """Bytes that belong to no request."""
    ECHO = "echo"
    """Our own bytes, returned by the adapter."""
    RESYNC = "resync"
    OPENED = "opened"
    LOST = "lost"
    BAUD = "baud"
    POLLED = "polled"
    """An axis is polled from now on; named in the remark."""
    COMMAND = "command"
    """A client's request; not on the wire, but the cause of what follows on it."""


_EVENTS = tuple(WireEvent)
_CODES = {event: code for code, event in enumerate(_EVENTS)}


WireEntry = tuple[float, WireEvent, bytes, str]
"""The fields of a record."""


@dataclass(frozen=True, slots=True)
class WireRecord:
    """One event: loop time in seconds, what, and the bytes or words that go with it."""

    at_s: float
    event: WireEvent
    data: bytes = b""
    note: str = ""

    @property
    def guest(self) -> str:
        """Who has caused a packet that was sent, by the name of a port; empty for clients and the daemon."""
        name, found, _ = self.note.partition(GUEST_REMARK)
        return name if found and self.event is WireEvent.SENT else ""

    def __str__(self) -> str:
        """Return one line of text, readable and loadable; nanoseconds are kept, and one blank for any white space."""
        note = " ".join(self.note.split())
        data = self.data.decode(errors="replace") if self.event is WireEvent.COMMAND else self.data.hex(" ")
        return f"{self.at_s:.9f} {self.event:<8} {data}{_NOTE if note else ''}{note}".rstrip()


def parse_record(line: str) -> WireRecord:
    """Read back one line of text.

    Raises:
        MalformedRequest: it is no such line.
    """
    at, _, rest = line.strip().partition(" ")
    event, _, rest = rest.strip().partition(" ")
    try:
        if event == WireEvent.COMMAND:  # its text may have a number sign in it
            return WireRecord(float(at), WireEvent.COMMAND, rest.strip().encode())
        data, _, note = f" {rest}".partition(_NOTE)
        return WireRecord(float(at), WireEvent(event), bytes.fromhex(data), note.strip())
    except ValueError as error:
        raise MalformedRequest(f"not a line of a wire log: {line!r} ({error})", value=line) from error


def parse_records(lines: Iterable[str]) -> tuple[WireRecord, ...]:
    """Read back a whole text, comments left out.

    Raises:
        MalformedRequest: a line can not be read.
    """
    return tuple(parse_record(line) for line in lines if line.strip() and not line.lstrip().startswith("#"))


class _Block:
    """Consecutive records in a quarter of the memory that they take one by one."""

    __slots__ = ("_data", "_ends", "_events", "_notes", "times_s")

    def __init__(self, entries: Sequence[WireEntry]) -> None:
        times_s, events, data, notes = zip(*entries, strict=True)
        self.times_s = array("d", times_s)
        self._events = bytes(map(_CODES.__getitem__, events))
        self._ends = array("Q", accumulate(map(len, data)))
        self._data = b"".join(data)
        self._notes = notes

    def __len__(self) -> int:
        return len(self.times_s)

    def __iter__(self) -> Iterator[WireEntry]:
        begin = 0
        for at_s, code, end, note in zip(self.times_s, self._events, self._ends, self._notes, strict=True):
            yield at_s, _EVENTS[code], self._data[begin:end], note
            begin = end

    @property
    def memory_bytes(self) -> int:
        """What its records take."""
        return RECORD_BYTES * len(self) + len(self._data)


class WireEntries(Iterable[WireEntry]):
    """What a log held at one instant, oldest first: quick to take, and unpacked only when it is gone through."""

    def __init__(self, blocks: Iterable[_Block], latest: Iterable[WireEntry], kept_s: float) -> None:
        """Take what there is, and leave out what is older than the last record by more than `kept_s`."""
        self._blocks, self._latest = tuple(blocks), tuple(latest)
        if self._latest:
            # blocks go as a whole, so the oldest one may reach back further than what was asked for
            too_old_s = self._latest[-1][0] - kept_s
        else:
            too_old_s = self._blocks[-1].times_s[-1] - kept_s if self._blocks else 0.0
        self._left_out = 0
        self._left_out = self.first_since(too_old_s)

    def __len__(self) -> int:
        """Return how many they are."""
        return sum(map(len, self._blocks)) + len(self._latest) - self._left_out

    def __iter__(self) -> Iterator[WireEntry]:
        """Yield the fields of each."""
        return self.behind(0)

    def first_since(self, at_s: float) -> int:
        """Return how many are older than an instant; takes as long as there are blocks, not records."""
        older = -self._left_out
        for block in self._blocks:
            if block.times_s[-1] >= at_s:
                return max(0, older + bisect_left(block.times_s, at_s))
            older += len(block)
        return max(0, older + bisect_left(self._latest, at_s, key=itemgetter(0)))

    def behind(self, skipped: int) -> Iterator[WireEntry]:
        """Yield the fields of the records after the first `skipped`, which are not unpacked."""
        skipped += self._left_out
        for block in self._blocks:
            if skipped < len(block):
                yield from islice(block, skipped, None)
            skipped = max(0, skipped - len(block))
        yield from islice(self._latest, skipped, None)


class WireLog:
    """The latest records of a line; appending costs about half a microsecond.

    Args:
        kept_s: records older than this are dropped, in seconds.
        kept_bytes: the oldest are dropped sooner when all take more memory than this.

    """

    def __init__(self, kept_s: float = KEPT_S, kept_bytes: int = KEPT_BYTES) -> None:
        self._dropped = 0
        self._kept_s = kept_s
        self._room_bytes = kept_bytes
        self._blocks: deque[_Block] = deque()
        self._latest: list[WireEntry] = []

    def add(self, at_s: float, event: WireEvent, data: bytes = b"", note: str = "") -> None:
        """Append one event and drop what is too old or too much; the new one always stays."""
        latest = self._latest
        latest.append((at_s, event, data, note))
        self._room_bytes -= RECORD_BYTES + len(data)
        if len(latest) == BLOCK or self._room_bytes < 0:
            self._tidy(at_s - self._kept_s)

    def _tidy(self, too_old_s: float) -> None:
        blocks, latest = self._blocks, self._latest
        if len(latest) == BLOCK:
            blocks.append(_Block(latest))
            latest.clear()
        while blocks and (self._room_bytes < 0 or blocks[0].times_s[-1] < too_old_s):
            # the newest record is in it, and stays
            if len(blocks) == 1 and not latest:
                break
            oldest = blocks.popleft()
            self._room_bytes += oldest.memory_bytes
            self._dropped += len(oldest)
        while self._room_bytes < 0 and len(latest) > 1:
            self._room_bytes += RECORD_BYTES + len(latest.pop(0)[2])
            self._dropped += 1

    @property
    def added(self) -> int:
        """How many records there were in all, those dropped since included."""
        return self._dropped + sum(map(len, self._blocks)) + len(self._latest)

    def records(self) -> list[WireRecord]:
        """Return the records, oldest first."""
        return [WireRecord(*entry) for entry in self.entries()]

    def entries(self) -> WireEntries:
        """Return what `WireRecord` is made of, for each record: quick also for a long log."""
        return WireEntries(self._blocks, self._latest, self._kept_s)


BUCKETS = 20
"""Latency buckets double from 64 us; the last one takes everything above 16 s."""


def bucket_limit_s(bucket: int) -> float:
    """Return the upper limit of a latency bucket, in seconds."""
    return 64e-6 * 2.0**bucket


class LatencyHistogram:
    """Durations in buckets that double; constant size, constant cost."""

    __slots__ = ("counts", "longest_s", "total_s")

    def __init__(self) -> None:
        self.counts = [0] * BUCKETS
        self.total_s = 0.0
        self.longest_s = 0.0

    def add(self, duration_s: float) -> None:
        """Count one duration, in seconds, not negative."""
        # in units of 64 us
        bucket = int(duration_s * 15625).bit_length()
        self.counts[bucket if bucket < BUCKETS else -1] += 1
        self.total_s += duration_s
        self.longest_s = max(self.longest_s, duration_s)

    def quantile_s(self, fraction: float) -> float:
        """Return an upper bound for the given quantile (0 to 1) in seconds; 0 when nothing was counted."""
        up_to = tuple(accumulate(self.counts))
        wanted = fraction * up_to[-1]
        if not wanted:
            return 0.0
        bucket = bisect_left(up_to, wanted)
        # the last bucket has no limit of its own
        return self.longest_s if bucket >= len(up_to) - 1 else min(bucket_limit_s(bucket), self.longest_s)


@dataclass(slots=True)
class BusStatistics:
    """Counters since the daemon started; only the bus writes them."""

    exchanges: int = 0
    replies: int = 0
    timeouts: int = 0
    corrupt_replies: int = 0
    rejected_packets: int = 0
    resent: int = 0
    resynchronisations: int = 0
    stray_bytes: int = 0
    openings: int = 0
    losses: int = 0
    bytes_out: int = 0
    bytes_in: int = 0
    wire_busy_s: float = 0.0
    """Time that requests and replies spent on the wire, servo wait and turn-around not counted."""
    stop_wait: LatencyHistogram = field(default_factory=LatencyHistogram)
    """From queueing a probe of the stop lane to its first bit."""
    latency: dict[int, LatencyHistogram] = field(
        default_factory=lambda: {lane: LatencyHistogram() for lane in range(4)}
    )
    """By lane: from queueing (polls: from their due time) to the last reply byte."""

    def counters(self) -> dict[str, int]:
        """Return what is published of the line; slotted here, because every exchange counts."""
        return {name: getattr(self, name) for name in LineCounters.model_fields}


Describe = Callable[[WireRecord], str]
"""Puts a record into words; empty where there are none."""


class Parts:
    """Puts replies of a recorded line together that were delivered in pieces."""

    def __init__(self) -> None:
        self._before = b""

    def whole(self, record: WireRecord) -> bytes:
        """Return the record's bytes behind those of the parts before it; of a part alone, nothing."""
        before, self._before = self._before, b""
        if record.event is WireEvent.PART:
            self._before = before + record.data
            return b""
        return before + record.data if record.event is WireEvent.RECEIVED else record.data
