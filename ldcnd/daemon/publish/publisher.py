"""Samples on their way out: numbers them, keeps the last of each, hands them to the session without waiting."""

from ldcnd.messaging.codec import Encoder, Encoding
from ldcnd.messaging.keys import EVENT, Keys
from ldcnd.messaging.session import Qos, Session
from ldcnd.model.events import CommandEvent
from ldcnd.model.frozen import Frozen
from ldcnd.model.samples import MonitorName, Quality, Sample, TelemetryItem
from ldcnd.model.traces import TraceChunk, TraceHeader

QOS = {
    TelemetryItem.POSITION: Qos.TELEMETRY,
    TelemetryItem.VELOCITY: Qos.TELEMETRY,
    TelemetryItem.ADC: Qos.TELEMETRY,
    TelemetryItem.INPUTS: Qos.EVENT,
    TelemetryItem.LATCH: Qos.EVENT,
    TelemetryItem.IO: Qos.TELEMETRY,
    TelemetryItem.FAULT: Qos.EVENT,
    TelemetryItem.STATE: Qos.EVENT,
}


class Topic:
    """One key's samples on their way out; made by `Publisher`.

    Attributes:
        seq: number of the next sample.
    """

    __slots__ = ("_key", "_publisher", "_qos", "seq")

    def __init__(self, publisher: "Publisher", key: str, qos: Qos) -> None:
        self.seq = 0
        self._publisher = publisher
        self._key = key
        self._qos = qos

    def publish(self, sample: Sample) -> None:
        """Publish a sample that has the number `seq`, and keep it as the last one of its key."""
        self.seq += 1
        key, publisher = self._key, self._publisher
        publisher.published += 1
        publisher.last[key] = sample
        payload, encoding = publisher.encoder.encode(sample)
        publisher.session.publish(key, payload, encoding=encoding, qos=self._qos, measured_at_ns=sample.t)

    def publish_again(self, quality: Quality) -> None:
        """Publish the last sample with what it is worth now; it keeps the instant at which it was true."""
        last = self._publisher.last.get(self._key)
        if last and last.quality is not quality:
            self.publish(last.model_copy(update={"seq": self.seq, "quality": quality}))


class Publisher:
    """One rig's way out. Publishing never waits: what the network cannot take is dropped there.

    Attributes:
        last: the newest sample of each key.
        published: samples and events handed to the network so far.
        session: the network.
        encoder: how payloads are encoded.
    """

    def __init__(self, session: Session, keys: Keys, encoding: Encoding) -> None:
        self.last: dict[str, Sample] = {}
        self.published = 0
        self.session = session
        self.encoder = Encoder(encoding)
        self._keys = keys
        self._topics: dict[str, Topic] = {}

    def item(self, axis: str, item: TelemetryItem) -> Topic:
        """Return the topic of one item of an axis."""
        return self._topic(self._keys.telemetry(axis, item), QOS[item])

    def monitor(self, axis: str, name: MonitorName) -> Topic:
        """Return the topic of one monitor of a drive."""
        return self._topic(self._keys.monitor(axis, name), Qos.TELEMETRY)

    def publish_event(self, event: CommandEvent) -> None:
        """Publish an event; events are history, not values, so no last one is kept here."""
        self.published += 1
        payload, encoding = self.encoder.encode(event)
        self.session.publish(
            self._keys.telemetry(event.axis, EVENT), payload, encoding=encoding, qos=Qos.EVENT, measured_at_ns=event.t
        )

    def publish_report(self, key: str, report: Frozen, t: int) -> None:
        """Publish how something is doing, as of `t`, UTC in ns since 1970."""
        payload, encoding = self.encoder.encode(report)
        self.session.publish(key, payload, encoding=encoding, qos=Qos.TELEMETRY, measured_at_ns=t)

    def withdraw_report(self, key: str) -> None:
        """Take a report off the network."""
        self.session.delete(key)

    def publish_trace(self, axis: str, header: TraceHeader) -> None:
        """Publish how far a trace is."""
        topic = self._topic(self._keys.trace(axis), Qos.BULK)
        topic.publish(header.model_copy(update={"seq": topic.seq}))

    def publish_trace_chunk(self, axis: str, index: int, chunk: TraceChunk) -> None:
        """Publish samples of the last trace."""
        topic = self._topic(self._keys.trace_chunk(axis, index), Qos.BULK)
        topic.publish(chunk.model_copy(update={"seq": topic.seq}))

    def withdraw_trace_chunks(self, axis: str) -> None:
        """Take the samples of the last trace off the network."""
        below = f"{self._keys.trace(axis)}/"
        for key in [key for key in self.last if key.startswith(below)]:
            del self.last[key]
            self.session.delete(key)

    def withdraw(self, axis: str) -> None:
        """Take an axis off the network: its last values must not look alive."""
        keys = [self._keys.telemetry(axis, item) for item in TelemetryItem]
        keys += [self._keys.monitor(axis, name) for name in MonitorName]
        keys.append(self._keys.trace(axis))
        self.withdraw_trace_chunks(axis)
        for key in keys:
            if self.last.pop(key, None):
                self.session.delete(key)

    def _topic(self, key: str, qos: Qos) -> Topic:
        topic = self._topics.get(key)
        if topic is None:
            topic = self._topics[key] = Topic(self, key, qos)
        return topic
