import asyncio
from collections.abc import Coroutine
from dataclasses import replace
from typing import Any

import pytest

from ldcnd.contract.errors import (
    BusBusy,
    LdcndError,
    NotIdentified,
    NotSupported,
    StopLatched,
    WrongState,
)
from ldcnd.line.exchange import Lane, PacketEffect
from ldcnd.line.proof import only_while
from ldcnd.line.schedule import LANE_LIMITS
from tests.support import toy_family as toy
from tests.support.bus_rig import BYTE_S, SETTINGS, Rig, running, scripted
from tests.support.toy_family import ToyPoller


async def test_a_caller_gets_its_decoded_reply():
    rig = Rig()

    async with running(rig):
        reply = await rig.bus.execute(toy.exchange(7))

    assert reply == 7
    assert rig.bus.statistics.replies == 1


async def test_latency_counts_from_when_an_exchange_was_asked_for():
    rig = Rig()
    async with running(rig):
        await asyncio.sleep(10.0)
        await rig.bus.execute(toy.exchange(1))

    latency = rig.bus.statistics.latency[Lane.COMMAND]
    assert 0.001 < latency.longest_s < 0.01


async def test_stop_overtakes_queued_commands_and_polls():
    rig = Rig()
    poller = ToyPoller(5, 0.01)

    async with running(rig) as callers:
        for number in (1, 2, 3):
            callers.create_task(rig.bus.execute(toy.exchange(number)), name=f"command {number}")
        await asyncio.sleep(0)
        rig.bus.add_poller(poller)
        await rig.bus.execute(toy.exchange(9), Lane.STOP)
        rig.bus.remove_poller(poller)

    assert rig.sent()[:2] == [1, 9]


async def test_what_can_move_is_sent_only_if_its_condition_holds_when_its_turn_comes():
    rig = Rig()
    held = True

    def condition() -> None:
        if not held:
            raise WrongState("not any more")

    moving = replace(toy.exchange(2), effect=PacketEffect.CHANGES)
    async with running(rig) as callers:
        rig.bus.proofs.expect(1, "node 1").prove()
        callers.create_task(rig.bus.execute(toy.exchange(1)), name="first")
        await asyncio.sleep(0)
        with only_while(condition):
            refused = callers.create_task(outcome_of(rig.bus.execute(moving)), name="moving")
            callers.create_task(rig.bus.execute(toy.exchange(3)), name="harmless")
            callers.create_task(rig.bus.execute(replace(moving, request=toy.exchange(9).request), Lane.STOP))
        await asyncio.sleep(0)
        held = False

    assert isinstance(refused.result(), WrongState)
    assert rig.sent() == [1, 9, 3]


async def test_a_stop_that_is_refused_lets_no_command_pass_before_the_line_is_proven_to_be_in_step():
    rig = Rig()

    async with running(rig):
        rig.line.say(b"\xf0")
        stranger = replace(toy.exchange(2, node=9), effect=PacketEffect.CHANGES)
        async with asyncio.TaskGroup() as callers:
            command = callers.create_task(rig.bus.execute(toy.exchange(1)), name="command")
            stop = callers.create_task(outcome_of(rig.bus.execute(stranger, Lane.STOP)), name="stop")

    assert isinstance(stop.result(), NotIdentified)
    assert command.result() == 1
    assert rig.nodes() == [toy.PROBE_NODE, 1]


async def test_a_line_that_is_distrusted_proves_that_it_is_in_step_before_it_believes_another_reply():
    rig = Rig()

    async with running(rig) as callers:
        on_its_way = callers.create_task(rig.bus.execute(toy.exchange(1)), name="on its way")
        await asyncio.sleep(0)
        rig.bus.distrust()

    assert on_its_way.result() == 1
    assert rig.sent() == [1, 1]
    assert rig.bus.statistics.resynchronisations == 1


async def test_a_stop_behind_what_must_not_be_repeated_has_its_outcome_on_a_line_that_is_distrusted():
    rig = Rig()

    async with running(rig) as callers:
        start = callers.create_task(rig.bus.execute(toy.exchange(1, repeatable=False)), name="start")
        await asyncio.sleep(0)
        rig.bus.distrust()
        stop = callers.create_task(rig.bus.execute(toy.exchange(2), Lane.STOP), name="stop")
        await asyncio.wait((start, stop), timeout=5.0)
        outcomes = [each.result() if each.done() else None for each in (start, stop)]
        rig.bus.drop("the test is over")
        stop.cancel()

    assert outcomes == [1, 2]
    assert rig.sent() == [1, 2, 2]


async def outcome_of(call: Coroutine[Any, Any, int]) -> int | LdcndError:
    try:
        return await call
    except LdcndError as error:
        return error


async def test_background_gives_way_to_commands():
    rig = Rig()

    async with running(rig) as callers:
        callers.create_task(rig.bus.execute(toy.exchange(1)), name="first")
        callers.create_task(rig.bus.execute(toy.exchange(2), Lane.BACKGROUND), name="background")
        callers.create_task(rig.bus.execute(toy.exchange(3)), name="command")

    assert rig.sent() == [1, 3, 2]


async def test_a_caller_cancelled_in_the_queue_sends_nothing():
    rig = Rig()

    async with running(rig) as callers:
        tasks = [
            callers.create_task(rig.bus.execute(toy.exchange(number)), name=f"caller {number}") for number in (1, 2, 3)
        ]
        await asyncio.sleep(0)
        tasks[1].cancel()

    assert rig.sent() == [1, 3]
    assert tasks[1].cancelled()


@pytest.mark.parametrize("repeatable", [True, False])
async def test_a_caller_cancelled_on_the_wire_leaves_the_line_in_step(*, repeatable: bool):
    rig = Rig()

    async with running(rig) as callers:
        first = callers.create_task(rig.bus.execute(toy.exchange(1, repeatable=repeatable)), name="first")
        second = callers.create_task(rig.bus.execute(toy.exchange(2)), name="second")
        await asyncio.sleep(0.0003)
        first.cancel()

    assert first.cancelled()
    assert second.result() == 2
    assert rig.sent() == [1, 2]
    assert rig.bus.statistics.resynchronisations == 0


async def test_nothing_is_sent_again_for_a_caller_that_has_gone():
    rig = Rig(toy.all_but(1))

    async with running(rig):
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.001):
                await rig.bus.execute(toy.exchange(1))
        await rig.bus.execute(toy.exchange(2, node=2))

    assert rig.sent() == [1, 2]


async def test_a_command_that_is_withdrawn_before_it_is_repeated_says_that_it_was_sent():
    rig = Rig(scripted({1: [[]]}))

    async with running(rig) as callers:
        command = callers.create_task(outcome_of(rig.bus.execute(toy.exchange(1, node=1))), name="command")
        while rig.bus.statistics.timeouts == 0:
            await asyncio.sleep(0.001)
        rig.bus.withdraw(1, StopLatched("a stop came"))

    assert isinstance(command.result(), StopLatched)
    assert "sent once" in str(command.result())
    assert rig.sent() == [1]


async def test_withdrawing_fails_the_nodes_waiting_commands_only():
    rig = Rig()
    latched = WrongState("stopped")

    async def caught(call: Coroutine[Any, Any, int]) -> int | WrongState:
        try:
            return await call
        except WrongState as error:
            return error

    async with running(rig) as callers:
        calls = {
            "on the wire": rig.bus.execute(toy.exchange(1)),
            "waiting": rig.bus.execute(toy.exchange(2)),
            "other node": rig.bus.execute(toy.exchange(3, node=2)),
            "stop": rig.bus.execute(toy.exchange(4), Lane.STOP),
        }
        tasks = {name: callers.create_task(caught(call), name=name) for name, call in calls.items()}
        await asyncio.sleep(0)
        rig.bus.withdraw(1, latched)

    assert {name: task.result() for name, task in tasks.items()} == {
        "on the wire": 1,
        "waiting": latched,
        "other node": 3,
        "stop": 4,
    }
    assert rig.sent() == [1, 4, 3]


async def test_a_full_lane_sends_nothing_and_says_so():
    rig = Rig()
    room = LANE_LIMITS[Lane.COMMAND]

    async with running(rig) as callers:
        for number in range(room + 1):
            callers.create_task(rig.bus.execute(toy.exchange(number)), name=f"caller {number}")
        await asyncio.sleep(0)
        with pytest.raises(BusBusy):
            await rig.bus.execute(toy.exchange(1000))
        stopped = await rig.bus.execute(toy.exchange(2000), Lane.STOP)

    assert stopped == 2000
    assert 1000 not in rig.sent()
    assert len(rig.sent()) == room + 2


async def test_the_rate_changes_between_the_reply_and_the_next_request():
    rig = Rig()

    async with running(rig) as callers:
        change = callers.create_task(rig.bus.change_baud(toy.exchange(1), 19_200), name="change")
        after = callers.create_task(rig.bus.execute(toy.exchange(2)), name="after")

    assert (change.result(), after.result()) == (1, 2)
    assert rig.line.history[:3] == [
        f"write {toy.request(1, 1).hex()}",
        "baud 19200",
        f"write {toy.request(1, 2).hex()}",
    ]
    assert rig.bus.baud == SETTINGS.baud  # closed again: the rate of the next opening


async def test_a_reopened_line_starts_at_the_configured_rate():
    rig = Rig()

    async with running(rig):
        await rig.bus.change_baud(toy.exchange(1, reply_bytes=0, response_s=0.001), 19_200)
        changed = rig.bus.baud
        rig.line.lose()
        await rig.bus.wait_opened()

        assert changed == 19_200
        assert rig.bus.baud == 115_200


async def test_a_port_that_is_lost_as_soon_as_it_is_open_is_tried_ever_more_slowly_and_said_once(capsys):
    rig = Rig()
    loop = asyncio.get_running_loop()

    async with running(rig):
        until_s = loop.time() + 60.0
        while loop.time() < until_s:
            await rig.bus.wait_opened()
            rig.line.lose()
            await rig.bus.wait_closed(rig.bus.statistics.openings)
        attempts = rig.bus.statistics.openings
        await rig.bus.wait_opened()
        await asyncio.sleep(5.0)

    said = capsys.readouterr().out
    assert attempts <= 35
    assert (said.count("line lost"), said.count("line open")) == (1, 2)


async def test_an_adapter_that_comes_late_is_said_to_be_open_before_anything_is_sent(capsys):
    rig = Rig()
    rig.opener.refusals = 2

    async with running(rig):
        await rig.bus.wait_opened()
        await asyncio.sleep(0.1)

    said = capsys.readouterr().out
    assert (said.count("port not open"), said.count("line open")) == (1, 1)


async def test_a_far_end_with_its_own_rate_refuses_before_anything_is_sent():
    rig = Rig()
    rig.opener.fixed_baud = True

    async with running(rig):
        with pytest.raises(NotSupported, match="cannot change its rate"):
            await rig.bus.change_baud(toy.exchange(1), 19_200)

    assert rig.sent() == []


async def test_the_longest_time_of_an_exchange_follows_the_rate():
    rig = Rig()

    async with running(rig):
        assert rig.bus.longest_s(toy.exchange(1)) == pytest.approx(14 * BYTE_S + toy.RESPONSE_S)
