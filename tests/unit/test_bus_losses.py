import asyncio
from itertools import pairwise

import pytest

from ldcnd.contract.errors import (
    BadReply,
    BusDown,
    OutcomeUnknown,
    PacketRejected,
    ReplyTimeout,
)
from ldcnd.line.bus import LONGEST_REOPEN_S, only_during
from ldcnd.line.exchange import Lane
from tests.support import toy_family as toy
from tests.support.bus_rig import BYTE_S, Rig, outcome, running, scripted
from tests.support.scripted_line import Say
from tests.support.toy_family import ToyPoller


async def test_a_repeatable_exchange_is_sent_three_times_at_most():
    rig = Rig(toy.all_but(1))

    async with running(rig):
        with pytest.raises(ReplyTimeout, match="3 attempts") as lost:
            await rig.bus.execute(toy.exchange(1))

    assert rig.sent() == [1, 1, 1]
    assert lost.value.remedy


async def test_a_repeatable_exchange_survives_a_lost_reply():
    rig = Rig(scripted({1: [[], []]}))

    async with running(rig):
        reply = await rig.bus.execute(toy.exchange(1))

    assert reply == 1
    assert rig.sent() == [1, 1, 1]
    assert rig.bus.statistics.resent == 2


async def test_what_is_sent_again_goes_before_what_came_later():
    rig = Rig(scripted({1: [[]]}))

    async with running(rig) as callers:
        for number in (1, 2, 3):
            callers.create_task(rig.bus.execute(toy.exchange(number)), name=f"caller {number}")

    assert rig.sent() == [1, 1, 2, 3]


@pytest.mark.parametrize(
    "says",
    [[], [Say(toy.reply(1)[:-1] + b"\x00")], [Say(toy.reply(1) + b"\x00")], [Say(toy.reply(1)[:2])]],
    ids=["nothing", "damaged", "surplus", "cut"],
)
async def test_what_must_not_be_repeated_is_sent_once_and_its_outcome_is_unknown(says: list[Say]):
    rig = Rig(scripted({1: [says]}))

    async with running(rig):
        with pytest.raises(OutcomeUnknown, match="must not be repeated"):
            await rig.bus.execute(toy.exchange(1, repeatable=False))
        after = await rig.bus.execute(toy.exchange(2))

    assert rig.sent() == [1, 2]
    assert after == 2


async def test_a_rejected_packet_is_sent_again_even_if_it_must_not_be_repeated():
    rig = Rig(scripted({1: [[Say(toy.reply(1, kind=toy.REJECTED))]]}))

    async with running(rig):
        reply = await rig.bus.execute(toy.exchange(1, repeatable=False))

    assert reply == 1
    assert rig.sent() == [1, 1]
    assert rig.bus.statistics.resynchronisations == 0


async def test_a_packet_rejected_at_every_attempt_is_reported_as_not_executed():
    rejected = [Say(toy.reply(1, kind=toy.REJECTED))]
    rig = Rig(scripted({1: [rejected] * 5}))

    async with running(rig):
        with pytest.raises(PacketRejected, match="3 damaged packets"):
            await rig.bus.execute(toy.exchange(1, repeatable=False))

    assert rig.sent() == [1, 1, 1]


async def test_rejected_and_then_lost_is_unknown():
    rig = Rig(scripted({1: [[Say(toy.reply(1, kind=toy.REJECTED))], []]}))

    async with running(rig):
        with pytest.raises(OutcomeUnknown):
            await rig.bus.execute(toy.exchange(1, repeatable=False))

    assert rig.sent() == [1, 1]


async def test_an_intact_reply_without_sense_is_the_callers():
    rig = Rig(scripted({1: [[Say(toy.reply(1, kind=toy.NONSENSE))]]}))

    async with running(rig):
        with pytest.raises(BadReply, match="unknown kind"):
            await rig.bus.execute(toy.exchange(1))
        after = await rig.bus.execute(toy.exchange(2))

    assert after == 2
    assert rig.sent() == [1, 2]


async def test_a_late_reply_is_not_credited_to_the_next_caller():
    rig = Rig(scripted({1: [[Say(toy.reply(1), after_s=0.009, unbidden=True)]]}))

    async with running(rig) as callers:
        first = callers.create_task(outcome(rig.bus.execute(toy.exchange(1, repeatable=False))), name="first")
        second = callers.create_task(outcome(rig.bus.execute(toy.exchange(2))), name="second")

    assert isinstance(first.result(), OutcomeUnknown)
    assert second.result() == 2


async def test_a_babbling_line_answers_every_caller_in_bounded_time():
    rig = Rig()
    loop = asyncio.get_running_loop()
    poller = ToyPoller(2, 0.05)

    async def babble() -> None:
        while True:
            rig.line.say(b"\x55\x01")
            await asyncio.sleep(0.0005)

    async with running(rig) as callers:
        babbling = callers.create_task(babble(), name="babble")
        rig.bus.add_poller(poller)
        started_s = loop.time()
        answers = [
            await outcome(rig.bus.execute(toy.exchange(1))),
            await outcome(rig.bus.execute(toy.exchange(2, repeatable=False))),
        ]
        took_s = loop.time() - started_s
        babbling.cancel()
        await asyncio.sleep(0.2)
        healed = await rig.bus.execute(toy.exchange(3))
        rig.bus.remove_poller(poller)

    assert [type(answer) for answer in answers] == [ReplyTimeout, OutcomeUnknown]
    assert took_s < 5.0
    assert poller.errors
    assert healed == 3


async def test_a_babbling_line_does_not_hold_back_a_stop():
    rig = Rig()

    async with running(rig):
        rig.line.say(b"\x55")
        await asyncio.sleep(0.001)
        asked_s = asyncio.get_running_loop().time()
        rig.line.say(b"\x55")
        await rig.bus.execute(toy.exchange(1), Lane.STOP)

    stop = next(written for written in rig.line.writes if written.data == toy.request(1, 1))
    assert stop.at_s - asked_s == pytest.approx(len(toy.FLUSH) * BYTE_S + toy.RESYNC.settle_s)


async def test_a_stop_that_nobody_waits_for_any_more_opens_no_gap_in_the_quarantine():
    rig = Rig()

    async with running(rig) as callers:
        rig.line.say(b"\x55")
        command = callers.create_task(rig.bus.execute(toy.exchange(1)), name="command")
        stop = callers.create_task(rig.bus.execute(toy.exchange(2), Lane.STOP), name="stop")
        await asyncio.sleep(0)
        stop.cancel()
        await command

    assert rig.nodes() == [toy.PROBE_NODE, 1]


async def test_a_bus_that_is_not_open_sends_nothing():
    rig = Rig()

    with pytest.raises(BusDown, match="toy"):
        await rig.bus.execute(toy.exchange(1))

    assert not rig.bus.is_open
    assert not rig.opener.lines


async def test_a_lost_line_gives_each_caller_one_outcome():
    rig = Rig(lambda _packet: [])

    async with running(rig) as callers:
        exchanges = [toy.exchange(1, repeatable=False), toy.exchange(2), toy.exchange(3, repeatable=False)]
        tasks = [
            callers.create_task(outcome(rig.bus.execute(exchange)), name=f"caller {number}")
            for number, exchange in enumerate(exchanges)
        ]
        await asyncio.sleep(0)
        rig.line.lose("unplugged")

    assert [type(task.result()) for task in tasks] == [OutcomeUnknown, BusDown, BusDown]
    assert rig.sent() == [1]


async def test_a_repeatable_exchange_on_a_lost_line_is_not_sent_on_the_next():
    rig = Rig(lambda _packet: [])

    async with running(rig) as callers:
        task = callers.create_task(outcome(rig.bus.execute(toy.exchange(1))), name="caller")
        await asyncio.sleep(0)
        rig.line.lose()
        await rig.bus.wait_opened()
        await asyncio.sleep(1)

    assert isinstance(task.result(), BusDown)
    assert len(rig.opener.lines) == 2
    assert rig.sent() == []


async def test_a_lost_line_is_opened_again_and_its_pollers_are_forgotten():
    rig = Rig()
    poller = ToyPoller(1, 0.01)

    async with running(rig):
        rig.bus.add_poller(poller)
        await asyncio.sleep(0.1)
        rig.line.lose()
        await rig.bus.wait_closed(rig.bus.statistics.openings)
        assert not rig.bus.is_open
        assert not rig.bus._schedule._pollers
        asked = len(poller.asked_at_s)
        await rig.bus.wait_opened()
        reply = await rig.bus.execute(toy.exchange(1))
        await asyncio.sleep(0.1)

    assert asked >= 10
    assert len(poller.asked_at_s) == asked
    assert reply == 1
    assert rig.opener.lines[0].history[-1] == "close"
    assert rig.bus.statistics.openings == 2
    assert rig.bus.statistics.losses == 1


async def test_who_sleeps_over_a_loss_hears_of_it_and_sends_nothing_through_the_next_opening():
    rig = Rig()
    poller, stop = ToyPoller(1, 0.01), toy.exchange(3)

    async with running(rig):
        opening = await rig.bus.wait_opened()
        with only_during(rig.bus, opening):
            assert await rig.bus.execute(toy.exchange(1)) == 1
            rig.line.lose()
            await asyncio.sleep(1.0)
            async with asyncio.timeout(0.1):
                await rig.bus.wait_closed(opening)
            rig.bus.add_poller(poller)
            with pytest.raises(BusDown):
                await rig.bus.execute(toy.exchange(2))
            assert await rig.bus.execute(stop, Lane.STOP) == 3
        assert await rig.bus.execute(toy.exchange(4)) == 4

    assert rig.sent() == [3, 4]
    assert poller.asked_at_s == []


async def test_a_port_that_cannot_be_opened_is_tried_more_and_more_seldom():
    rig = Rig()
    rig.opener.refusals = 9

    async with running(rig):
        reply = await rig.bus.execute(toy.exchange(1))

    tried = rig.opener.attempted_at_s
    pauses = [later - earlier for earlier, later in pairwise(tried)]
    assert pauses == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6] + [LONGEST_REOPEN_S] * 4)
    assert reply == 1


async def test_after_an_opening_the_pauses_start_short_again():
    rig = Rig()
    rig.opener.refusals = 5

    async with running(rig):
        rig.opener.refusals = 2
        lost_s = asyncio.get_running_loop().time()
        rig.line.lose()
        await rig.bus.wait_closed(rig.bus.statistics.openings)
        await rig.bus.wait_opened()

    tried = [at_s - lost_s for at_s in rig.opener.attempted_at_s if at_s > lost_s]
    assert tried == pytest.approx([0.1, 0.2, 0.4])


async def test_a_failing_write_is_a_lost_line():
    rig = Rig()

    async with running(rig):
        rig.line.fails_to_write = True
        with pytest.raises(OutcomeUnknown):
            await rig.bus.execute(toy.exchange(1, repeatable=False))
        await rig.bus.wait_opened()
        reply = await rig.bus.execute(toy.exchange(2))

    assert reply == 2


async def test_cancelling_the_bus_gives_the_port_back_and_answers_every_caller():
    rig = Rig(lambda _packet: [])

    async with asyncio.TaskGroup() as group:
        owner = group.create_task(rig.bus.run(), name="bus")
        await rig.bus.wait_opened()
        tasks = [
            group.create_task(outcome(rig.bus.execute(toy.exchange(number))), name=f"caller {number}")
            for number in (1, 2)
        ]
        await asyncio.sleep(0)
        owner.cancel()

    assert [type(task.result()) for task in tasks] == [BusDown, BusDown]
    assert rig.line.history[-1] == "close"
    assert not rig.bus.is_open
    scheduled = [timer for timer in asyncio.get_running_loop()._scheduled if not timer.cancelled()]
    assert scheduled == []
