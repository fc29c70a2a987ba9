"""Samples on their way out: numbers them, keeps the last of each, hands them to the session without waiting."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from typing_extensions import override

from ldcnd.contract.codec import Encoding, encode, encoding_name, packer
from ldcnd.contract.errors import SessionError
from ldcnd.contract.events import CommandEvent
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import EVENT, Keys
from ldcnd.contract.samples import SAMPLE_MODELS, MonitorName, MonitorSample, Quality, Sample, TelemetryItem
from ldcnd.contract.traces import TraceChunk, TraceHeader
from ldcnd.log import LogLimit, get_logger
from ldcnd.net.session import PublishValue, Qos, Session

log = get_logger("publisher")

EVENTS = frozenset({TelemetryItem.INPUTS, TelemetryItem.LATCH, TelemetryItem.FAULT, TelemetryItem.STATE})
"""Items that are published when they change: none may be lost on the way. The others come again soon."""


Pack = Callable[[Mapping[str, object]], bytes]
Values = dict[str, Any]  # of any type: they are what the fields of some model hold
"""The fields of a sample by name, in the order of its model; they are checked where they come off the wire."""


class Topic:
    """One key's samples on their way out; made by `Publisher`.

    Attributes:
        seq: number of the next sample.
        values: what was published last; None before.
    """

    __slots__ = ("_lost", "_model", "_pack", "_sample", "_sampled", "_send", "seq", "values")

    def __init__(
        self, model: type[Sample], pack: Pack, send: PublishValue, lost: Callable[[SessionError], None]
    ) -> None:
        self.seq = 0
        self.values: Values | None = None
        self._sample: Sample | None = None
        self._sampled: Values | None = None  # what that was built from
        self._model = model
        self._pack = pack
        self._send = send
        self._lost = lost

    def publish(self, values: Values) -> None:
        """Publish a sample: all its fields in the order of its model; its number, `seq`, is filled in.

        No model is built: five samples of each poll pass here. One that cannot be sent is lost, as on the network: the
        next number shows it.
        """
        values["seq"] = seq = self.seq
        self.seq = seq + 1
        self.values = values
        payload = self._pack(values)
        try:
            self._send(payload, values["t"])
        except SessionError as error:
            self._lost(error)

    def publish_sample(self, sample: Sample) -> None:
        """Publish a sample, with the next number."""
        self.publish(dict(vars(sample)))

    def publish_again(self, quality: Quality) -> None:
        """Publish the last sample with the quality of now; it keeps the instant at which it was true."""
        last = self.sample
        if last and last.quality is not quality:
            self.publish_sample(last.model_copy(update={"quality": quality}))

    def forget(self) -> bool:
        """Keep no last sample any more; return whether there was one."""
        had, self.values = self.values is not None, None
        return had

    @property
    def at_ns(self) -> int | None:
        """When the last sample was true, UTC in ns since 1970; None without one."""
        return self.values["t"] if self.values else None

    @property
    def sample(self) -> Sample | None:
        """The last sample; built on first use."""
        values = self.values
        if values is not self._sampled:
            self._sample = None if values is None else self._model.model_construct(set(values), **values)
            self._sampled = values
        return self._sample


class LastSamples(Mapping[str, Sample]):
    """The newest sample of each key."""

    def __init__(self, topics: Mapping[str, Topic]) -> None:
        self._topics = topics

    @override
    def __getitem__(self, key: str) -> Sample:
        sample = self._topics[key].sample
        if sample is None:
            raise KeyError(key)
        return sample

    @override
    def __iter__(self) -> Iterator[str]:
        return (key for key, topic in self._topics.items() if topic.values is not None)

    @override
    def __len__(self) -> int:
        return sum(topic.values is not None for topic in self._topics.values())


class Publisher:
    """One rig's way out. Publishing never waits: what the network cannot take is dropped.

    Attributes:
        last: the newest sample of each key.
        session: the network.
        encoding: of payloads.
    """

    def __init__(self, session: Session, keys: Keys, encoding: Encoding) -> None:
        self.session = session
        self.encoding = encoding
        self._events = 0
        self._pack = packer(encoding)
        self._keys = keys
        self._topics: dict[str, Topic] = {}
        self._losses_logged = LogLimit(count=1)
        self.last = LastSamples(self._topics)

    @property
    def published(self) -> int:
        """Samples and events handed to the network since the start."""
        return self._events + sum(topic.seq for topic in self._topics.values())

    def item(self, axis: str, item: TelemetryItem) -> Topic:
        """Return the topic of one item of an axis."""
        qos = Qos.EVENT if item in EVENTS else Qos.TELEMETRY
        return self._topic(self._keys.telemetry(axis, item), SAMPLE_MODELS[item], qos)

    def monitor(self, axis: str, name: MonitorName) -> Topic:
        """Return the topic of one monitor of a drive."""
        return self._topic(self._keys.monitor(axis, name), MonitorSample, Qos.TELEMETRY)

    def publish_event(self, event: CommandEvent) -> None:
        """Publish an event; events are history, not values, so no last one is kept here."""
        self._events += 1
        payload, encoding = encode(event, self.encoding)
        self.session.publish(
            self._keys.telemetry(event.axis, EVENT), payload, encoding=encoding, qos=Qos.EVENT, measured_at_ns=event.t
        )

    def publish_report(self, key: str, report: Frozen, t: int) -> None:
        """Publish how something is doing, as of `t`, UTC in ns since 1970; one may be lost, as a sample."""
        payload, encoding = encode(report, self.encoding)
        try:
            self.session.publish(key, payload, encoding=encoding, qos=Qos.TELEMETRY, measured_at_ns=t)
        except SessionError as error:
            self._lost(error)

    def withdraw_report(self, key: str) -> None:
        """Take a report off the network."""
        self.session.delete(key)

    def publish_trace(self, axis: str, header: TraceHeader) -> None:
        """Publish how far a trace is."""
        self._topic(self._keys.trace(axis), TraceHeader, Qos.BULK).publish_sample(header)

    def publish_trace_chunk(self, axis: str, index: int, chunk: TraceChunk) -> None:
        """Publish samples of the last trace."""
        self._topic(self._keys.trace_chunk(axis, index), TraceChunk, Qos.BULK).publish_sample(chunk)

    def withdraw_trace_chunks(self, axis: str) -> None:
        """Take the samples of the last trace off the network."""
        below = f"{self._keys.trace(axis)}/"
        for key, topic in self._topics.items():
            if key.startswith(below) and topic.forget():
                self.session.delete(key)

    def withdraw(self, axis: str) -> None:
        """Take an axis off the network: its last values must not appear current."""
        keys = [self._keys.telemetry(axis, item) for item in TelemetryItem]
        keys += [self._keys.monitor(axis, name) for name in MonitorName]
        keys.append(self._keys.trace(axis))
        self.withdraw_trace_chunks(axis)
        for key in keys:
            if (topic := self._topics.get(key)) and topic.forget():
                self.session.delete(key)

    def _topic(self, key: str, model: type[Sample], qos: Qos) -> Topic:
        topic = self._topics.get(key)
        if topic is None:
            send = self.session.publisher(key, encoding=encoding_name(model, self.encoding), qos=qos)
            topic = self._topics[key] = Topic(model, self._pack, send, self._lost)
        return topic

    def _lost(self, error: SessionError) -> None:
        """Say that a value did not reach the network: nothing moves by it, or stops for it."""
        if (fields := self._losses_logged.admit()) is not None:
            log.warning("not published", reason=error.message, **fields)
