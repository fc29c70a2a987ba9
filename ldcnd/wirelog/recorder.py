"""The last seconds of one line, always on, and their form as text.

Every byte is kept once, with the instant at which it was written or delivered, so that a log can be played back. One
line of text is one record: seconds, event, bytes in hexadecimal, and a remark behind a number sign; of a command its
text instead of bytes. A line that is empty or starts with a number sign is a comment.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from ldcnd.errors import MalformedRequest

KEPT_S = 300.0
KEPT_BYTES = 16_000_000
RECORD_BYTES = 200
"""Memory of a record besides its bytes, roughly: a tuple, a float, the object that holds the bytes."""
AT_ONCE_REMARK = " at once"
"""Ends the remark of a packet that waited for the reply before it."""
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


ARRIVALS = frozenset({WireEvent.RECEIVED, WireEvent.PART, WireEvent.STRAY, WireEvent.ECHO})
"""Records from the far end, each in one piece."""


WireEntry = tuple[float, WireEvent, bytes, str]
"""The fields of a record."""


@dataclass(frozen=True, slots=True)
class WireRecord:
    """One event: loop time in seconds, what, and the bytes or words that go with it."""

    at_s: float
    event: WireEvent
    data: bytes = b""
    note: str = ""

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
        self._ring: deque[WireEntry] = deque()

    def add(self, at_s: float, event: WireEvent, data: bytes = b"", note: str = "") -> None:
        """Append one event and drop what is too old or too much; the new one always stays."""
        ring = self._ring
        ring.append((at_s, event, data, note))
        self._room_bytes -= RECORD_BYTES + len(data)
        if self._room_bytes < 0 or ring[0][0] < at_s - self._kept_s:
            self._drop(at_s - self._kept_s)

    def _drop(self, too_old_s: float) -> None:
        ring = self._ring
        while ring[0][0] < too_old_s or (self._room_bytes < 0 and len(ring) > 1):
            self._room_bytes += RECORD_BYTES + len(ring.popleft()[2])
            self._dropped += 1

    @property
    def added(self) -> int:
        """How many records there were in all, those dropped since included."""
        return self._dropped + len(self._ring)

    def records(self) -> list[WireRecord]:
        """Return the records, oldest first."""
        return [WireRecord(*entry) for entry in self._ring]

    def entries(self) -> tuple[WireEntry, ...]:
        """Return what `WireRecord` is made of, for each record: quick also for a long log."""
        return tuple(self._ring)
