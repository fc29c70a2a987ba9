"""Published values for stock viewers: events become log messages, everything else stays as it is.

Source: Foxglove's message schemas, `foxglove.Log`; a viewer finds it by its name and shows the fields that it supports.
"""

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from enum import IntEnum
from functools import cache, lru_cache
from types import MappingProxyType
from typing import NamedTuple

from pydantic import Field

from ldcnd.client.network import Publication
from ldcnd.contract.codec import decode_received, read_received, to_json
from ldcnd.contract.events import CommandEvent, CommandStatus
from ldcnd.contract.frozen import Frozen, schema_text
from ldcnd.contract.health import BusHealth, DaemonHealth
from ldcnd.contract.keys import ROOT
from ldcnd.contract.samples import SAMPLE_MODELS, MonitorSample
from ldcnd.contract.samples import Sample as Measurement
from ldcnd.contract.traces import TraceChunk, TraceHeader

Published = Measurement | CommandEvent | BusHealth | DaemonHealth

_ITEMS = {item.value: model for item, model in SAMPLE_MODELS.items()}


@lru_cache(maxsize=4096)
def model_of(key: str) -> type[Published] | None:
    """Return the content type of a key, or None for one that only a newer daemon has."""
    _, _, kind, *rest = key.split("/")
    match kind, rest:
        case "tele", [_, "event"]:
            return CommandEvent
        case "tele", [_, "trace"]:
            return TraceHeader
        case "tele", [_, item]:
            return _ITEMS.get(item)
        case "tele", [_, "monitor", _]:
            return MonitorSample
        case "tele", [_, "trace", _]:
            return TraceChunk
        case "meta", ["health"]:
            return DaemonHealth
        case "meta", ["health", _]:
            return BusHealth
    return None


@lru_cache(maxsize=4096)
def _expected(key: str) -> tuple[type[Published] | None, AbstractSet[str]]:
    """Return the content type of a key, and the names of its fields."""
    model = model_of(key)
    return model, frozenset(model.model_fields if model else ())


def axis_of(key: str) -> str | None:
    """Return whose telemetry a key carries, or None for what belongs to no axis."""
    match key.split("/"):
        case [root, _, "tele", axis, *_] if root == ROOT:
            return axis
    return None


def decode_published(sample: Publication) -> Published | None:
    """Return the value that was published, or None when its key is not known.

    Raises:
        LdcndError: the payload is not what the key carries.
    """
    model = model_of(sample.key)
    return decode_received(model, sample.payload, sample.encoding) if model else None


NS_PER_S = 10**9
LOG_SCHEMA = "foxglove.Log"


class LogLevel(IntEnum):
    """How much a log message matters."""

    INFO = 2
    WARNING = 3
    ERROR = 4


LEVELS: Mapping[CommandStatus, LogLevel] = MappingProxyType(
    {
        CommandStatus.ABORTED: LogLevel.WARNING,
        CommandStatus.REFUSED: LogLevel.WARNING,
        CommandStatus.FAILED: LogLevel.ERROR,
        CommandStatus.UNKNOWN: LogLevel.ERROR,
    }
)
"""All other statuses went as requested."""


class Timestamp(Frozen):
    """A point in time, UTC since 1970."""

    sec: int = Field(ge=0)
    """Whole seconds."""
    nsec: int = Field(ge=0, lt=NS_PER_S)
    """Nanoseconds of the second."""


class LogMessage(Frozen):
    """An event as a log message: what viewers show, and the event itself, whole."""

    timestamp: Timestamp
    """When it happened."""
    level: LogLevel
    """2 for what went as requested, 3 for what was refused or ended early, 4 for failures."""
    message: str
    """The event in one sentence."""
    name: str
    """The axis."""
    file: str = ""
    """Nothing: events have no place in a program."""
    line: int = Field(default=0, ge=0)
    """Nothing, likewise."""
    event: CommandEvent
    """The event as it was published."""


class RecordedValue(NamedTuple):
    """A value as a recording holds it.

    Attributes:
        message: whose schema it has.
        data: in JSON.
        t: when it was true, UTC in ns since 1970.
        seq: its number among those of its key.
    """

    message: type[Frozen]
    data: bytes
    t: int
    seq: int


def entry_of(sample: Publication) -> RecordedValue | None:
    """Return what is recorded of a sample, or None when its key is not known.

    What has exactly the fields that its key carries is recorded as it is: building its model would cost more than all
    the rest. Who reads the recording validates it.

    Raises:
        LdcndError: the payload is not what the key carries.
    """
    model, fields = _expected(sample.key)
    if model is None:
        return None
    if model is not CommandEvent:
        value, text = read_received(sample.payload, sample.encoding)
        if isinstance(value, dict) and value.keys() == fields:
            t, seq = value["t"], value["seq"]
            if type(t) is int and type(seq) is int:
                return RecordedValue(model, text, t, seq)
    published = decode_received(model, sample.payload, sample.encoding)
    message = message_of(published)
    return RecordedValue(type(message), to_json(message), published.t, published.seq)


def message_of(value: Published) -> Frozen:
    """Return what stands for a value in a recording."""
    return _log_message(value) if isinstance(value, CommandEvent) else value


@cache
def schema_of(message: type[Frozen]) -> tuple[str, str]:
    """Return name and text of the schema of a message."""
    return LOG_SCHEMA if message is LogMessage else f"ldcnd.{message.__name__}", schema_text(message)


def _log_message(event: CommandEvent) -> LogMessage:
    sec, nsec = divmod(event.t, NS_PER_S)
    who = event.client or "somebody"
    why = f": {event.reason}" if event.reason else ""
    code = f" [{event.code}]" if event.code else ""
    return LogMessage(
        timestamp=Timestamp(sec=sec, nsec=nsec),
        level=LEVELS.get(event.status, LogLevel.INFO),
        message=f"{event.axis}: {event.verb} {event.status} by {who} ({event.command_id}){why}{code}",
        name=event.axis,
        event=event,
    )
