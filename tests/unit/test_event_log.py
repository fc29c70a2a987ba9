"""Events have their numbers at once and are told together, a moment later."""

import asyncio
from unittest.mock import Mock

from structlog.testing import capture_logs

from ldcnd.axis.clock import Clock
from ldcnd.contract.codec import to_json
from ldcnd.contract.commands import Power
from ldcnd.contract.errors import BusDown, SessionError
from ldcnd.contract.events import CommandStatus, ReadEvents
from ldcnd.daemon.ledger import PAGE_BYTES, PUBLISHED_AFTER_S, UNPUBLISHED_EVENTS, EventLog, LedgerEntry
from ldcnd.net.publisher import Publisher


class Told:
    """An event log that happens at 1 s and counts up by 1 ns, and what it has published."""

    def __init__(self) -> None:
        self.publisher = Mock(spec=Publisher)
        ticks = iter(range(10**9, 2 * 10**9))
        self.log = EventLog(self.publisher, Clock(lambda: next(ticks)), "run-1")

    def happens(
        self, status: CommandStatus = CommandStatus.ACCEPTED, error: BusDown | None = None, client: str | None = None
    ) -> None:
        entry = LedgerEntry("c1", "x", Power(on=False), client=client, status=status)
        self.log.changed(entry, error)

    def published(self) -> list[tuple[int, int, int, str, str | None]]:
        events = [call.args[0] for call in self.publisher.publish_event.call_args_list]
        return [(event.t, event.seq, event.number, event.status.value, event.code) for event in events]


async def test_a_command_is_logged_once_with_what_became_of_it():
    told = Told()
    with capture_logs() as records:
        told.happens()
        told.happens(CommandStatus.DONE)
        await asyncio.sleep(2 * PUBLISHED_AFTER_S)

    assert [(record["event"], record["status"]) for record in records] == [("command", "done")]


async def test_events_are_told_together_with_the_instants_at_which_they_happened():
    told = Told()
    told.happens()
    await asyncio.sleep(PUBLISHED_AFTER_S / 2)
    told.happens(CommandStatus.FAILED, BusDown("no line"))
    assert told.published() == []

    await asyncio.sleep(PUBLISHED_AFTER_S)

    assert told.published() == [(10**9, 0, 0, "accepted", None), (10**9 + 1, 1, 1, "failed", "bus_down")]


async def test_who_asks_is_told_at_once_and_nobody_twice():
    told = Told()
    told.happens()

    page = told.log.page(ReadEvents())
    await asyncio.sleep(2 * PUBLISHED_AFTER_S)

    assert [event.number for event in page.events] == [0]
    assert len(told.published()) == 1


async def test_a_flood_is_not_kept():
    told = Told()
    for _ in range(UNPUBLISHED_EVENTS):
        told.happens()

    assert [number for _, _, number, _, _ in told.published()] == list(range(UNPUBLISHED_EVENTS))


async def test_at_the_end_all_is_told():
    told = Told()
    told.happens()
    told.log.flush()

    assert len(told.published()) == 1


async def test_what_the_network_does_not_take_keeps_nothing_else_back():
    told = Told()
    told.publisher.publish_event.side_effect = [SessionError("closed"), None]
    told.happens()
    told.happens(CommandStatus.DONE)

    await asyncio.sleep(2 * PUBLISHED_AFTER_S)

    assert len(told.published()) == 2
    assert [event.number for event in told.log.page(ReadEvents()).events] == [0, 1]


async def test_a_page_of_events_fits_in_bytes_whatever_their_clients_are_called():
    told = Told()
    for _ in range(200):
        told.happens(client="ü" * 64)

    page = told.log.page(ReadEvents(count=200))

    assert 10 < len(page.events) < 200
    assert sum(len(to_json(event)) + 1 for event in page.events) <= PAGE_BYTES
