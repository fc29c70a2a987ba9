"""Which model travels on which telemetry key."""

from ldcnd.messaging.codec import decode_received
from ldcnd.messaging.keys import ROOT
from ldcnd.messaging.session import Sample
from ldcnd.model.events import CommandEvent
from ldcnd.model.health import BusHealth, DaemonHealth
from ldcnd.model.samples import SAMPLE_MODELS, MonitorSample
from ldcnd.model.samples import Sample as Measurement
from ldcnd.model.traces import TraceChunk, TraceHeader

Published = Measurement | CommandEvent | BusHealth | DaemonHealth

_ITEMS = {item.value: model for item, model in SAMPLE_MODELS.items()}


def model_of(key: str) -> type[Published] | None:
    """Return what a key carries, or None for one that only a newer daemon knows."""
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


def axis_of(key: str) -> str | None:
    """Return whose telemetry a key carries, or None for what belongs to no axis."""
    match key.split("/"):
        case [root, _, "tele", axis, *_] if root == ROOT:
            return axis
    return None


def decode_published(sample: Sample) -> Published | None:
    """Return the value that was published, or None when its key is not known.

    Raises:
        LdcndError: the payload is not what the key carries.
    """
    model = model_of(sample.key)
    return decode_received(model, sample.payload, sample.encoding) if model else None
