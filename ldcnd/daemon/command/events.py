"""The latest events of a rig: kept for those who come late, published for those who listen."""

import asyncio
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from ldcnd.daemon.clock import Clock
from ldcnd.daemon.command.ledger import Entry
from ldcnd.daemon.publish.publisher import Publisher
from ldcnd.errors import LdcndError, SessionError
from ldcnd.log import LogLimit, get_logger
from ldcnd.messaging.codec import to_json
from ldcnd.model.events import CommandEvent, CommandStatus, EventList, ReadEvents

log = get_logger("events")

TOLD_AFTER_S = 0.005
"""Longer than a command takes that is one exchange at 115200 baud and waits for another one."""
UNTOLD_EVENTS = 64
"""With so many they are told at once."""
KEPT_EVENTS = 1000
PAGE_BYTES = 12_000
"""Events in one reply: with its other fields it stays below what a payload may have."""


@dataclass(frozen=True, slots=True)
class _News:
    """What has happened and is not told yet."""

    t: int
    seq: int
    number: int
    entry: Entry
    error: LdcndError | None


class EventLog:
    """Numbers, keeps and publishes what happens to commands.

    An event has its numbers and its instant at once. It is told a little later, because to tell it takes as long as all
    else that a command waits for on its way to the line, and nobody who waits for the command waits for that.
    """

    def __init__(self, publisher: Publisher, clock: Clock, run: str) -> None:
        self._run = run
        self._end = 0
        self._publisher = publisher
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._kept: deque[CommandEvent] = deque(maxlen=KEPT_EVENTS)
        self._sequence: dict[str, int] = {}
        self._news: deque[_News] = deque()
        self._refusals_logged = LogLimit(now_s=clock.now_s)

    def changed(self, entry: Entry, error: LdcndError | None) -> None:
        """Take a change of the ledger; what is refused at once was never accepted."""
        if entry.status is CommandStatus.REFUSED and self._news and _is_acceptance(self._news[-1].entry, entry):
            self._news.pop()
            self._end -= 1
            self._sequence[entry.axis] -= 1
        seq = self._sequence.get(entry.axis, 0)
        self._sequence[entry.axis] = seq + 1
        if not self._news:
            self._loop.call_later(TOLD_AFTER_S, self.tell)
        self._news.append(_News(self._clock.now_ns(), seq, self._end, entry, error))
        self._end += 1
        if len(self._news) >= UNTOLD_EVENTS:
            self.tell()

    def tell(self) -> None:
        """Publish and log all that has happened so far."""
        while self._news:
            self._tell(self._news.popleft())

    def _tell(self, news: _News) -> None:
        entry, error = news.entry, news.error
        event = CommandEvent(
            t=news.t,
            seq=news.seq,
            run=self._run,
            number=news.number,
            axis=entry.axis,
            command_id=entry.command_id,
            verb=entry.verb.value,
            client=entry.client,
            login=entry.login,
            status=entry.status,
            reason=entry.reason,
            code=error.code.value if error else None,
        )
        self._deliver(event)

    def note(
        self,
        command_id: str,
        axis: str,
        verb: str,
        status: CommandStatus,
        reason: str,
        *,
        client: str | None = None,
        login: str | None = None,
        code: str | None = None,
    ) -> None:
        """Enter what concerns an axis and is in no ledger: control that was lost or refused, a stop confirmed late."""
        self.tell()
        seq = self._sequence.get(axis, 0)
        self._sequence[axis] = seq + 1
        event = CommandEvent(
            t=self._clock.now_ns(),
            seq=seq,
            run=self._run,
            number=self._end,
            axis=axis,
            command_id=command_id,
            verb=verb,
            client=client,
            login=login,
            status=status,
            reason=reason,
            code=code,
        )
        self._end += 1
        self._deliver(event)

    def _deliver(self, event: CommandEvent) -> None:
        self._kept.append(event)
        try:
            self._publisher.publish_event(event)
        except SessionError as error:  # who asks for events still finds it
            log.warning("event not published", axis=event.axis, command_id=event.command_id, reason=error.message)
        if event.status is CommandStatus.ACCEPTED:
            return  # what became of it follows
        passing = self._refusals_logged.admit() if event.status is CommandStatus.REFUSED else {}
        if passing is None:
            return
        log.info(
            "command",
            **passing,
            axis=event.axis,
            command_id=event.command_id,
            verb=event.verb,
            client=event.client,
            login=event.login,
            status=event.status.value,
            reason=event.reason,
        )

    def page(self, request: ReadEvents) -> EventList:
        """Return the events that were asked for, as many as one reply takes."""
        self.tell()
        oldest = self._end - len(self._kept)
        if request.from_number is None:
            matching = [event for event in self._kept if request.axis in (None, event.axis)]
            events = _fitting(reversed(matching[-request.count :]))[::-1]
            return self._list(events, events[0].number if events else self._end, self._end)
        first = min(max(oldest, request.from_number), self._end)
        wanted = [event for event in list(self._kept)[first - oldest :] if request.axis in (None, event.axis)]
        events = _fitting(wanted[: request.count])
        return self._list(events, first, wanted[len(events)].number if len(events) < len(wanted) else self._end)

    def _list(self, events: list[CommandEvent], first: int, following: int) -> EventList:
        return EventList(
            run=self._run, first_number=first, next_number=following, end_number=self._end, events=tuple(events)
        )


def _is_acceptance(latest: Entry, refused: Entry) -> bool:
    return latest.command_id == refused.command_id and latest.status is CommandStatus.ACCEPTED


def _fitting(events: Iterable[CommandEvent]) -> list[CommandEvent]:
    """Return as many events as one reply takes, one at least."""
    fitting: list[CommandEvent] = []
    room = PAGE_BYTES
    for event in events:
        room -= len(to_json(event)) + 1
        if fitting and room < 0:
            break
        fitting.append(event)
    return fitting
