"""What a daemon remembers, page by page: events without gaps, and the records of a line.

What the network drops of events is fetched from the daemon's memory. An event has a number, so a gap is seen when the
next one comes, and at the latest at the next query of the daemon.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.codec import decode_received
from ldcnd.contract.errors import OutcomeUnknown, SessionError
from ldcnd.contract.events import CommandEvent, EventList, ReadEvents
from ldcnd.contract.keys import EVENT
from ldcnd.contract.rig_commands import ReadWireLog, WireLogReply
from ldcnd.net.session import Publication, SampleKind

CHECK_PERIOD_S = 2.0
"""Period of queries for a missed last event, while none comes, seconds."""
RETRY_S = 0.5
"""Pause before the next query of a daemon out of reach, seconds."""
UNREAD_EVENTS = 1024
"""Maximum number of events kept for a slow reader; further ones are fetched when it gets there."""


class Events:
    """An endless iterator over the events of a rig, in their order, each once; made by `follow_events`.

    Attributes:
        lost: how many events the daemon had discarded before they could be fetched.
        restarts: how often the daemon was restarted meanwhile; the last events of its former run may be missing.
    """

    def __init__(self, client: RigClient, axis: str | None, at: EventList) -> None:
        self.lost = 0
        self.restarts = 0
        self._client = client
        self._axis = axis
        self._run = at.run
        self._next = at.first_number
        self._behind = True  # something may have happened before the subscription reached the daemon
        self._ready: deque[CommandEvent] = deque()
        self._live: deque[CommandEvent] = deque(maxlen=UNREAD_EVENTS)
        self._arrived = asyncio.Event()

    def take(self, event: CommandEvent) -> None:
        """Take an event from the session; an old one gives way to it when the reader is slow, and is fetched later."""
        self._live.append(event)
        self._arrived.set()

    def __aiter__(self) -> "Events":
        return self

    async def __anext__(self) -> CommandEvent:
        """Return the next event, whenever that comes."""
        while True:
            while self._ready:
                event = self._ready.popleft()
                if self._axis in (None, event.axis):
                    return event
            if self._behind:
                await self._fetch()
            elif not self._take_live():
                await self._wait(CHECK_PERIOD_S)
                self._behind = not self._live

    def _take_live(self) -> bool:
        """Move what follows without a gap to the events that are ready; tell whether there was anything to do."""
        self._arrived.clear()
        while self._live and not self._behind:
            event = self._live.popleft()
            if event.run == self._run and event.number < self._next:
                continue
            self._behind = event.run != self._run or event.number > self._next
            if not self._behind:
                self._next += 1
                self._ready.append(event)
        return self._behind or bool(self._ready)

    async def _fetch(self) -> None:
        """Query the next page from where this reader is; retry while there is no answer."""
        while True:
            try:
                page = await self._client.ask(ReadEvents(from_number=self._next))
            except (OutcomeUnknown, SessionError):
                await asyncio.sleep(RETRY_S)
                continue
            if page.run == self._run:
                break
            self._run, self._next = page.run, 0
            self.restarts += 1
        self.lost += page.first_number - self._next
        self._next, self._behind = page.next_number, page.next_number < page.end_number
        self._ready.extend(page.events)

    async def _wait(self, at_most_s: float) -> None:
        """Wait until an event comes, but not for ever: the last of them may be the one that was missed."""
        try:
            async with asyncio.timeout(at_most_s):
                await self._arrived.wait()
        except TimeoutError:
            return


@asynccontextmanager
async def follow_events(client: RigClient, axis: str | None = None, *, history: bool = False) -> AsyncIterator[Events]:
    """Follow what happens to commands for the time of the context: no event is lost silently.

    Args:
        client: the rig.
        axis: only this one.
        history: begin with what the daemon remembers, up to 1000 events, instead of now.

    Raises:
        SessionError: no daemon serves this rig, or this login may not query events.
    """
    request = ReadEvents(from_number=0, count=1) if history else ReadEvents(count=1)
    page = await client.ask(request)
    at = page if history else page.model_copy(update={"first_number": page.end_number})
    events = Events(client, axis, at)

    def take(sample: Publication) -> None:
        if sample.kind is SampleKind.PUT:
            events.take(decode_received(CommandEvent, sample.payload, sample.encoding))

    declaration = await client.subscribe(client.keys.telemetry_pattern("*", EVENT), take)
    try:
        yield events
    finally:
        await declaration.close()


async def latest_events(client: RigClient, count: int, axis: str | None = None) -> list[CommandEvent]:
    """Return the latest events that the daemon remembers, oldest first, however many replies that takes.

    Args:
        client: the rig.
        count: maximum number, 1 to 1000.
        axis: only this one.

    Raises:
        LdcndError: as the daemon refused it, of the same class.
    """
    page = await client.ask(ReadEvents(axis=axis, count=count))
    if len(page.events) >= count or page.first_number == 0:
        return list(page.events)
    run, end, events = page.run, page.end_number, list[CommandEvent]()
    at = 0 if axis else max(0, end - count)
    while at < end:
        page = await client.ask(ReadEvents(axis=axis, count=count, from_number=at))
        if page.run != run:
            break
        events += page.events
        at = page.next_number
    return events[-count:]


async def fetch_wire_log(client: RigClient, bus: str, seconds: float) -> WireLogReply:
    """Fetch the last seconds of a line up to now as one reply; what happens while its pages travel is left out.

    Records that were overwritten meanwhile are missing: then there are fewer lines than numbers.

    Raises:
        LdcndError: as the daemon refused it, of the same class.
    """
    first = page = await client.ask(ReadWireLog(bus=bus, seconds=seconds))
    end, lines = first.end_record, list(first.lines)
    while page.next_record < end:
        page = await client.ask(ReadWireLog(bus=bus, seconds=seconds, from_record=page.next_record))
        lines += page.lines[: max(0, end - page.first_record)]
    return first.model_copy(update={"lines": tuple(lines), "next_record": end})
