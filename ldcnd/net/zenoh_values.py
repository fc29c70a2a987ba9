"""Messages in Zenoh's terms and in ours: quality of service, instants, samples and answers."""

from collections.abc import Mapping, Sequence
from typing import TypedDict

import zenoh

from ldcnd.net.hand_over import Answer
from ldcnd.net.session import Publication, Qos, SampleKind
from ldcnd.net.zenoh_failures import no_answer


class ZenohQos(TypedDict):
    """Zenoh's quality of service for a message."""

    congestion_control: zenoh.CongestionControl
    priority: zenoh.Priority
    express: bool


# with BLOCK the node "will wait for queue to progress" (zenoh, `CongestionControl`), and the bus loop with it
_DROP = zenoh.CongestionControl.DROP
TRAVEL: Mapping[Qos, ZenohQos] = {
    Qos.TELEMETRY: {"congestion_control": _DROP, "priority": zenoh.Priority.DATA, "express": False},
    # not express: each sample would take a batch for itself, and of a burst all but two would be dropped
    Qos.EVENT: {"congestion_control": _DROP, "priority": zenoh.Priority.INTERACTIVE_HIGH, "express": False},
    Qos.BULK: {"congestion_control": _DROP, "priority": zenoh.Priority.BACKGROUND, "express": False},
}


LATEST_STAMP_NS = 2**32 * 10**9 - 1
"""The last instant that Zenoh can stamp: 32 bits of seconds since 1970 end in 2106."""
_PUT, _PUT_OF_OURS = zenoh.SampleKind.PUT, SampleKind.PUT
"""Looked up once: a recorder takes 50,000 samples a second."""


def to_sample(sample: zenoh.Sample) -> Publication:
    """Return a sample as the session's users expect it."""
    key, payload, at_ns = str(sample.key_expr), sample.payload.to_bytes(), _stamped_ns(sample.timestamp)
    # not the id in the time stamp: who passes on a sample without one puts in its own
    info = sample.source_info
    source = "" if info is None else str(info.source_id.zid)
    if sample.kind == _PUT:
        return Publication(key, payload, str(sample.encoding), _PUT_OF_OURS, at_ns, source)
    return Publication(key, payload, "", SampleKind.DELETE, at_ns, source)


def to_answers(key: str, replies: Sequence[zenoh.Reply], timeout_s: float) -> list[Answer]:
    """Return the answers to a query.

    Raises:
        OutcomeUnknown: the only one is Zenoh's own, that the time is over.
    """
    answers: list[Answer] = []
    for reply in replies:
        source = "" if reply.replier_id is None else str(reply.replier_id.zid)
        if (sample := reply.ok) is not None:
            stamp = _stamped_ns(sample.timestamp)
            payload, encoding = sample.payload.to_bytes(), str(sample.encoding)
            answers.append(Answer(str(sample.key_expr), payload, encoding, stamp, source=source))
        elif (error := reply.err) is not None:
            payload, encoding = error.payload.to_bytes(), str(error.encoding)
            answers.append(Answer(key, payload, encoding, is_error=True, source=source))
    # Zenoh itself says so, in the place of a queryable that did not answer
    arrived = [answer for answer in answers if not (answer.is_error and answer.payload == b"Timeout")]
    if len(arrived) < len(answers) and not arrived:
        raise no_answer(key, timeout_s)
    return arrived


def to_stamp(at_ns: int | None, stamp_id: zenoh.TimestampId) -> zenoh.Timestamp | None:
    """Return Zenoh's timestamp of an instant; exact, its resolution is a quarter of a nanosecond.

    One that Zenoh cannot hold has none: a client may name any, and beyond its range `NTP64` panics.
    """
    if at_ns is None or not 0 <= at_ns <= LATEST_STAMP_NS:
        return None
    return zenoh.Timestamp(zenoh.NTP64(*divmod(at_ns, 10**9)), stamp_id)


class Stamps:
    """Makes timestamps for one thread; several samples of one instant, as a poll brings them, share one.

    Attributes:
        stamp_id: of the session.
        at_ns: instant of the latest one.
        latest: the latest one.
    """

    def __init__(self, stamp_id: zenoh.TimestampId) -> None:
        self.stamp_id = stamp_id
        self.at_ns: int | None = None
        self.latest: zenoh.Timestamp | None = None

    def of(self, at_ns: int | None) -> zenoh.Timestamp | None:
        """See `to_stamp`."""
        if at_ns != self.at_ns:
            self.at_ns, self.latest = at_ns, to_stamp(at_ns, self.stamp_id)
        return self.latest


def _stamped_ns(timestamp: zenoh.Timestamp | None) -> int | None:
    return None if timestamp is None else timestamp.get_time_as_ntp64().as_nanos()
