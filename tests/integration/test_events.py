"""Events reach who comes late and who was cut off: all of them, in order, each once, or their loss is told."""

import asyncio

import pytest

from ldcnd.client.events import follow_events, latest_events
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.codec import MAX_PAYLOAD_BYTES
from ldcnd.contract.commands import Halt, Power
from ldcnd.contract.events import CommandStatus, ReadEvents
from ldcnd.contract.samples import LinkState
from ldcnd.daemon.ledger import KEPT_EVENTS
from tests.support.rig import RunningRig, running_rig


async def commands(rig: RunningRig, count: int, axis: str = "x", first: int = 0) -> list[str]:
    """Have so many commands carried out; return their ids."""
    await rig.until(axis, lambda state: state.link is LinkState.UP)
    ids = [f"c{number}" for number in range(first, first + count)]
    for command_id in ids:
        await rig.client.command(axis, Power(on=False, command_id=command_id))
    return ids


async def taken(events, count: int) -> list[str]:
    async with asyncio.timeout(60):
        found = [await anext(events) for _ in range(2 * count)]
    assert [event.status for event in found] == [CommandStatus.ACCEPTED, CommandStatus.DONE] * count
    return [event.command_id for event in found[::2]]


async def test_events_come_as_they_happen():
    async with running_rig() as rig, follow_events(rig.client) as events:
        ids = await commands(rig, 5)

        assert await taken(events, 5) == ids
        assert (events.lost, events.restarts) == (0, 0)


async def test_who_comes_late_is_told_what_has_happened():
    async with running_rig() as rig:
        ids = await commands(rig, 60)
        async with follow_events(rig.client, history=True) as events:
            assert await taken(events, 60) == ids
        async with follow_events(rig.client) as events:
            later = await commands(rig, 1, first=60)
            assert await taken(events, 1) == later


async def test_what_the_network_drops_is_fetched():
    async with running_rig() as rig, follow_events(rig.client) as events:
        first = await commands(rig, 2)
        assert await taken(events, 2) == first

        subscription = rig.broker.subscriptions.pop()  # a network that is cut without anybody being told
        missed = await commands(rig, 3, first=2)
        rig.broker.subscriptions.append(subscription)
        last = await commands(rig, 1, first=5)

        assert await taken(events, 4) == missed + last
        assert events.lost == 0


async def test_the_last_event_is_found_although_nothing_follows_it():
    async with running_rig() as rig, follow_events(rig.client) as events:
        subscription = rig.broker.subscriptions.pop()
        ids = await commands(rig, 1)

        assert await taken(events, 1) == ids
        rig.broker.subscriptions.append(subscription)


@pytest.mark.long
async def test_what_the_daemon_has_forgotten_is_told_as_lost():
    async with running_rig() as rig, follow_events(rig.client) as events:
        await commands(rig, 1)
        await taken(events, 1)
        subscription = rig.broker.subscriptions.pop()
        ids = await commands(rig, KEPT_EVENTS // 2 + 7, first=1)
        rig.broker.subscriptions.append(subscription)

        assert await taken(events, KEPT_EVENTS // 2) == ids[7:]
        assert events.lost == 14


async def test_only_one_axis_is_told_of_when_that_is_wanted():
    async with running_rig() as rig, follow_events(rig.client, "y") as events:
        await commands(rig, 2, "x")
        ids = await commands(rig, 2, "y", first=2)

        assert await taken(events, 2) == ids
        assert events.lost == 0


async def test_a_daemon_that_was_started_anew_is_told():
    async with running_rig() as rig, follow_events(rig.client) as events:
        await commands(rig, 1)
        await taken(events, 1)
        log = rig.daemon._dispatcher.events
        log._run, log._end = "another", 0
        log._kept.clear()
        ids = await commands(rig, 1, first=1)

        assert await taken(events, 1) == ids
        assert (events.restarts, events.lost) == (1, 0)


@pytest.mark.long
async def test_a_list_of_events_fits_into_one_reply_and_all_of_them_are_fetched_by_pages():
    async with running_rig() as rig:
        ids = await commands(rig, 100)
        request = ReadEvents(count=1000)
        page = await rig.client.ask(request)

        fetched = await latest_events(rig.client, 150)
        of_x = await latest_events(rig.client, 1000, "x")
        of_y = await latest_events(rig.client, 10, "y")

    assert len(page.model_dump_json()) < MAX_PAYLOAD_BYTES
    assert page.events[-1].command_id == ids[-1]
    assert page.next_number == page.end_number == 200
    assert page.first_number == page.events[0].number > 0
    assert [event.number for event in fetched] == list(range(50, 200))
    assert [event.number for event in of_x] == list(range(200))
    assert of_y == []


async def test_nobody_is_asked_while_events_come_in_order():
    async with running_rig() as rig, follow_events(rig.client) as events:
        await commands(rig, 1)
        await taken(events, 1)
        asked = []
        rig.client.rig_command = lambda *_: asked.append(1)

        ids = await commands(rig, 20, first=1)
        assert await taken(events, 20) == ids

    assert asked == []


async def test_a_halt_of_an_axis_at_rest_is_an_event_as_well():
    async with running_rig() as rig, follow_events(rig.client) as events:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        await rig.client.command("x", Halt(client="ann", command_id="h"))
        event = await anext(events)

    assert (event.verb, event.client) == ("halt", "ann")


async def test_an_event_tells_over_whose_link_its_command_came():
    async with running_rig() as rig, rig.broker.session("ada") as session, follow_events(rig.client) as events:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        await RigClient(session, "sim").command("x", Power(on=False, client="bob"))
        event = await anext(events)

    assert (event.client, event.login) == ("bob", "ada")
