"""Replies of a line that is busy with polls are delivered several at a time, in order, before anything else ends."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import pytest
from typing_extensions import override

from ldcnd.contract.errors import BusError
from ldcnd.line.exchange import Exchange, Lane, PacketEffect, Timing
from ldcnd.line.proof import only_while
from tests.support import toy_family as toy
from tests.support.bus_rig import BYTE_S, SETTINGS, Rig, running
from tests.support.scripted_line import Say

COALESCE_S = 0.005
EXCHANGE_S = (toy.REQUEST_BYTES + toy.REPLY_BYTES) * BYTE_S + 0.0001


class NotedPoller(toy.ToyPoller):
    """Notes what is delivered to it, and when."""

    slow_to_deliver = True

    def __init__(self, node: int, period_s: float, story: list[str]) -> None:
        super().__init__(node, period_s)
        self.story = story
        self.waited_s: list[float] = []
        self.then: Callable[[], None] = lambda: None

    @override
    def deliver(self, reply: int, timing: Timing) -> None:
        super().deliver(reply, timing)
        self.story.append(f"reading {self.node}.{reply}")
        self.waited_s.append(asyncio.get_running_loop().time() - timing.received_at_s)
        self.then()

    @override
    def missed(self, error: BusError) -> None:
        super().missed(error)
        self.story.append(f"missed {self.node}")


def coalescing(coalesce_s: float = COALESCE_S) -> Rig:
    return Rig(settings=replace(SETTINGS, coalesce_s=coalesce_s))


def busy(rig: Rig, story: list[str]) -> list[NotedPoller]:
    """Add pollers that ask for more than the line carries."""
    pollers = [NotedPoller(node, 0.0005, story) for node in (1, 2, 3)]
    for poller in pollers:
        rig.bus.add_poller(poller)
    return pollers


def moving(number: int) -> Exchange[int]:
    return replace(toy.exchange(number, node=9), effect=PacketEffect.CHANGES)


async def test_readings_of_a_busy_line_come_several_at_a_time_in_order_and_in_time():
    rig, story = coalescing(), []

    async with running(rig):
        pollers = busy(rig, story)
        await asyncio.sleep(0.2)
        delivered = len(story)

    received_at_s = sorted(timing.received_at_s for poller in pollers for timing in poller.timings)
    waited_s = [waited_s for poller in pollers for waited_s in poller.waited_s]
    batches = len({round(at_s + waited_s, 6) for at_s, waited_s in _arrivals(pollers)})
    assert delivered > 100
    assert delivered / batches > 3
    assert max(waited_s) <= COALESCE_S
    assert all(later - earlier < 1.01 * EXCHANGE_S for earlier, later in pairwise(received_at_s))
    for poller in pollers:
        assert poller.delivered == list(range(1, len(poller.delivered) + 1))


def _arrivals(pollers: list[NotedPoller]) -> list[tuple[float, float]]:
    return [
        (timing.received_at_s, waited_s)
        for poller in pollers
        for timing, waited_s in zip(poller.timings, poller.waited_s, strict=True)
    ]


async def test_without_coalescing_each_reading_comes_at_once():
    rig = coalescing(0.0)

    async with running(rig):
        pollers = busy(rig, [])
        await asyncio.sleep(0.1)

    assert max(waited_s for poller in pollers for waited_s in poller.waited_s) == 0.0


async def test_the_last_reading_before_a_pause_waits_for_nothing():
    rig = coalescing()

    async with running(rig):
        pollers = [NotedPoller(node, 0.1, []) for node in (1, 2, 3)]
        for poller in pollers:
            rig.bus.add_poller(poller)
        await asyncio.sleep(1.0)

    assert [len(poller.delivered) for poller in pollers] == [10, 10, 10]
    assert max(pollers[-1].waited_s) == 0.0
    assert max(pollers[0].waited_s) < 2.01 * EXCHANGE_S


async def test_permission_to_move_is_asked_of_all_that_the_drives_have_said():
    rig, asked = coalescing(), []

    def condition() -> None:
        asked.append((asyncio.get_running_loop().time(), [timing for poller in pollers for timing in poller.timings]))

    async with running(rig) as callers:
        rig.bus.proofs.expect(9, "node 9").prove()
        pollers = busy(rig, [])
        await asyncio.sleep(0.1)
        for number in range(40):
            await asyncio.sleep(0.0031)
            with only_while(condition):
                callers.create_task(rig.bus.execute(moving(number)), name=f"move {number}")
        await asyncio.sleep(0.1)

    received_at_s = [timing.received_at_s for poller in pollers for timing in poller.timings]
    assert len(asked) == 40
    for at_s, known in asked:
        # the reply that has just come is digested behind the packet, as without coalescing
        assert len([each_s for each_s in received_at_s if each_s < at_s]) == len(known)


async def test_readings_come_before_the_outcome_of_what_was_sent_after_them():
    rig, story = coalescing(), []

    async with running(rig):
        pollers = busy(rig, story)
        await asyncio.sleep(0.1)
        for lane in (Lane.COMMAND, Lane.STOP, Lane.BACKGROUND) * 10:
            await asyncio.sleep(0.0031)
            began_s = asyncio.get_running_loop().time()
            await rig.bus.execute(toy.exchange(1, node=9), lane)
            asked = {poller.node: [at_s for at_s in poller.asked_at_s if at_s < began_s] for poller in pollers}
            for poller in pollers:  # the one that was on the wire then may be any of them
                assert len(poller.delivered) >= len(asked[poller.node]) - 1
            assert sum(len(poller.delivered) for poller in pollers) >= sum(map(len, asked.values()))


async def test_readings_that_wait_are_delivered_when_the_reply_after_them_is_lost():
    rig, story = coalescing(), []

    def script(packet: bytes) -> list[Say]:
        lost = packet != toy.FLUSH and toy.node_of(packet) == 2 and toy.number_of(packet) == 20
        return [] if lost else toy.answer(packet)

    rig.opener.script = script
    async with running(rig):
        busy(rig, story)
        await asyncio.sleep(0.2)

    place = story.index("missed 2")
    assert story[place - 1].startswith("reading 1.")
    assert story.count("missed 2") == 1


@pytest.mark.parametrize("every", [1, 1000])
async def test_readings_behind_one_that_cannot_be_its_drives_own_are_not_believed(every):
    rig, story = coalescing(), []
    rig.opener.script = irregular(every)

    async with running(rig):
        first, second, third = busy(rig, story)
        await asyncio.sleep(0.1)

        def foreign() -> None:
            if rig.bus._line.undelivered and "foreign" not in story:
                story.append("foreign")
                rig.bus.distrust()

        first.then = foreign
        await asyncio.sleep(0.1)

    behind = story[story.index("foreign") + 1 :]
    missed = [said for said in behind if said.startswith("missed")]
    assert behind[: len(missed)] == missed  # those that waited, and the one on the wire
    assert len(missed) >= 2
    assert behind[len(missed)].startswith("reading")
    assert second.delivered == sorted(second.delivered)
    assert third.delivered == sorted(third.delivered)


async def test_readings_that_wait_are_delivered_when_the_line_is_lost():
    rig, story = coalescing(), []

    async with running(rig):
        pollers = busy(rig, story)
        await asyncio.sleep(0.1 + 2.5 * EXCHANGE_S)
        rig.line.lose()
        asked = sum(len(poller.asked_at_s) for poller in pollers)
        assert sum(len(poller.delivered) + len(poller.errors) for poller in pollers) == asked
        assert [len(poller.errors) for poller in pollers].count(1) == 1


async def test_readings_do_not_wait_for_a_packet_that_has_no_reply():
    rig = coalescing()

    async with running(rig):
        pollers = busy(rig, [])
        await asyncio.sleep(0.1)
        for _ in range(10):
            await asyncio.sleep(0.0031)
            await rig.bus.execute(toy.exchange(1, node=9, reply_bytes=0, response_s=0.1))

    assert max(waited_s for poller in pollers for waited_s in poller.waited_s) <= COALESCE_S


def irregular(every: int) -> Callable[[bytes], list[Say]]:
    """Return a script in which some replies of node 2 follow a foreign one, and so take the long way."""

    def script(packet: bytes) -> list[Say]:
        says = toy.answer(packet)
        if packet != toy.FLUSH and toy.node_of(packet) == 2 and toy.number_of(packet) % every == 0:
            foreign = Say(toy.reply(1, kind=toy.FOREIGN))
            return [foreign, replace(says[0], after_s=0.0002 + toy.REPLY_BYTES * BYTE_S)]
        return says

    return script


async def test_readings_come_in_order_also_where_a_reply_follows_a_foreign_one():
    rig, story = coalescing(), []
    rig.opener.script = irregular(every=5)

    async with running(rig):
        busy(rig, story)
        await asyncio.sleep(0.2)

    assert len(story) > 60
    assert story == [f"reading {node}.{number}" for number in range(1, 100) for node in (1, 2, 3)][: len(story)]


async def test_readings_come_before_what_is_learnt_of_a_packet_that_a_drive_received_damaged():
    rig, story = coalescing(), []

    def script(packet: bytes) -> list[Say]:
        rejects = packet != toy.FLUSH and toy.node_of(packet) == 2 and toy.number_of(packet) % 5 == 0
        return [Say(toy.reply(1, kind=toy.REJECTED))] if rejects else toy.answer(packet)

    rig.opener.script = script
    async with running(rig):
        busy(rig, story)
        await asyncio.sleep(0.2)

    missed = [at for at, said in enumerate(story) if said == "missed 2"]
    assert len(missed) > 5
    assert [story[at - 1] for at in missed] == [f"reading 1.{5 * number}" for number in range(1, len(missed) + 1)]


@pytest.mark.parametrize("repeatable", [True, False])
@pytest.mark.sweep(2)
async def test_after_a_foreign_reading_no_packet_is_sent_before_the_line_is_proven_to_be_in_step(*, repeatable):
    """Nor is one whose permission made the readings be delivered that waited."""
    rig, flushed = coalescing(), []

    async with running(rig) as callers:
        rig.bus.proofs.expect(9, "node 9").prove()
        first, *_ = busy(rig, [])
        for _ in range(40):
            await asyncio.sleep(0.1031)
            foreign_at: list[int] = []

            def foreign(foreign_at: list[int] = foreign_at) -> None:
                if not foreign_at:
                    foreign_at.append(len(rig.line.writes))
                    rig.bus.distrust()

            first.then = foreign
            with only_while(lambda: None):
                move = callers.create_task(rig.bus.execute(replace(moving(7), repeatable=repeatable)), name="move")
            assert await move == 7
            await asyncio.sleep(0.05)
            flushed.append(rig.line.packets()[foreign_at[0]] == toy.FLUSH)

    assert flushed == [True] * 40


async def test_a_refusal_behind_a_foreign_reading_is_not_believed_either():
    rig, story = coalescing(), []

    def script(packet: bytes) -> list[Say]:
        rejects = packet != toy.FLUSH and toy.node_of(packet) == 2 and toy.number_of(packet) % 5 == 0
        return [Say(toy.reply(1, kind=toy.REJECTED))] if rejects else toy.answer(packet)

    def foreign() -> None:
        if len(first.delivered) % 5 == 0:
            story.append(len(rig.line.writes))
            rig.bus.distrust()

    rig.opener.script = script
    async with running(rig):
        first, *_ = busy(rig, [])
        first.then = foreign
        await asyncio.sleep(0.5)

    assert len(story) > 5
    assert {rig.line.packets()[place] for place in story[:-1]} == {toy.FLUSH}
