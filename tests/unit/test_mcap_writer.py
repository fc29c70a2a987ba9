"""Recordings are byte for byte what the writer of the package `mcap` makes of the same messages."""

import io

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from ldcnd.recording import mcap_writer
from ldcnd.recording.mcap_writer import McapWriter

CHUNK_BYTES = 4096
MESSAGES = 500


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch):
    monkeypatch.setattr(mcap_writer, "CHUNK_BYTES", CHUNK_BYTES)


def fill(writer) -> None:
    writer.add_attachment(5, 6, "config.json", "application/json", b'{"rig": "sim"}')
    schemas = [writer.register_schema(name, "jsonschema", b'{"type": "object"}') for name in ("position", "state")]
    channels = [writer.register_channel(f"/{key}", "json", schema) for key in "xy" for schema in schemas]
    for number in range(MESSAGES):
        # the wall clock may be set back
        at_ns = 10**18 + number * 1000 - (70_000 if number % 97 == 0 else 0)
        data = b'{"value": %d}' % number
        writer.add_message(channels[number % 3], at_ns, data, at_ns - 10, number & 0xFFFFFFFF)
        if number == MESSAGES // 2:
            writer.flush()
    writer.add_metadata("facts", {"messages": str(MESSAGES), "missing": "0"})
    writer.finish()


def written() -> bytes:
    stream = io.BytesIO()
    fill(McapWriter(stream))
    return stream.getvalue()


def test_a_file_is_what_the_package_writes():
    stream = io.BytesIO()
    package = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
    package.start(profile="", library="ldcnd")
    fill(package)

    assert written() == stream.getvalue()


def test_an_empty_file_is_what_the_package_writes():
    ours, theirs = io.BytesIO(), io.BytesIO()
    McapWriter(ours).finish()
    package = Writer(theirs)
    package.start(profile="", library="ldcnd")
    package.finish()

    assert ours.getvalue() == theirs.getvalue()


def test_checksums_indexes_and_summary_hold():
    data = written()
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    summary = reader.get_summary()

    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == MESSAGES
    assert len(summary.chunk_indexes) > 5
    assert len([*reader.iter_messages()]) == MESSAGES
    of_one = [message.sequence for _, _, message in reader.iter_messages(topics=["/y"], log_time_order=False)]
    assert of_one == [number for number in range(MESSAGES) if number % 3 == 2]
    assert [attachment.name for attachment in reader.iter_attachments()] == ["config.json"]
    assert len([*StreamReader(io.BytesIO(data), validate_crcs=True).records]) > len(summary.chunk_indexes)


def test_a_size_is_what_was_written():
    stream = io.BytesIO()
    writer = McapWriter(stream)
    fill(writer)

    assert writer.size_bytes == len(stream.getvalue())
