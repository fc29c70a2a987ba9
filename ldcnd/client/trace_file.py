"""Traces as files: JSON with everything in it, or CSV with the header as JSON in its first line."""

import csv
import io
from pathlib import Path

from ldcnd.client.traces import Trace
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.traces import TraceHeader

MARK = "# ldcnd trace "
SUFFIXES = (".json", ".csv")


class _Document(Frozen):
    """A trace as JSON."""

    header: TraceHeader
    offsets_ns: tuple[int, ...]
    values: tuple[tuple[float | None, ...], ...]
    raw: tuple[tuple[int | float | None, ...], ...]


def require_suffix(path: Path) -> Path:
    """Return the path of a trace file.

    Raises:
        ConfigError: its name tells no format.
    """
    if path.suffix not in SUFFIXES:
        raise ConfigError(f"{path}: a trace file ends in {' or '.join(SUFFIXES)}")
    return path


def save_trace(trace: Trace, path: Path) -> None:
    """Write a trace in the format that the file's name tells.

    Raises:
        ConfigError: its name tells none, or it cannot be written.
    """
    text = trace_as_csv(trace) if require_suffix(path).suffix == ".csv" else trace_as_json(trace)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def load_trace(path: Path) -> Trace:
    """Return the trace of a file, whichever of the two formats it has.

    Raises:
        ConfigError: it cannot be read, or is no trace.
    """
    try:
        text = path.read_text(encoding="utf-8")
        return _from_csv(text) if text.startswith(MARK) else _from_json(text)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, IndexError, csv.Error) as error:
        raise ConfigError(f"{path}: not a trace: {' '.join(str(error).split())[:200]}") from error


def column_title(name: str, unit: str) -> str:
    """Return what stands above a column."""
    return f"{name} [{unit}]" if unit else name


def trace_as_json(trace: Trace) -> str:
    """Return a trace as a JSON document."""
    document = _Document(header=trace.header, offsets_ns=trace.offsets_ns, values=trace.values, raw=trace.raw)
    return document.model_dump_json() + "\n"


def trace_as_csv(trace: Trace) -> str:
    """Return a trace as a table."""
    header = trace.header
    titles = ["offset_ns", *(column_title(each.name, each.unit) for each in header.channels), *header.raw_columns]
    columns = (trace.offsets_ns, *trace.values, *trace.raw)
    text = io.StringIO()
    text.write(f"{MARK}{header.model_dump_json()}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(titles)
    writer.writerows(zip(*columns, strict=True))
    return text.getvalue()


def _from_json(text: str) -> Trace:
    document = _Document.model_validate_json(text)
    return _checked(Trace(document.header, document.offsets_ns, document.values, document.raw))


def _from_csv(text: str) -> Trace:
    first, _titles, *lines = text.splitlines()
    header = TraceHeader.model_validate_json(first.removeprefix(MARK))
    rows = list(csv.reader(lines))
    width = len(header.channels) + 1
    offsets = tuple(int(row[0]) for row in rows)
    values = tuple(tuple(_number(row[at]) for row in rows) for at in range(1, width))
    raw = tuple(tuple(_exact(row[at]) for row in rows) for at in range(width, width + len(header.raw_columns)))
    return _checked(Trace(header, offsets, values, raw))


def _number(cell: str) -> float | None:
    return float(cell) if cell else None


def _exact(cell: str) -> int | float | None:
    """Return a number as it was: a count stays one."""
    if not cell:
        return None
    return float(cell) if any(mark in cell for mark in ".eE") else int(cell)


def _checked(trace: Trace) -> Trace:
    """Refuse a file whose columns do not fit together.

    Raises:
        ValueError: they do not.
    """
    header, length = trace.header, len(trace.offsets_ns)
    if (len(trace.values), len(trace.raw)) != (len(header.channels), len(header.raw_columns)):
        raise ValueError("it has other columns than its header says")
    if not length:
        raise ValueError("it has no samples")
    if any(len(column) != length for column in (*trace.values, *trace.raw)):
        raise ValueError("its columns differ in length")
    return trace
