"""Taking a trace and fetching it whole; traces as files: JSON with everything in it, or CSV with a header of JSON."""

import asyncio
import csv
import io
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from ldcnd.client.notebook import panes
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import (
    ConfigError,
    DriveFault,
    LdcndError,
    OutcomeUnknown,
    Remedy,
    TraceTimedOut,
    WrongState,
    step,
)
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.traces import AbortTrace, TakeTrace, TraceChunk, TraceHeader, TracePhase, TraceReply

CHECK_PERIOD_S = 0.1
ENDING_S = 10.0
UNDER_WAY = frozenset({TracePhase.FILLING, TracePhase.WAITING, TracePhase.RECORDING, TracePhase.UPLOADING})


@dataclass(frozen=True, slots=True)
class Trace:
    """A complete trace; columns are as long as `offsets_ns`.

    Attributes:
        header: what it is.
        offsets_ns: when each sample was true, relative to the header's `t`.
        values: a column for each of the header's channels.
        raw: a column for each of the header's raw columns.
    """

    header: TraceHeader
    offsets_ns: tuple[int, ...] = field(repr=False)
    values: tuple[tuple[float | None, ...], ...] = field(repr=False)
    raw: tuple[tuple[int | float | None, ...], ...] = field(repr=False)

    def table(self) -> dict[str, tuple[int | float | None, ...]]:
        """Return the columns by their titles, `offset_ns` the first one, for `pandas.DataFrame` and `pyarrow.table`.

        None stands where the drive did not say.
        """
        titles = [column_title(each.name, each.unit) for each in self.header.channels]
        columns = (self.offsets_ns, *self.values, *self.raw)
        return dict(zip(("offset_ns", *titles, *self.header.raw_columns), columns, strict=True))

    def _repr_html_(self) -> str:
        """Return its channels as curves, for notebooks."""
        seconds = [offset / 1e9 for offset in self.offsets_ns]
        titles = (f"{each.name.replace('_', ' ')} [{each.unit}]" for each in self.header.channels)
        span = f"{len(seconds)} samples in {seconds[-1] - seconds[0]:.3g} s" if seconds else "no samples"
        return panes(span, seconds, zip(titles, self.values, strict=True))


async def trace_header(client: RigClient, axis: str) -> TraceHeader | None:
    """Return how far an axis's last trace is, or None when there was none."""
    headers = await client.read(client.keys.trace(axis), TraceHeader)
    return headers[0] if headers else None


async def trace_chunk(client: RigClient, axis: str, index: int) -> TraceChunk | None:
    """Return samples of an axis's last trace, or None when it has no such chunk."""
    chunks = await client.read(client.keys.trace_chunk(axis, index), TraceChunk)
    return chunks[0] if chunks else None


async def take_trace(client: RigClient, axis: str, request: TakeTrace, within_s: float) -> Trace:
    """Arm a trace, wait for its end, and return it; when cancelled meanwhile, end it.

    Args:
        client: of the rig.
        axis: to be traced.
        request: what to record.
        within_s: longest wait from its arming to its end.

    Raises:
        LdcndError: the daemon refused it.
        DriveFault: it did not complete; says why.
        OutcomeUnknown: it did not end in time, or gave way to another one; it may still be under way.
    """
    async with armed_trace(client, axis, request) as reply:
        await wait_for_trace(client, axis, reply.trace_id, within_s)
        return await fetch_trace(client, axis, reply.trace_id)


async def arm_trace(client: RigClient, axis: str, request: TakeTrace) -> TraceReply:
    """Arm a trace and return what it will be."""
    return await client.command(axis, request)


@asynccontextmanager
async def armed_trace(client: RigClient, axis: str, request: TakeTrace) -> AsyncIterator[TraceReply]:
    """Arm a trace that is ended when the context is cancelled or waits no longer; yields what it will be.

    Raises:
        LdcndError: the daemon refused it.
    """
    reply = await arm_trace(client, axis, request)
    try:
        yield reply
    except (asyncio.CancelledError, OutcomeUnknown):
        with suppress(LdcndError):  # out of reach: it ends by itself
            await _end(client, axis, reply.trace_id)
        raise


async def _end(client: RigClient, axis: str, trace_id: str) -> None:
    """End a trace, unless it has ended or given way to another one."""
    header = await trace_header(client, axis)
    if header and header.trace_id == trace_id and header.phase in UNDER_WAY:
        await client.command(axis, AbortTrace(), ENDING_S)


async def wait_for_trace(
    client: RigClient,
    axis: str,
    trace_id: str,
    within_s: float,
    progress: Callable[[TraceHeader], None] = lambda _: None,
) -> TraceHeader:
    """Wait for the end of a trace, good or bad; `progress` is called with how far it is.

    Raises:
        OutcomeUnknown: it did not end in time, or gave way to another one.
    """
    try:
        async with asyncio.timeout(within_s):
            while True:
                header = await _header(client, axis, trace_id)
                if header.phase not in UNDER_WAY:
                    return header
                progress(header)
                await asyncio.sleep(CHECK_PERIOD_S)
    except TimeoutError:
        raise OutcomeUnknown(
            f"axis {axis}: trace {trace_id} did not end within {within_s:g} s",
            axis=axis,
            remedy=Remedy("{}", step("trace_abort")),
        ) from None


async def fetch_trace(client: RigClient, axis: str, trace_id: str | None = None) -> Trace:
    """Return a complete trace: the last one, which must be this one if an id is given.

    Raises:
        WrongState: there is none, or it is under way.
        DriveFault: it did not complete; says why.
        OutcomeUnknown: it gave way to another one.
    """
    header = await _header(client, axis, trace_id)
    if header.phase in UNDER_WAY:
        raise WrongState(
            f"axis {axis}: trace {header.trace_id} is {header.phase.value}: it is not complete yet",
            axis=axis,
            value=header.phase.value,
            remedy=Remedy("wait for its end, or {}", step("trace_abort")),
        )
    if header.phase is not TracePhase.COMPLETE:
        failed = TraceTimedOut if header.phase is TracePhase.TIMED_OUT else DriveFault
        raise failed(
            f"axis {axis}: trace {header.trace_id} is {header.phase.value}: {header.problem or 'it has no samples'}",
            axis=axis,
            value=header.phase.value,
        )
    chunks = [await _chunk(client, axis, header.trace_id, index) for index in range(header.chunks)]
    return Trace(
        header,
        tuple(offset for chunk in chunks for offset in chunk.offsets_ns),
        tuple(tuple(v for chunk in chunks for v in chunk.values[column]) for column in range(len(header.channels))),
        tuple(tuple(v for chunk in chunks for v in chunk.raw[column]) for column in range(len(header.raw_columns))),
    )


async def _header(client: RigClient, axis: str, trace_id: str | None) -> TraceHeader:
    header = await trace_header(client, axis)
    if header is None:
        raise WrongState(f"axis {axis}: there is no trace", axis=axis)
    if trace_id not in (None, header.trace_id):
        raise _replaced(axis, trace_id)
    return header


async def _chunk(client: RigClient, axis: str, trace_id: str, index: int) -> TraceChunk:
    chunk = await trace_chunk(client, axis, index)
    if chunk is None or chunk.trace_id != trace_id:
        raise _replaced(axis, trace_id)
    return chunk


def _replaced(axis: str, trace_id: str | None) -> OutcomeUnknown:
    return OutcomeUnknown(f"axis {axis}: trace {trace_id} gave way to another one", axis=axis)


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
    columns = trace.table()
    text = io.StringIO()
    text.write(f"{MARK}{trace.header.model_dump_json()}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
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
