"""Recordings as CSV: one table for each topic, one row for each message, one column for each value."""

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Message

from ldcnd.contract.errors import ConfigError
from ldcnd.lab.recording.reading import Damage, Recording

T_NS = "t_ns"
"""When the value was true, UTC in ns since 1970; the column after it is when it was recorded."""
RECEIVED_NS = "received_ns"
OWN_TIME = "t"
"""Left out, because it is the first column already."""

BLOCK_ROWS = 1000
"""Rows of a table that are written together: a rig may have more topics than a process may have open files."""

Cell = int | float | str | bool | None


@dataclass(frozen=True, slots=True)
class Exported:
    """The tables written.

    Attributes:
        tables: the files.
        rows: how many messages they hold.
        damages: what could not be read of the recording.
    """

    tables: tuple[Path, ...]
    rows: int
    damages: tuple[Damage, ...]


def export_tables(path: Path, folder: Path) -> Exported:
    """Write a recording into a folder, a table for each topic.

    Objects become columns with dotted names, lists of objects likewise with numbers; a list of plain values is one
    cell, in JSON. The recording is read twice, because a column may first be needed in its last message.

    Raises:
        ConfigError: the file is no recording; a table exists already.
        OSError: a file cannot be read or written.
    """
    recording = Recording(path)
    columns: dict[str, dict[str, None]] = {}
    for topic, _, cells in _rows(recording):
        columns.setdefault(topic, {}).update(dict.fromkeys(cells))
    folder.mkdir(parents=True, exist_ok=True)
    tables = {topic: _Table(_file_of(topic, folder), tuple(columns[topic])) for topic in columns}
    rows = 0
    for topic, message, cells in _rows(recording):
        tables[topic].add({T_NS: message.publish_time, RECEIVED_NS: message.log_time, **cells})
        rows += 1
    for table in tables.values():
        table.write()
    return Exported(tuple(table.path for table in tables.values()), rows, tuple(recording.damages))


class _Table:
    """One file, and the rows that are not in it yet."""

    def __init__(self, path: Path, columns: tuple[str, ...]) -> None:
        self.path = path
        self._columns = (T_NS, RECEIVED_NS, *columns)
        self._rows: list[dict[str, Cell]] = []
        with path.open("x", encoding="utf-8") as stream:
            csv.writer(stream, lineterminator="\n").writerow(self._columns)

    def add(self, row: dict[str, Cell]) -> None:
        """Take a row."""
        self._rows.append(row)
        if len(self._rows) == BLOCK_ROWS:
            self.write()

    def write(self) -> None:
        """Write the rows there are."""
        with self.path.open("a", encoding="utf-8", newline="") as stream:
            csv.DictWriter(stream, self._columns, lineterminator="\n").writerows(self._rows)
        self._rows.clear()


def _file_of(topic: str, folder: Path) -> Path:
    path = folder / f"{topic.strip('/').replace('/', '.')}.csv"
    if path.exists():
        raise ConfigError(f"{path} exists already", value=str(path), remedy="choose another folder")
    return path


def _rows(recording: Recording) -> Iterator[tuple[str, Message, dict[str, Cell]]]:
    """Yield topic, message and cells of each message that is JSON."""
    topics: dict[int, str] = {}
    for record in recording.records():
        if isinstance(record, Channel) and record.message_encoding == "json":
            topics[record.id] = record.topic
        elif isinstance(record, Message) and record.channel_id in topics:
            yield topics[record.channel_id], record, dict(_cells("", json.loads(record.data)))


def _cells(name: str, value: object) -> Iterator[tuple[str, Cell]]:
    """Yield the columns that a value of JSON needs."""
    match value:
        case dict():
            for key, inner in value.items():
                if name or key != OWN_TIME:
                    yield from _cells(f"{name}.{key}" if name else key, inner)
        case list() if any(isinstance(inner, dict) for inner in value):
            for number, inner in enumerate(value):
                yield from _cells(f"{name}.{number}", inner)
        case list():
            yield name, json.dumps(value)
        case int() | float() | str() | None:
            yield name, value
