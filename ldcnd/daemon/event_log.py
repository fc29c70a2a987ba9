"""The latest events of a rig: kept for those who come late, published for those who listen."""

from collections import deque

from ldcnd.daemon.clock import Clock
from ldcnd.daemon.ledger import Entry
from ldcnd.daemon.publishing import Publisher
from ldcnd.errors import LdcndError
from ldcnd.log import get_logger
from ldcnd.model.events import CommandEvent

log = get_logger("events")

KEPT_EVENTS = 1000


class EventLog:
    """Numbers, keeps and publishes what happens to commands."""

    def __init__(self, publisher: Publisher, clock: Clock) -> None:
        self._publisher = publisher
        self._clock = clock
        self._kept: deque[CommandEvent] = deque(maxlen=KEPT_EVENTS)
        self._sequence: dict[str, int] = {}

    def changed(self, entry: Entry, error: LdcndError | None) -> None:
        """Take a change of the ledger."""
        seq = self._sequence.get(entry.axis, 0)
        self._sequence[entry.axis] = seq + 1
        event = CommandEvent(
            t=self._clock.now_ns(),
            seq=seq,
            axis=entry.axis,
            command_id=entry.command_id,
            verb=entry.verb.value,
            client=entry.client,
            status=entry.status,
            reason=entry.reason,
            code=error.code.value if error else None,
        )
        self._kept.append(event)
        self._publisher.publish_event(event)
        log.info(
            "command",
            axis=entry.axis,
            command_id=entry.command_id,
            verb=entry.verb.value,
            client=entry.client,
            status=entry.status.value,
            reason=entry.reason,
        )

    def latest(self, count: int, axis: str | None) -> tuple[CommandEvent, ...]:
        """Return the latest events, oldest first."""
        wanted = [event for event in self._kept if axis is None or event.axis == axis]
        return tuple(wanted[-count:])
