import asyncio
from itertools import pairwise

import pytest

from ldcnd.contract.errors import (
    BadReply,
    PacketRejected,
    ReplyTimeout,
)
from ldcnd.line.exchange import Exchange
from ldcnd.line.schedule import LONGEST_BACKOFF_S
from tests.support import toy_family as toy
from tests.support.bus_rig import BYTE_S, Rig, polled, running, scripted
from tests.support.scripted_line import Say, Script
from tests.support.toy_family import ToyPoller


async def test_a_poller_keeps_absolute_deadlines():
    rig = Rig()
    poller = ToyPoller(1, 0.02)

    await polled(rig, [poller], 10.0)

    drift = [at_s - number * 0.02 for number, at_s in enumerate(poller.asked_at_s)]
    assert len(poller.asked_at_s) in (500, 501)
    assert max(drift) < 0.002
    assert poller.delivered[:3] == [1, 2, 3]


async def test_two_pollers_delay_each_other_by_one_exchange_at_most():
    rig = Rig()
    pollers = [ToyPoller(1, 0.01), ToyPoller(2, 0.01)]

    await polled(rig, pollers, 1.0)

    late = [at_s % 0.01 for poller in pollers for at_s in poller.asked_at_s]
    assert max(min(lateness, 0.01 - lateness) for lateness in late) < 0.0015


async def test_a_poll_is_never_sent_again():
    rig = Rig(scripted({2: [[]]}))
    poller = ToyPoller(1, 0.05)

    await polled(rig, [poller], 0.24)

    assert rig.sent() == [1, 2, 3, 4, 5]
    assert poller.delivered == [1, 3, 4, 5]
    assert [type(error) for error in poller.errors] == [ReplyTimeout]


async def test_a_poller_hears_of_nonsense_and_of_rejected_packets():
    nonsense = [Say(toy.reply(1, kind=toy.NONSENSE))]
    rejected = [Say(toy.reply(2, kind=toy.REJECTED))]
    rig = Rig(scripted({1: [nonsense], 2: [rejected]}))
    poller = ToyPoller(1, 0.05)

    await polled(rig, [poller], 0.12)

    assert [type(error) for error in poller.errors] == [BadReply, PacketRejected]
    assert poller.delivered == [3]


async def test_a_poller_without_a_reply_is_asked_again():
    rig = Rig()
    poller = ToyPoller(1, 0.01)
    ask = poller.next_exchange

    def silent(now_s: float) -> Exchange[int]:
        number = toy.number_of(ask(now_s).request)
        return toy.exchange(number, reply_bytes=0)

    poller.next_exchange = silent  # type: ignore[method-assign]

    await polled(rig, [poller], 0.1)

    assert len(poller.delivered) in (10, 11)


@pytest.mark.parametrize("bytewise", [False, True])
@pytest.mark.sweep(2)
async def test_a_mute_node_is_asked_more_and_more_seldom_and_recovers_at_once(*, bytewise: bool):
    rig = Rig(toy.all_but(1))
    poller = ToyPoller(1, 0.02)

    def switch_on() -> None:
        rig.line.script = toy.answer
        rig.line.bytewise = bytewise

    await polled(rig, [poller], 30.0, switch_on)

    mute = [at_s for at_s in poller.asked_at_s if at_s < 30.0]
    pauses = [later - earlier for earlier, later in pairwise(mute)]
    assert len(mute) < 30
    assert 2.0 < max(pauses) < LONGEST_BACKOFF_S
    assert all(later >= earlier - 0.021 for earlier, later in pairwise(pauses[3:]))
    assert rig.bus.misses(1) == 0
    assert len(poller.delivered) > (30.0 - LONGEST_BACKOFF_S) / 0.02


async def test_a_mute_node_that_rejects_a_packet_is_mute_no_longer():
    rig = Rig(toy.all_but(1))
    poller = ToyPoller(1, 0.02)

    def switch_on() -> None:
        rig.line.script = lambda packet: [] if packet == toy.FLUSH else [Say(toy.reply(0, kind=toy.REJECTED))]

    await polled(rig, [poller], 30.0, switch_on)

    rejected = [error for error in poller.errors if isinstance(error, PacketRejected)]
    assert len(rejected) > (30.0 - LONGEST_BACKOFF_S) / 0.02


@pytest.mark.long
async def test_half_a_line_that_falls_mute_costs_the_other_half_little_and_is_back_at_once():
    rig = Rig(lambda packet: toy.answer(packet) if packet == toy.FLUSH or toy.node_of(packet) > 15 else [])
    healthy = ToyPoller(31, 0.002)
    mute = [ToyPoller(node, 0.05) for node in range(1, 16)]
    found_s = [0.0]

    def switch_on() -> None:
        rig.line.script = toy.answer
        found_s[0] = asyncio.get_running_loop().time()

    await polled(rig, [healthy, *mute], 30.0, switch_on)

    settled = [at_s for poller in mute for at_s in poller.asked_at_s if 15.0 <= at_s < 30.0]
    lost_s = 0.0152  # of one poll that nobody answers, resynchronisation included
    assert len(settled) * lost_s / 15.0 < 0.05
    first_s = [next(at_s for at_s in poller.asked_at_s if at_s >= found_s[0]) for poller in mute]
    assert min(first_s) < found_s[0] + LONGEST_BACKOFF_S
    assert max(first_s) - min(first_s) < 0.1  # one that answers lets all others be asked


@pytest.mark.long
async def test_one_mute_node_does_not_slow_thirty_healthy_ones():
    rig = Rig(toy.all_but(31))
    period_s = 0.05
    healthy = [ToyPoller(node, period_s) for node in range(1, 31)]
    dead = ToyPoller(31, period_s)

    await polled(rig, [*healthy, dead], 20.0)

    assert min(len(poller.delivered) for poller in healthy) / (20.0 / period_s) >= 0.98
    assert all(not poller.errors for poller in healthy)
    assert not dead.delivered


async def test_a_removed_poller_is_not_asked_again():
    rig = Rig()
    poller = ToyPoller(1, 0.01)

    await polled(rig, [poller], 0.1, lambda: rig.bus.remove_poller(poller))

    assert max(poller.asked_at_s) <= 0.1


@pytest.mark.parametrize("script", [toy.answer, toy.all_but(1)], ids=["answered", "mute"])
async def test_a_poller_removed_while_its_poll_is_on_the_wire_stays_removed(script: Script):
    rig = Rig(script)
    poller = ToyPoller(1, 0.01)

    async with running(rig):
        rig.bus.add_poller(poller)
        await asyncio.sleep(0.0005)
        rig.bus.remove_poller(poller)
        await asyncio.sleep(1.0)

    assert len(poller.asked_at_s) == 1
    assert len(poller.delivered) + len(poller.errors) == 1


async def test_adding_a_poller_again_only_moves_its_turn():
    rig = Rig()
    poller = ToyPoller(1, 0.01)

    async with running(rig):
        for _ in range(5):
            rig.bus.add_poller(poller)
        poller.due_at_s = 0.5
        rig.bus.add_poller(poller)
        await asyncio.sleep(0.545)

    assert len([at_s for at_s in poller.asked_at_s if at_s >= 0.5]) == 5


async def test_commands_and_polls_share_a_full_line_in_the_promised_ratio():
    rig = Rig()
    greedy = ToyPoller(5, 0.0001)

    async with running(rig) as callers:
        rig.bus.add_poller(greedy)
        for number in range(40):
            callers.create_task(rig.bus.execute(toy.exchange(1000 + number)), name=f"caller {number}")

    nodes = rig.nodes()
    last = max(turn for turn, node in enumerate(nodes) if node == 1)
    assert nodes[: last + 1].count(5) in (9, 10, 11)
    assert [5] * 2 not in [nodes[turn : turn + 2] for turn in range(last)]


async def test_the_first_caller_after_a_poll_waits_for_that_poll_only():
    rig = Rig()
    greedy = ToyPoller(5, 0.0001)

    async with running(rig):
        rig.bus.add_poller(greedy)
        await asyncio.sleep(0.1)
        asked_s = asyncio.get_running_loop().time()
        await rig.bus.execute(toy.exchange(1))
        took_s = asyncio.get_running_loop().time() - asked_s

    exchange_s = 14 * BYTE_S + 0.0001
    assert took_s < 2 * exchange_s + 1e-6


@pytest.mark.parametrize("slow_to_deliver", [True, False])
async def test_only_a_poller_with_much_to_do_has_the_next_request_leave_first(monkeypatch, *, slow_to_deliver: bool):
    rig = Rig()
    pollers = [ToyPoller(1, 0.0001), ToyPoller(2, 0.0001)]
    for poller in pollers:
        poller.slow_to_deliver = slow_to_deliver
    pushed_with: list[int] = []

    def delivered() -> int:
        return sum(len(poller.delivered) for poller in pollers)

    async with running(rig):
        monkeypatch.setattr(rig.line, "pushes", True)
        monkeypatch.setattr(rig.line, "push", lambda: pushed_with.append(delivered()))
        for poller in pollers:
            rig.bus.add_poller(poller)
        await asyncio.sleep(0.05)

    assert delivered() > 10
    # once for each reply, before it is delivered
    assert pushed_with == (list(range(delivered())) if slow_to_deliver else [])


async def test_what_a_poller_or_listener_raises_is_said_once_and_neither_holds_up_the_line_nor_closes_it():
    rig = Rig(scripted({2: [[]]}))
    loop, said = asyncio.get_running_loop(), []
    loop.set_exception_handler(lambda _, context: said.append(context["exception"]))
    broken, sound = ToyPoller(1, 0.05), ToyPoller(2, 0.05)

    def fail(*_told: object) -> None:
        raise KeyError("lock")

    broken.deliver = broken.missed = fail  # type: ignore[method-assign]
    rig.bus.listeners.append(fail)
    failed = asyncio.ensure_future(rig.bus.wait_failed())

    await polled(rig, [broken, sound], 1.0)

    assert len(sound.delivered) >= 19
    assert rig.bus.statistics.losses == 0
    assert [type(error) for error in said] == [KeyError]
    with pytest.raises(KeyError):
        await failed
