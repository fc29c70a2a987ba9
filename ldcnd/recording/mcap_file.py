"""MCAP files of published values: JSON messages with the schemas that the daemon serves.

A file is written as NAME.part and gets its name when it is complete, so a name without `.part` is always a whole file.
Source: MCAP specification (mcap.dev), version 0; message encoding `json`, schema encoding `jsonschema`.
"""

import csv
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self, TextIO

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, McapRecord, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import CompressionType, Writer

from ldcnd.errors import ConfigError
from ldcnd.model.frozen import Frozen
from ldcnd.model.schemas import schema_text
from ldcnd.recording.topics import Published

CHUNK_BYTES = 256 * 1024
"""What is compressed and written together; a recorder that is killed loses at most so much."""
PART = ".part"


class McapFile:
    """One recording that is being written; leaving the context completes it and gives it its name.

    Raises:
        ConfigError: a file of that name exists already, or the beginning of one that was cut short.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.messages = 0
        self._part = _part_of(path)
        self._stream: BinaryIO = self._part.open("wb")
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="ldcnd")
        self._schemas: dict[type[Frozen], int] = {}
        self._channels: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Complete the file, after an error too: what was recorded so far is whole."""
        self._writer.finish()  # type: ignore[no-untyped-call] # the package leaves its result open
        self._stream.close()
        self._part.rename(self.path)

    @property
    def size_bytes(self) -> int:
        """What is on the disk so far."""
        return self._stream.tell()

    def attach(self, name: str, model: Frozen, now_ns: int) -> None:
        """Add a description of the rig."""
        data = model.model_dump_json().encode()
        self._writer.add_attachment(now_ns, now_ns, f"{name}.json", "application/json", data)

    def add(self, key: str, value: Published, now_ns: int) -> None:
        """Add a value that came at `now_ns`, UTC in ns since 1970."""
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = self._writer.register_channel(f"/{key}", "json", self._schema(type(value)))
        data = value.model_dump_json().encode()
        self._writer.add_message(channel, now_ns, data, publish_time=value.t, sequence=value.seq & 0xFFFFFFFF)
        self.messages += 1

    def _schema(self, model: type[Frozen]) -> int:
        number = self._schemas.get(model)
        if number is None:
            name = f"ldcnd.{model.__name__}"
            number = self._writer.register_schema(name, "jsonschema", schema_text(model).encode())
            self._schemas[model] = number
        return number


def _part_of(path: Path) -> Path:
    """Return the name while writing; neither a recording nor what a cut left of one is ever overwritten."""
    if path.exists():
        raise ConfigError(f"{path} exists already", value=str(path), remedy="choose another name")
    part = path.with_name(path.name + PART)
    if part.exists():
        remedy = f"`ldcnd record recover {part} WHOLE.mcap` saves what it holds; then delete it, or choose another name"
        raise ConfigError(f"{part} is left from a recording that was cut short", value=str(part), remedy=remedy)
    return part


def recover(damaged: Path, whole: Path) -> int:
    """Copy what can be read of a recording that was cut short, and return the number of messages.

    Raises:
        ConfigError: `whole` exists already, or the beginning of it.
    """
    part = _part_of(whole)
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    messages = 0
    with damaged.open("rb") as source, part.open("wb") as target:
        writer = Writer(target, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="", library="ldcnd")
        for record in _readable(source):
            if isinstance(record, Schema) and record.id not in schemas:
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in channels:
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                )
            elif isinstance(record, Attachment):
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
                messages += 1
        writer.finish()  # type: ignore[no-untyped-call] # as above
    part.rename(whole)
    return messages


def export_csv(recording: Path, table: TextIO) -> int:
    """Write every number, text and truth value of a recording as a row of its own, and return how many there were."""
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(("t_ns", "topic", "field", "value"))
    topics: dict[int, str] = {}
    count = 0
    with recording.open("rb") as source:
        for record in _readable(source):
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                for field, value in json.loads(record.data).items():
                    if field != "t" and isinstance(value, (int, float, str)):
                        rows.writerow((record.publish_time, topics[record.channel_id], field, value))
                        count += 1
    return count


def _readable(source: BinaryIO) -> Iterator[McapRecord]:
    """Yield the records up to where the file ends or makes no sense any more."""
    try:
        yield from StreamReader(source, validate_crcs=True).records
    except (McapError, CRCValidationError, struct.error):
        return
