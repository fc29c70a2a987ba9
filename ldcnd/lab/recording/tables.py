"""Recordings as tables, in memory, CSV or Parquet: one for each topic, with rows of messages and columns of values."""

import csv
import json
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from types import UnionType
from typing import Annotated, Literal, Union, get_args, get_origin

from mcap.records import Channel, Message
from pydantic import BaseModel

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.history import AxisInstant, time_of
from ldcnd.lab.recording.instants import RecordedReadings, recorded_readings
from ldcnd.lab.recording.messages import model_of
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


class RecordedTables:
    """The topics of a recording as tables; made by `recording`.

    Attributes:
        path: the recording.
        damages: what could not be read of it when it was read last.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._recording = Recording(path)
        self._readings: dict[str, RecordedReadings] = {}

    @property
    def damages(self) -> tuple[Damage, ...]:
        """What could not be read, in order."""
        return tuple(self._recording.damages)

    @cached_property
    def topics(self) -> dict[str, int]:
        """The topics, and how many messages each has.

        Raises:
            ConfigError: the file is no recording.
        """
        return dict(Counter(topic for topic, _, _ in _rows(self._recording)))

    def table(self, topic: str) -> dict[str, list[Cell]]:
        """Return the messages of a topic as columns of the same length, for `pandas.DataFrame` and `pyarrow.table`.

        The first ones are `t_ns`, when the value was true, and `received_ns`, when it was recorded, both UTC in ns
        since 1970; None stands where a message has nothing.

        Args:
            topic: such as `/ldcn/sim/tele/x/position`; its end is enough when no other topic ends so.

        Raises:
            ConfigError: there is no such topic, or several.
        """
        found = [name for name in self.topics if name == topic] or [
            name for name in self.topics if name.endswith(f"/{topic.strip('/')}")
        ]
        if len(found) != 1:
            raise ConfigError(
                f"{self.path}: {'several topics end' if found else 'no topic ends'} in {topic}: "
                f"{', '.join(found or self.topics)}",
                value=topic,
            )
        rows = [_row(message, cells) for name, message, cells in _rows(self._recording) if name == found[0]]
        names = dict.fromkeys(name for row in rows for name in row)
        return {name: [row.get(name) for row in rows] for name in names}

    def at(self, axis: str, t: int) -> AxisInstant:
        """Return where an axis was at an instant, UTC in ns since 1970, with the bounds that a daemon gives.

        Raises:
            MalformedRequest: it is no instant.
            ConfigError: the file is no recording, or has no description of the axis.
            UnknownAxis: it has no such axis.
        """
        first, _ = time_of(str(t), time.time_ns())
        return self._of(axis).at(first)

    def between(self, axis: str, t: int, until: int) -> list[AxisInstant]:
        """Return the same of the first instant of a range, of each reading in it, and of its last instant.

        Raises:
            MalformedRequest: it is no range.
            ConfigError: the file is no recording, or has no description of the axis.
            UnknownAxis: it has no such axis.
        """
        first, last = time_of(f"[{t}..{until}]", time.time_ns())
        return list(self._of(axis).between(first, last))

    def _of(self, axis: str) -> RecordedReadings:
        if axis not in self._readings:
            self._readings[axis] = recorded_readings(self._recording, axis)
        return self._readings[axis]


def recording(path: Path | str) -> RecordedTables:
    """Return the tables of a recording, which is read when one of them is."""
    return RecordedTables(Path(path))


def export_tables(path: Path, folder: Path, *, parquet: bool = False) -> Exported:
    """Write a recording into a folder, a table for each topic.

    Objects become columns with dotted names, lists of objects likewise with numbers; a list of plain values is one
    cell, in JSON. The recording is read twice, because a column may first be needed in its last message.

    Args:
        path: the recording.
        folder: where to.
        parquet: Parquet files instead of CSV.

    Raises:
        ConfigError: the file is no recording; a table exists already.
        OSError: a file cannot be read or written.
    """
    recording = Recording(path)
    columns: dict[str, dict[str, set[type]]] = {}
    for topic, message, cells in _rows(recording):
        kinds = columns.setdefault(topic, {})
        for name, cell in _row(message, cells).items():
            kinds.setdefault(name, set()).add(type(cell))
    folder.mkdir(parents=True, exist_ok=True)
    kind, suffix = (_ParquetTable, "parquet") if parquet else (_CsvTable, "csv")
    tables = {topic: kind(_file_of(topic, folder, suffix), columns[topic], topic) for topic in columns}
    rows = 0
    for topic, message, cells in _rows(recording):
        tables[topic].add(_row(message, cells))
        rows += 1
    for table in tables.values():
        table.end()
    return Exported(tuple(table.path for table in tables.values()), rows, tuple(recording.damages))


class _Table:
    """One file, and the rows that are not in it yet."""

    def __init__(self, path: Path, columns: Mapping[str, set[type]], topic: str) -> None:
        self.path = path
        self.topic = topic
        self._columns = columns
        self._rows: list[dict[str, Cell]] = []

    def add(self, row: dict[str, Cell]) -> None:
        """Take a row."""
        self._rows.append(row)
        if len(self._rows) == BLOCK_ROWS:
            self._write(self._rows)
            self._rows.clear()

    def end(self) -> None:
        """Write the rows there are."""
        self._write(self._rows)

    def _write(self, rows: list[dict[str, Cell]]) -> None:
        raise NotImplementedError


class _CsvTable(_Table):
    def __init__(self, path: Path, columns: Mapping[str, set[type]], topic: str) -> None:
        super().__init__(path, columns, topic)
        with path.open("x", encoding="utf-8") as stream:
            csv.writer(stream, lineterminator="\n").writerow(columns)

    def _write(self, rows: list[dict[str, Cell]]) -> None:
        with self.path.open("a", encoding="utf-8", newline="") as stream:
            csv.DictWriter(stream, tuple(self._columns), lineterminator="\n").writerows(rows)


class _ParquetTable(_Table):
    """A file whose columns have the types of what is published, and of their cells where this version knows none."""

    def __init__(self, path: Path, columns: Mapping[str, set[type]], topic: str) -> None:
        import pyarrow as pa  # noqa: PLC0415 - an optional package, and large
        from pyarrow.parquet import ParquetWriter  # noqa: PLC0415

        super().__init__(path, columns, topic)
        kinds = {bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
        self._table = pa.table
        known = column_kinds(model_of(topic.removeprefix("/")))
        self._types = {name: known.get(_numberless(name)) or _one_kind(found) for name, found in columns.items()}
        self._schema = pa.schema([(name, kinds.get(kind, pa.string())) for name, kind in self._types.items()])
        self._writer = ParquetWriter(path, self._schema)

    def _write(self, rows: list[dict[str, Cell]]) -> None:
        cells = {
            name: [None if (cell := row.get(name)) is None else kind(cell) for row in rows]
            for name, kind in self._types.items()
        }
        self._writer.write_table(self._table(cells, schema=self._schema))

    def end(self) -> None:
        """Write the rows there are, and what a reader needs."""
        super().end()
        self._writer.close()


@cache
def column_kinds(model: type[BaseModel] | None) -> Mapping[str, type]:
    """Return the types of the columns of what is published, by names without the numbers of lists."""
    found: dict[str, type] = {}
    for name, field in model.model_fields.items() if model else ():
        for column, kinds in _kinds(name, field.annotation).items():
            found[column] = _one_kind(kinds)
    return found


def _kinds(name: str, annotation: object) -> dict[str, set[type]]:
    """Return the types of the columns that a field becomes; a text stands for what has several, and for lists."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return {name: {type(each) for each in inner}}
    if origin is Annotated:
        return _kinds(name, inner[0])
    found: dict[str, set[type]] = {}
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        found = {f"{name}.{column}": {kind} for column, kind in column_kinds(annotation).items()}
        return found | {name: {str}}
    if inner:
        for each in inner:
            for column, kinds in _kinds(name, each).items():
                found.setdefault(column, set()).update(kinds)
        return found if origin in (Union, UnionType) else found | {name: {str}}
    plain = (kind for kind in (bool, int, float, str) if isinstance(annotation, type) and issubclass(annotation, kind))
    return {name: {kind}} if (kind := next(plain, None)) else {}


def _numberless(column: str) -> str:
    return ".".join(part for part in column.split(".") if not part.isdecimal())


def _one_kind(found: set[type]) -> type:
    kinds = found - {type(None)}
    if kinds == {int, float}:
        return float
    return kinds.pop() if len(kinds) == 1 else str


def _row(message: Message, cells: dict[str, Cell]) -> dict[str, Cell]:
    return {T_NS: message.publish_time, RECEIVED_NS: message.log_time, **cells}


def _file_of(topic: str, folder: Path, suffix: str) -> Path:
    path = folder / f"{topic.strip('/').replace('/', '.')}.{suffix}"
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
