"""Samples on their way out: numbers them, keeps the last of each, hands them to the session without waiting."""

from collections.abc import Callable
from dataclasses import dataclass

from ldcnd.messaging.codec import Encoding, encode
from ldcnd.messaging.keys import EVENT, Keys
from ldcnd.messaging.session import Qos, Session
from ldcnd.model.axes import Quality
from ldcnd.model.events import CommandEvent
from ldcnd.model.frozen import Frozen
from ldcnd.model.monitors import MonitorName
from ldcnd.model.samples import Sample, TelemetryItem
from ldcnd.model.traces import TraceChunk, TraceHeader

QOS = {
    TelemetryItem.POSITION: Qos.TELEMETRY,
    TelemetryItem.VELOCITY: Qos.TELEMETRY,
    TelemetryItem.ADC: Qos.TELEMETRY,
    TelemetryItem.FAULT: Qos.EVENT,
    TelemetryItem.STATE: Qos.EVENT,
}


@dataclass(frozen=True, slots=True)
class LastValue:
    """The newest sample of one key, and when it was true."""

    sample: Sample
    measured_at_ns: int


class Publisher:
    """One rig's way out. Publishing never waits: what the network cannot take is dropped there.

    Attributes:
        last: the newest sample of each key.
        published: samples and events handed to the network so far.
    """

    def __init__(self, session: Session, keys: Keys, encoding: Encoding) -> None:
        self.last: dict[str, LastValue] = {}
        self.published = 0
        self._session = session
        self._keys = keys
        self._encoding = encoding
        self._sequence: dict[str, int] = {}
        self._item_keys: dict[tuple[str, TelemetryItem], str] = {}  # spelling a key checks its chunks

    def publish(self, axis: str, item: TelemetryItem, make: Callable[[int], Sample]) -> None:
        """Publish the sample that `make` builds for its sequence number."""
        key = self._item_keys.get((axis, item))
        if key is None:
            key = self._item_keys[axis, item] = self._keys.telemetry(axis, item)
        self._publish(key, make, QOS[item])

    def publish_monitor(self, axis: str, name: MonitorName, make: Callable[[int], Sample]) -> None:
        """Publish one monitor of a drive."""
        self._publish(self._keys.monitor(axis, name), make, Qos.TELEMETRY)

    def _publish(self, key: str, make: Callable[[int], Sample], qos: Qos) -> None:
        seq = self._sequence.get(key, 0)
        self._sequence[key] = seq + 1
        self.published += 1
        sample = make(seq)
        self.last[key] = LastValue(sample, sample.t)
        payload, encoding = encode(sample, self._encoding)
        self._session.publish(key, payload, encoding=encoding, qos=qos, measured_at_ns=sample.t)

    def publish_event(self, event: CommandEvent) -> None:
        """Publish an event; events are history, not values, so no last one is kept here."""
        self.published += 1
        payload, encoding = encode(event, self._encoding)
        self._session.publish(
            self._keys.telemetry(event.axis, EVENT), payload, encoding=encoding, qos=Qos.EVENT, measured_at_ns=event.t
        )

    def publish_report(self, key: str, report: Frozen, t: int) -> None:
        """Publish how something is doing, as of `t`, UTC in ns since 1970."""
        payload, encoding = encode(report, self._encoding)
        self._session.publish(key, payload, encoding=encoding, qos=Qos.TELEMETRY, measured_at_ns=t)

    def withdraw_report(self, key: str) -> None:
        """Take a report off the network."""
        self._session.delete(key)

    def publish_trace(self, axis: str, header: TraceHeader) -> None:
        """Publish how far a trace is."""
        self._publish(self._keys.trace(axis), lambda seq: header.model_copy(update={"seq": seq}), Qos.BULK)

    def publish_trace_chunk(self, axis: str, index: int, chunk: TraceChunk) -> None:
        """Publish samples of the last trace."""
        key = self._keys.trace_chunk(axis, index)
        self._publish(key, lambda seq: chunk.model_copy(update={"seq": seq}), Qos.BULK)

    def withdraw_trace_chunks(self, axis: str) -> None:
        """Take the samples of the last trace off the network."""
        below = f"{self._keys.trace(axis)}/"
        for key in [key for key in self.last if key.startswith(below)]:
            del self.last[key]
            self._session.delete(key)

    def publish_stale(self, axis: str, item: TelemetryItem, quality: Quality) -> None:
        """Publish the last sample again with what it is worth now; it keeps the instant at which it was true."""
        last = self.last.get(self._keys.telemetry(axis, item))
        if last and last.sample.quality is not quality:
            self.publish(axis, item, lambda seq: last.sample.model_copy(update={"seq": seq, "quality": quality}))

    def withdraw(self, axis: str) -> None:
        """Take an axis off the network: its last values must not look alive."""
        keys = [self._keys.telemetry(axis, item) for item in TelemetryItem]
        keys += [self._keys.monitor(axis, name) for name in MonitorName]
        keys.append(self._keys.trace(axis))
        self.withdraw_trace_chunks(axis)
        for key in keys:
            if self.last.pop(key, None):
                self._session.delete(key)
