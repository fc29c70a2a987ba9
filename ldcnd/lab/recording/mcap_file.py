"""MCAP files of published values: JSON messages with the schemas that the daemon serves.

A file is written as NAME.part and gets its name when it is complete, so a name without `.part` is always a whole file.
Source: MCAP specification (mcap.dev), version 0; message encoding `json`, schema encoding `jsonschema`.
"""

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen
from ldcnd.lab.recording.messages import RecordedValue, schema_of

CHUNK_BYTES = 1024 * 1024
"""Maximum size that is compressed and written together; `McapFile.flush` ends a chunk earlier."""
PART = ".part"
FACTS = "ldcnd.recording"
"""Name of the metadata that tell what is missing."""


class McapFile:
    """One recording that is being written; `complete` gives it its name.

    Raises:
        ConfigError: a file of that name exists already, or the beginning of one that was cut short.
        OSError: it cannot be written; so do the methods.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._part = part_of(path)
        self._stream: BinaryIO = self._part.open("xb")
        self._writer = start_writer(self._stream)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._has_values = False
        self._is_bare = True  # on the disk

    @property
    def size_bytes(self) -> int:
        """Size of the written data, bytes."""
        return self._stream.tell()

    def attach(self, name: str, document: bytes, now_ns: int) -> None:
        """Add a description of the rig, in JSON."""
        self._writer.add_attachment(now_ns, now_ns, f"{name}.json", "application/json", document)

    def add(self, key: str, entry: RecordedValue, now_ns: int) -> None:
        """Add a value that came at `now_ns`, UTC in ns since 1970."""
        channel = self._channels.get(key)
        if channel is None:
            schema = self._schema(entry.message)
            channel = self._channels[key] = self._writer.register_channel(f"/{key}", "json", schema)
        self._writer.add_message(channel, now_ns, entry.data, publish_time=entry.t, sequence=entry.seq & 0xFFFFFFFF)
        self._has_values = True

    def flush(self) -> None:
        """Put what was added on the disk; returns when it is there."""
        self._writer.flush()  # type: ignore[no-untyped-call] # the package leaves its result open
        os.fsync(self._stream.fileno())
        self._is_bare = not self._has_values

    def complete(self, facts: Mapping[str, str]) -> None:
        """End the file, with what is to be known of it, and give it its name; see `discard_bare`."""
        with self.discard_bare(), self._stream:
            self._writer.add_metadata(FACTS, dict(facts))
            self._writer.finish()  # type: ignore[no-untyped-call] # as above
            self._stream.flush()
            os.fsync(self._stream.fileno())
        self._part.rename(self.path)

    @contextmanager
    def discard_bare(self) -> Iterator[None]:
        """Leave nothing behind of a file that cannot be written and has no value on the disk: a full one stays so."""
        try:
            yield
        except OSError:
            with suppress(OSError):
                self._stream.close()
            if self._is_bare:
                self._part.unlink(missing_ok=True)
            raise

    def _schema(self, message: type[Frozen]) -> int:
        name, text = schema_of(message)
        number = self._schemas.get(name)
        if number is None:
            number = self._schemas[name] = self._writer.register_schema(name, "jsonschema", text.encode())
        return number


def start_writer(stream: BinaryIO) -> Writer:
    """Begin a file."""
    writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(profile="", library="ldcnd")
    return writer


def part_of(path: Path) -> Path:
    """Return the name while writing; neither a recording nor what a cut left of one is ever overwritten.

    Raises:
        ConfigError: one of them is there.
    """
    if path.exists():
        raise ConfigError(f"{path} exists already", value=str(path), remedy="choose another name")
    part = path.with_name(path.name + PART)
    if part.exists():
        remedy = f"`ldcnd record recover {part} WHOLE.mcap` saves what it holds; then delete it, or choose another name"
        raise ConfigError(f"{part} is left from a recording that was cut short", value=str(part), remedy=remedy)
    return part


_NUMBERS = 2**32
"""Recordings carry sequence numbers of 32 bits."""


class Losses:
    """Checks the sequence number of each value of each key, in the order in which they came.

    What was lost before the first value of a key, or after the last, leaves no gap and is not counted.

    Attributes:
        missing: how many values of each key are missing.
        restarts: how often numbers of a key restarted, because its daemon was restarted.
    """

    def __init__(self) -> None:
        self.missing: Counter[str] = Counter()
        self.restarts = 0
        self._last: dict[str, int] = {}

    def saw(self, key: str, seq: int) -> None:
        """Count what is missing between the value before and this one."""
        last = self._last.get(key)
        self._last[key] = seq
        if last is None:
            return
        step = (seq - last) % _NUMBERS
        if 0 < step < _NUMBERS // 2:
            self.missing[key] += step - 1
        else:
            self.restarts += 1

    def facts(self) -> dict[str, str]:
        """Return what was counted, by name, for a file."""
        gaps = {f"missing {key}": str(count) for key, count in sorted((+self.missing).items())}
        return {"missing": str(self.missing.total()), "restarts": str(self.restarts), **gaps}
