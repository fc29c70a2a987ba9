"""Whether a bus still does its work, as the watchdog asks."""

import asyncio

from ldcnd.contract.errors import TransportLost
from ldcnd.line.bus import LONGEST_OPENING_S, LONGEST_REOPEN_S, Bus
from ldcnd.line.exchange import Lane
from ldcnd.line.line import LATE_S, Phase
from ldcnd.line.transport import Transport
from tests.support import toy_family as toy
from tests.support.bus_rig import SETTINGS, Rig, outcome, running
from tests.support.toy_family import ToyPoller


def on_time(bus: Bus) -> bool:
    return bus.on_time(asyncio.get_running_loop().time())


async def test_idle_line_turns():
    rig = Rig()

    async with running(rig):
        await asyncio.sleep(3600)

        assert on_time(rig.bus)


async def test_line_with_rare_polls_turns_all_the_time():
    rig = Rig()

    async with running(rig):
        rig.bus.add_poller(ToyPoller(1, 60.0, asyncio.get_running_loop().time()))
        for _ in range(600):
            await asyncio.sleep(0.5)

            assert on_time(rig.bus)


async def test_mute_drives_do_not_stop_a_bus():
    rig = Rig(toy.all_but(1, toy.PROBE_NODE))

    async with running(rig):
        rig.bus.add_poller(ToyPoller(1, 0.01, asyncio.get_running_loop().time()))
        for _ in range(1000):
            await asyncio.sleep(0.01)

            assert on_time(rig.bus)


async def test_long_wait_for_a_reply_is_part_of_the_plan():
    rig = Rig(toy.all_but(1))

    async with running(rig) as callers:
        callers.create_task(outcome(rig.bus.execute(toy.exchange(1, response_s=30.0, repeatable=False))), name="slow")
        await asyncio.sleep(20)

        assert on_time(rig.bus)


async def test_line_that_waits_without_a_deadline_does_not_turn():
    rig = Rig(toy.all_but(1))

    async with running(rig) as callers:
        call = callers.create_task(outcome(rig.bus.execute(toy.exchange(1))), name="call")
        await asyncio.sleep(0)
        line = rig.bus._line
        assert line
        assert line.phase is Phase.REPLY
        line._watchdog.cancel()

        assert not on_time(rig.bus)
        call.cancel()


async def test_line_that_lets_a_poll_pass_does_not_turn():
    rig = Rig()

    async with running(rig):
        now_s = asyncio.get_running_loop().time()
        rig.bus._schedule.polls.schedule(ToyPoller(1, 1.0, now_s), now_s)  # and nobody told the line

        assert on_time(rig.bus)
        await asyncio.sleep(LATE_S + 0.1)

        assert not on_time(rig.bus)


async def test_line_that_rests_while_a_stop_waits_does_not_turn():
    rig = Rig()

    async with running(rig) as callers:
        line = rig.bus._line
        assert line
        line.kick = lambda: None  # type: ignore[method-assign]
        stop = callers.create_task(outcome(rig.bus.execute(toy.exchange(1), Lane.STOP)), name="stop")
        await asyncio.sleep(0)

        assert not on_time(rig.bus)
        stop.cancel()


async def test_port_that_never_opens_is_tried_again_and_again():
    async def refuse() -> Transport:
        raise TransportLost("no such device")

    bus = Bus(SETTINGS, refuse)
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name="bus")
        for _ in range(1000):
            await asyncio.sleep(1)

            assert on_time(bus)
        owner.cancel()


async def test_opening_that_hangs_does_not_turn():
    async def hang() -> Transport:
        await asyncio.get_running_loop().create_future()
        raise AssertionError

    bus = Bus(SETTINGS, hang)
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name="bus")
        await asyncio.sleep(LONGEST_OPENING_S)
        assert on_time(bus)

        await asyncio.sleep(LONGEST_REOPEN_S + 0.1)

        assert not on_time(bus)
        owner.cancel()
