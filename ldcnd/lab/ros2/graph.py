"""A node and its publishers as rmw_zenoh shows them: key expressions, liveliness tokens, attachments.

After the design document of rmw_zenoh for ROS 2 Jazzy and later. Not tested against rmw_zenoh itself.
"""

import struct
from dataclasses import dataclass
from itertools import count

from ldcnd.client.network import Declaration, Qos, Session
from ldcnd.lab.ros2.cdr import MessageType

DEPTH = 10
"""Of a publisher's history, as its token says; values are not kept."""
QOS = f"::,{DEPTH}:,:,:,,"
"""Reliable, volatile, the last ones kept, no deadline, no lifespan: what is default is left out."""
GID_BYTES = 16


@dataclass(frozen=True, slots=True)
class RosNode:
    """A node.

    Attributes:
        domain: the ROS domain, 0 to 232.
        name: of the node.
        session_id: names its session, in hexadecimal.
        namespace: of the node and its topics, such as `/lab`; the root otherwise.
    """

    domain: int
    name: str
    session_id: str
    namespace: str = "/"

    @property
    def token(self) -> str:
        """The key of its liveliness token."""
        return f"@ros2_lv/{self.domain}/{self.session_id}/0/0/NN/%/{_mangled(self.namespace)}/{self.name}"

    def topic(self, name: str) -> str:
        """Return the whole name of a topic in the node's namespace."""
        return f"{self.namespace.rstrip('/')}/{name}"

    def publisher_token(self, entity: int, topic: str, message: MessageType) -> str:
        """Return the key of the liveliness token of one of its publishers, such as of `/joint_states`."""
        return (
            f"@ros2_lv/{self.domain}/{self.session_id}/0/{entity}/MP/%/{_mangled(self.namespace)}/{self.name}"
            f"/{_mangled(topic)}/{message.name}/{message.type_hash}/{QOS}"
        )

    def topic_key(self, topic: str, message: MessageType) -> str:
        """Return the key on which a topic is published."""
        return f"{self.domain}/{topic.strip('/')}/{message.name}/{message.type_hash}"


class RosPublisher:
    """A publisher of one topic; made by `advertise`."""

    def __init__(self, session: Session, key: str, gid: bytes) -> None:
        self._session = session
        self._key = key
        self._gid = gid
        self._numbers = count(1)

    def publish(self, payload: bytes, t: int) -> None:
        """Publish a message.

        Args:
            payload: in CDR.
            t: when it was made, UTC in ns since 1970.
        """
        attachment = attachment_of(next(self._numbers), t, self._gid)
        self._session.publish(self._key, payload, encoding="", qos=Qos.TELEMETRY, attachment=attachment)


async def advertise(
    session: Session, node: RosNode, entity: int, topic: str, message: MessageType
) -> tuple[RosPublisher, Declaration]:
    """Show a publisher in the graph; it vanishes with the declaration or the session.

    Args:
        session: with the router of the ROS graph.
        node: whose publisher.
        entity: its number within the node, from 1.
        topic: such as `/joint_states`.
        message: what it publishes.
    """
    token = await session.declare_token(node.publisher_token(entity, topic, message))
    gid = bytes.fromhex(node.session_id).rjust(GID_BYTES, b"\0")[: GID_BYTES - 1] + bytes([entity])
    return RosPublisher(session, node.topic_key(topic, message), gid), token


def attachment_of(number: int, t: int, gid: bytes) -> bytes:
    """Return what accompanies a message: its number, its time, and who has sent it, in Zenoh's own serialisation."""
    return b"".join(
        (
            _text("sequence_number"),
            struct.pack("<q", number),
            _text("source_timestamp"),
            struct.pack("<q", t),
            _text("source_gid"),
            bytes([len(gid)]),
            gid,
        )
    )


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _text(text: str) -> bytes:
    """Return a short text behind its length."""
    return bytes([len(text)]) + text.encode()
