"""Reading recordings that may be damaged: what can be read, and where something cannot."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mcap.exceptions import EndOfFile, McapError
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader, breakup_chunk
from zstandard import ZstdError

from ldcnd.errors import ConfigError

_UNREADABLE = (McapError, ZstdError, struct.error, ValueError)
"""What the package raises on bytes that make no sense; wrong checksums are a ValueError."""
_SHORT = (EndOfFile, struct.error)
"""What it raises on bytes that are not there."""


@dataclass(frozen=True, slots=True)
class Damage:
    """Something in a file that cannot be read.

    Attributes:
        at_bytes: where in the file it begins.
        reason: what is wrong with it.
    """

    at_bytes: int
    reason: str

    def __str__(self) -> str:
        return f"byte {self.at_bytes}: {self.reason}"


@dataclass(slots=True)
class Recording:
    """A file that may be damaged.

    Attributes:
        path: where it is.
        damages: what could not be read so far, in order.
    """

    path: Path
    damages: list[Damage] = field(default_factory=list)

    def records(self) -> Iterator[McapRecord]:
        """Yield what can be read, in order: a bad chunk is passed over, a bad record outside of chunks is the end.

        Raises:
            ConfigError: the file is no recording.
        """
        self.damages.clear()
        with self.path.open("rb") as source:
            records = StreamReader(source, emit_chunks=True).records
            at = 0
            while True:
                try:
                    record = next(records, None)
                except _UNREADABLE as error:
                    if at == 0:
                        raise ConfigError(f"{self.path}: not an MCAP file", value=str(self.path)) from error
                    short = isinstance(error, _SHORT)
                    self._damaged(at, "the file was cut short here" if short else str(error))
                    return
                if record is None:
                    return
                if isinstance(record, Chunk):
                    yield from self._parts(record, at)
                else:
                    yield record
                at = source.tell()

    def _parts(self, chunk: Chunk, at: int) -> Iterator[McapRecord]:
        try:
            parts = breakup_chunk(chunk, validate_crc=True)
        except _UNREADABLE as error:
            self._damaged(at, f"a chunk of {len(chunk.data)} bytes is damaged: {error}")
            return
        yield from parts

    def _damaged(self, at: int, reason: str) -> None:
        self.damages.append(Damage(at, reason))
