"""The last few thousand packets of one line, always on, and their form as text.

One line of text is one record: seconds, event, bytes in hexadecimal, and a remark behind a number sign. A line that is
empty or starts with a number sign is a comment.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from ldcnd.errors import MalformedRequest

_NOTE = " # "


class WireEvent(StrEnum):
    """What happened on the wire."""

    SENT = "sent"
    RECEIVED = "received"
    TIMEOUT = "timeout"
    STRAY = "stray"
    RESYNC = "resync"
    OPENED = "opened"
    LOST = "lost"
    BAUD = "baud"


@dataclass(frozen=True, slots=True)
class WireRecord:
    """One event: loop time in seconds, what, and the bytes or words that go with it."""

    at_s: float
    event: WireEvent
    data: bytes = b""
    note: str = ""

    def __str__(self) -> str:
        """Return one line of text, readable and loadable; microseconds are kept, and one blank for any white space."""
        note = " ".join(self.note.split())
        return f"{self.at_s:.6f} {self.event:<8} {self.data.hex(' ')}{_NOTE if note else ''}{note}".rstrip()


def parse_record(line: str) -> WireRecord:
    """Read back one line of text.

    Raises:
        MalformedRequest: it is no such line.
    """
    fields, _, note = line.partition(_NOTE)
    at, _, rest = fields.strip().partition(" ")
    event, _, data = rest.strip().partition(" ")
    try:
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
    """A ring of the latest records; appending costs well under a microsecond.

    Attributes:
        added: how many records there were in all, those dropped since included.
    """

    def __init__(self, records: int = 4096) -> None:
        self.added = 0
        self._ring: deque[tuple[float, WireEvent, bytes, str]] = deque(maxlen=records)

    def add(self, at_s: float, event: WireEvent, data: bytes = b"", note: str = "") -> None:
        """Append one event, dropping the oldest when full."""
        self.added += 1
        self._ring.append((at_s, event, data, note))

    def records(self) -> list[WireRecord]:
        """Return the records, oldest first."""
        return [WireRecord(*entry) for entry in self._ring]
