"""In a flood, stops join one that is under way, unless something may have begun to move since."""

import asyncio
import json
from dataclasses import dataclass, field
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from ldcnd.axis.stopping import OwnStop
from ldcnd.contract.commands import Stop
from ldcnd.contract.errors import InternalError
from ldcnd.contract.keys import Keys
from ldcnd.daemon.requests import STOPS_AT_ONCE, Requests
from ldcnd.net.hand_over import Answer, Query
from tests.support.axis_bench import put, tracked
from tests.support.session_pair import error_of

KEYS = Keys("bench1")


@dataclass
class SlowRig:
    """A rig whose stops are confirmed when the test says so."""

    name: str = "bench1"
    confirmed: asyncio.Event = field(default_factory=asyncio.Event)
    stops: int = 0
    fails: bool = False
    wire_log: Mock = field(default_factory=Mock)
    not_kept: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        axis = SimpleNamespace(
            tracker=tracked(),
            stops=SimpleNamespace(possible=True, latch_is_kept=False),
            config=SimpleNamespace(name="x"),
        )
        self.axes, self.not_kept = {"x": axis}, {}
        self.buses = (SimpleNamespace(bus=SimpleNamespace(wire_log=self.wire_log), axes=tuple(self.axes.values())),)

    def reset(self) -> None:
        put(self.axes["x"].tracker, stop_latched=False)

    def count(self, stops: int) -> None:
        put(self.axes["x"].tracker, stops=stops)

    async def stop(self, names: tuple[str, ...]) -> dict[str, OwnStop]:
        self.stops += 1
        own = {name: OwnStop(confirmed=True, count=self.stops) for name in names}
        self.count(self.stops)
        await asyncio.sleep(0)
        await self.confirmed.wait()
        if self.fails:
            raise ValueError("a bug")
        return own


class Flood:
    """Sends stops to one daemon's requests and keeps the answers, and what is entered into the events."""

    def __init__(self, rig: SlowRig, group: asyncio.TaskGroup) -> None:
        self.answers: list[Answer] = []
        self.dispatcher = Mock()
        self._requests = Requests(rig, KEYS, group, self.dispatcher)

    def stop(self, times: int = 1) -> None:
        for _ in range(times):
            self._requests.on_stop(Query(KEYS.stop("x"), {}, b"", "", self.answers.extend))


async def settled() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


async def test_a_few_stops_are_all_sent():
    rig = SlowRig()
    async with asyncio.TaskGroup() as group:
        flood = Flood(rig, group)
        flood.stop(STOPS_AT_ONCE)
        await settled()
        rig.confirmed.set()

    assert rig.stops == len(flood.answers) == STOPS_AT_ONCE


async def test_many_stops_are_sent_a_few_times_and_each_is_answered():
    rig = SlowRig()
    async with asyncio.TaskGroup() as group:
        flood = Flood(rig, group)
        flood.stop(200)
        await settled()
        rig.confirmed.set()

    assert rig.stops == STOPS_AT_ONCE
    assert len(flood.answers) == 200
    assert {b'"confirmed":["x"]' in answer.payload for answer in flood.answers} == {True}


async def test_a_stop_that_has_joined_names_the_stops_of_before_it_and_none_that_came_while_it_was_waited_for():
    rig = SlowRig()
    async with asyncio.TaskGroup() as group:
        flood = Flood(rig, group)
        flood.stop(STOPS_AT_ONCE)
        await settled()
        rig.count(20)
        flood.stop()
        await settled()
        rig.count(30)
        rig.confirmed.set()

    told = [json.loads(answer.payload)["stops"]["x"] for answer in flood.answers]
    assert sorted(told) == [*range(1, STOPS_AT_ONCE + 1), 20]


async def test_a_stop_after_a_reset_is_sent_although_others_are_under_way():
    rig = SlowRig()
    async with asyncio.TaskGroup() as group:
        flood = Flood(rig, group)
        flood.stop(50)
        await settled()
        rig.reset()
        flood.stop()
        await settled()
        sent = rig.stops
        rig.confirmed.set()

    assert sent == STOPS_AT_ONCE + 1
    assert rig.axes["x"].tracker.status.stop_latched


async def test_a_stop_that_has_joined_is_sent_after_all_when_a_reset_takes_its_latch():
    rig = SlowRig()
    async with asyncio.TaskGroup() as group:
        flood = Flood(rig, group)
        flood.stop(STOPS_AT_ONCE + 1)
        await settled()
        rig.reset()
        rig.confirmed.set()

    assert rig.stops == STOPS_AT_ONCE + 1
    assert rig.axes["x"].tracker.status.stop_latched


@pytest.mark.long
async def test_a_stop_whose_companion_fails_is_told_so():
    rig = SlowRig(fails=True)
    async with asyncio.TaskGroup() as group:
        flood = Flood(rig, group)
        flood.stop(STOPS_AT_ONCE + 1)
        await settled()
        rig.confirmed.set()

    codes = [error_of([answer]).code for answer in flood.answers]
    assert codes == [InternalError.code] * (STOPS_AT_ONCE + 1)


@pytest.mark.parametrize("times", [1, 100])
async def test_stops_that_come_after_a_flood_are_sent_again(times: int):
    rig = SlowRig()
    rig.confirmed.set()
    async with asyncio.TaskGroup() as group:
        flood = Flood(rig, group)
        flood.stop(times)
        await settled()
        sent = rig.stops
        flood.stop()

    assert rig.stops == sent + 1


async def test_who_has_stopped_is_entered_once_the_drives_have_confirmed_it():
    rig = SlowRig()
    async with asyncio.TaskGroup() as group:
        flood = Flood(rig, group)
        flood.stop()
        await settled()
        sent, entered = rig.stops, flood.dispatcher.stopped.call_count
        rig.confirmed.set()

    assert (sent, entered) == (1, 0)
    flood.dispatcher.stopped.assert_called_once_with(("x",), ("x",), Stop(), None)


@pytest.mark.long
async def test_a_stop_that_cannot_be_recorded_is_sent_all_the_same():
    rig = SlowRig()
    rig.wire_log.add.side_effect = OSError("no room")
    async with asyncio.TaskGroup() as group:
        flood = Flood(rig, group)
        flood.dispatcher.stopped.side_effect = ValueError("a bug")
        flood.stop()
        await settled()
        rig.confirmed.set()

    assert rig.stops == flood.dispatcher.stopped.call_count == 1
    assert b'"confirmed":["x"]' in flood.answers[0].payload
    assert not flood.answers[0].is_error
