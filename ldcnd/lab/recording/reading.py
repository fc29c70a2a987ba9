"""Reading recordings that may be damaged: what can be read, and where something cannot."""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from pydantic import ValidationError
from zstandard import ZstdError

from ldcnd.contract.errors import ConfigError, UnknownAxis
from ldcnd.contract.events import CommandEvent
from ldcnd.contract.samples import (
    AdcSample,
    FaultSample,
    MonitorSample,
    PositionSample,
    Quality,
    Sample,
    VelocitySample,
)
from ldcnd.lab.recording.messages import LogMessage, axis_of, model_of

_UNREADABLE = (McapError, ZstdError, struct.error, ValueError)
"""Exceptions of the package for bytes that make no sense; wrong checksums are a ValueError."""
_SHORT = (EndOfFile, struct.error)
"""Its exceptions for missing bytes."""


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
        damages: what could not be read, in order.
    """

    path: Path
    damages: list[Damage] = field(default_factory=list)

    def records(self) -> Iterator[McapRecord]:
        """Yield what can be read, in order: a bad chunk is passed over, a bad record outside of chunks is the end.

        Raises:
            ConfigError: the file is no recording, or cannot be opened.
        """
        self.damages.clear()
        try:
            source = self.path.open("rb")
        except OSError as error:
            raise ConfigError(f"{self.path}: {error.strerror}", value=str(self.path)) from error
        with source:
            records = StreamReader(source, emit_chunks=True).records
            at = 0
            while True:
                try:
                    record = next(records, None)
                except _UNREADABLE as error:
                    if at == 0:
                        empty = not self.path.stat().st_size
                        raise ConfigError(
                            f"{self.path}: {'nothing was recorded' if empty else 'not an MCAP file'}",
                            value=str(self.path),
                            remedy="delete it" if empty else None,
                        ) from error
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


@dataclass(slots=True)
class Series:
    """One quantity.

    Attributes:
        title: what it is.
        unit: its unit; empty without one.
        t_ns: when each value was true, UTC in ns since 1970.
        values: as many; NaN where the value was worth nothing.
    """

    title: str
    unit: str
    t_ns: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)


class AxisHistory:
    """The recorded description of one axis.

    Attributes:
        axis: its name.
        series: the quantities, in the order in which they were first published.
        events: what became of its commands, in order.
        not_understood: number of messages that this version cannot decode, such as those of a much older one.
        faults: from when to when a fault stood that stops the motor, UTC in ns since 1970; an end of None is not known.
    """

    def __init__(self, axis: str) -> None:
        self.axis = axis
        self.series: list[Series] = []
        self.events: list[CommandEvent] = []
        self.not_understood = 0
        self.faults: list[tuple[int, int | None]] = []

    def add(self, key: str, data: bytes) -> None:
        """Take a message of the axis, in JSON."""
        model = model_of(key)
        if model is None:
            return
        recorded = LogMessage if model is CommandEvent else model
        try:
            message = recorded.model_validate_json(data, extra="ignore")
        except ValidationError:
            self.not_understood += 1
            return
        match message:
            case LogMessage() as log:
                self.events.append(log.event)
            case FaultSample() as sample:
                self._fault(sample.t, stands=any(fault.stops for fault in sample.active))
            case PositionSample() as sample:
                self._value(sample, "position", sample.unit, sample.value)
                if sample.following_error is not None:
                    self._value(sample, "following error", sample.unit, sample.following_error)
            case VelocitySample() as sample:
                self._value(sample, "velocity", sample.unit, sample.value)
            case AdcSample() as sample:
                self._value(sample, "analog input", "V", sample.volts)
            case MonitorSample() as sample:
                self._value(sample, sample.title, sample.unit, sample.value)

    def _fault(self, t_ns: int, *, stands: bool) -> None:
        open_since = self.faults[-1][0] if self.faults and self.faults[-1][1] is None else None
        if stands and open_since is None:
            self.faults.append((t_ns, None))
        elif not stands and open_since is not None:
            self.faults[-1] = (open_since, t_ns)

    def _value(self, sample: Sample, title: str, unit: str, value: float) -> None:
        series = next((series for series in self.series if series.title == title), None)
        if series is None:
            series = Series(title, unit)
            self.series.append(series)
        series.t_ns.append(sample.t)
        series.values.append(math.nan if sample.quality is Quality.BAD else value)


def axis_history(recording: Recording, axis: str) -> AxisHistory:
    """Read one axis of a recording.

    Raises:
        ConfigError: the file is no recording.
        UnknownAxis: it has no such axis; names those that it has.
    """
    history = AxisHistory(axis)
    axes: set[str] = set()
    keys: dict[int, str] = {}
    for record in recording.records():
        if isinstance(record, Channel):
            name = axis_of(key := record.topic.removeprefix("/"))
            if name is not None:
                axes.add(name)
            if name == axis:
                keys[record.id] = key
        elif isinstance(record, Message) and record.channel_id in keys:
            history.add(keys[record.channel_id], record.data)
    if axis not in axes:
        known = ", ".join(sorted(axes)) or "none"
        raise UnknownAxis(f"{recording.path} has no axis {axis!r}; it has {known}", axis=axis, value=axis)
    return history
