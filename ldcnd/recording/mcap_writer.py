"""Writes MCAP: messages in chunks compressed with Zstandard, every index, and a summary at the end.

A recorder of everything writes tens of thousands of messages a second. The writer of the package `mcap` spends some
fifty calls on each; here a message is one packed header and its bytes, and an entry of its channel's index. The records
that are few are the package's own.
Source: MCAP specification (mcap.dev), version 0.
"""

import zlib
from collections.abc import Sequence
from itertools import chain
from struct import Struct, pack
from typing import BinaryIO, Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

CHUNK_BYTES = 1024 * 1024
"""Maximum size that is compressed and written together; `flush` ends a chunk earlier."""
_MESSAGE = Struct("<BQHIQQ")
"""Opcode, length, channel, sequence number, instants of recording and of publication."""
_MESSAGE_BYTES = _MESSAGE.size - 9
"""Of them, what the length counts."""


class _Record(Protocol):
    def write(self, stream: RecordBuilder) -> object: ...


class McapWriter:
    """One file that is being written.

    Attributes:
        size_bytes: how many bytes have been written, without the chunk under way.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.size_bytes = 0
        self._chunk = bytearray()
        self._indexes: dict[int, list[tuple[int, int]]] = {}  # of the chunk, by channel: instant and place
        self._counts: dict[int, int] = {}  # by channel
        self._first_ns, self._last_ns = 0, 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._write(MCAP0_MAGIC)
        self._put(Header(profile="", library="ldcnd"))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; return its number."""
        schema = Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data)
        self._schemas.append(schema)
        self._chunk += _bytes_of(schema)
        return schema.id

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str] | None = None
    ) -> int:
        """Add a channel; return its number."""
        number = len(self._channels) + 1
        record = Channel(
            id=number,
            topic=topic,
            message_encoding=message_encoding,
            schema_id=schema_id,
            metadata=metadata or {},
        )
        self._channels.append(record)
        self._chunk += _bytes_of(record)
        self._indexes[number] = []
        self._counts[number] = 0
        return number

    def add_message(self, channel: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None:
        """Add a message; both instants in ns since 1970."""
        records = self._chunk
        self._indexes[channel].append((log_time, len(records)))
        records += _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_BYTES + len(data), channel, sequence, log_time, publish_time)
        records += data
        if len(records) > CHUNK_BYTES:
            self._end_chunk()

    def add_attachment(self, create_time: int, log_time: int, name: str, media_type: str, data: bytes) -> None:
        """Add a file."""
        at = self.size_bytes
        length = self._put(
            Attachment(create_time=create_time, log_time=log_time, name=name, media_type=media_type, data=data)
        )
        self._attachments.append(AttachmentIndex(at, length, log_time, create_time, len(data), name, media_type))

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Add facts, by name."""
        at = self.size_bytes
        self._metadata.append(MetadataIndex(at, self._put(Metadata(name=name, metadata=data)), name))

    def flush(self) -> None:
        """End the chunk, if there is a message in it, and hand everything to the operating system."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """End the file, with its summary; the stream stays open."""
        self._end_chunk()
        self._put(DataEnd(0))
        start = self.size_bytes
        summary = bytearray()
        offsets: list[SummaryOffset] = []
        groups: Sequence[tuple[Opcode, Sequence[_Record]]] = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        for opcode, records in groups:
            before = len(summary)
            summary += b"".join(map(_bytes_of, records))
            offsets.append(SummaryOffset(opcode, start + before, len(summary) - before))
        offsets_start = start + len(summary)
        summary += b"".join(map(_bytes_of, offsets))
        footer = Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=0)
        checked = zlib.crc32(_bytes_of(footer)[:-4], zlib.crc32(summary))
        self._write(summary)
        self._put(Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=checked))
        self._write(MCAP0_MAGIC)

    def _end_chunk(self) -> None:
        used = [(channel, entries) for channel, entries in self._indexes.items() if entries]
        if not used:
            return
        used.sort(key=lambda index: index[1][0][1])  # by the first message of each
        instants = [at for _, entries in used for at, _ in entries]
        first_ns, last_ns = min(instants), max(instants)
        self._first_ns = min(self._first_ns, first_ns) if self._chunks else first_ns
        self._last_ns = max(self._last_ns, last_ns)
        records, at = bytes(self._chunk), self.size_bytes
        compressed = zstandard.compress(records)
        length = self._put(
            Chunk(
                compression="zstd",
                data=compressed,
                message_start_time=first_ns,
                message_end_time=last_ns,
                uncompressed_crc=zlib.crc32(records),
                uncompressed_size=len(records),
            )
        )
        places, indexes_at = {}, self.size_bytes
        for channel, entries in used:
            places[channel] = self.size_bytes
            count = len(entries)
            self._write(pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + 16 * count, channel, 16 * count))
            self._write(pack(f"<{2 * count}Q", *chain.from_iterable(entries)))
            self._counts[channel] += count
            self._indexes[channel] = []
        self._chunks.append(
            ChunkIndex(
                message_start_time=first_ns,
                message_end_time=last_ns,
                chunk_start_offset=at,
                chunk_length=length,
                message_index_offsets=places,
                message_index_length=self.size_bytes - indexes_at,
                compression="zstd",
                compressed_size=len(compressed),
                uncompressed_size=len(records),
            )
        )
        self._chunk.clear()

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts={channel: count for channel, count in self._counts.items() if count},
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_start_time=self._first_ns,
            message_end_time=self._last_ns,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _put(self, record: _Record) -> int:
        """Write a record; return its length."""
        return self._write(_bytes_of(record))

    def _write(self, data: bytes | bytearray) -> int:
        self._stream.write(data)
        self.size_bytes += len(data)
        return len(data)


def _bytes_of(record: _Record) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call] # the package leaves its result open
    return data
