"""A bus against an unruly far end: whatever happens, each caller has one outcome, and it is its own."""

import asyncio
import random
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from ldcnd.contract.errors import BadReply, BusBusy, BusDown, BusError, OutcomeUnknown, PacketRejected, ReplyTimeout
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, Lane
from ldcnd.line.settings import BusSettings
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support import toy_family as toy
from tests.support.scripted_line import Say, ScriptedOpener

FIRST_NUMBER = 0x8000
"""Callers' numbers start here, a poller's below."""
NODES = 3
LATENCY_S = 0.0008
"""Below the settling time of the quarantine: what an adapter keeps longer, no quarantine can keep out."""
COALESCE_S = 0.02
"""Long enough for all polls of a burst to wait for each other."""
HEALED_S = 30.0


def whole(said: Say) -> list[Say]:
    return [said]


def dropped(_says: Say) -> list[Say]:
    return []


def late(said: Say) -> list[Say]:
    return [replace(said, after_s=0.008)]


def later(said: Say) -> list[Say]:
    return [replace(said, after_s=0.0118)]


def kept_by_the_adapter(said: Say) -> list[Say]:
    return [replace(said, latency_s=LATENCY_S)]


def doubled(said: Say) -> list[Say]:
    again_s = said.after_s + len(said.data) * 10 / 115_200 + 0.0002
    return [said, replace(said, after_s=again_s, unbidden=True)]


def damaged(said: Say) -> list[Say]:
    return [replace(said, data=said.data[:-1] + bytes([said.data[-1] ^ 0x10]))]


def cut(said: Say) -> list[Say]:
    return [replace(said, data=said.data[:-3])]


def with_surplus(said: Say) -> list[Say]:
    return [replace(said, data=said.data + b"\xf0")]


def rejected(said: Say) -> list[Say]:
    return [replace(said, data=toy.reply(number_in(said.data), len(said.data), toy.REJECTED))]


def after_a_foreign_one(said: Say) -> list[Say]:
    foreign = Say(toy.reply(1, len(said.data), toy.FOREIGN))
    return [foreign, replace(said, after_s=0.0002 + len(said.data) * 10 / 115_200)]


def without_sense(said: Say) -> list[Say]:
    return [replace(said, data=toy.reply(number_in(said.data), len(said.data), toy.NONSENSE))]


def number_in(reply: bytes) -> int:
    return int.from_bytes(reply[1:3], "big")


Fault = Callable[[Say], list[Say]]
FAULTS: list[Fault] = [
    whole,
    dropped,
    late,
    later,
    kept_by_the_adapter,
    doubled,
    damaged,
    cut,
    with_surplus,
    rejected,
    after_a_foreign_one,
    without_sense,
]


class WatchfulPoller(toy.ToyPoller):
    """Notes replies that answer another request than the one they were delivered for."""

    def __init__(self, node: int, due_at_s: float, reply_bytes: int) -> None:
        super().__init__(node, 0.02, due_at_s)
        self.slow_to_deliver = True
        self.reply_bytes = reply_bytes
        self.miscredited: list[tuple[int, int]] = []
        self.removed = False
        self.asked_after_removal = False

    def next_exchange(self, now_s: float) -> Exchange[int]:
        self.asked_after_removal |= self.removed
        asked = toy.number_of(super().next_exchange(now_s).request)
        exchange = toy.exchange(asked, self.node, reply_bytes=self.reply_bytes)

        def decode(data: bytes) -> int:
            number = toy.decode(data)
            if number != asked:
                self.miscredited.append((asked, number))
            return number

        return replace(exchange, decode=decode)


class UnrulyLine(RuleBasedStateMachine):
    """Callers, pollers and faults in any order.

    Attributes:
        line: what the bus knows of it.
    """

    line = BusSettings("toy", 115_200)

    @initialize(bytewise=st.booleans(), holds_back=st.booleans(), coalesces=st.booleans())
    def start(self, *, bytewise: bool, holds_back: bool, coalesces: bool) -> None:
        self.bytewise, self.holds_back = bytewise, holds_back
        self.settings = replace(self.line, coalesce_s=COALESCE_S if coalesces else 0.0)
        self.runner = asyncio.Runner(loop_factory=JumpingLoop)
        self.faults: deque[Fault] = deque()
        self.fault_of: dict[int, Fault] = {}  # for the first reply to a caller; `faults` spoil the others
        self.mute: set[int] = set()
        self.rejections: Counter[int] = Counter()
        self.writes: Counter[int] = Counter()
        self.stops: set[int] = set()
        self.exchanges: dict[int, Exchange[int]] = {}
        self.tasks: dict[int, asyncio.Task[int]] = {}
        self.outcomes: Counter[int] = Counter()
        self.sent_for_nobody: list[int] = []
        self.pollers: list[WatchfulPoller] = []
        self.runner.run(self._open())

    async def _open(self) -> None:
        self.opener = ScriptedOpener(self._answer)
        self.bus = Bus(self.settings, self.opener, toy.RESYNC)
        # the owner lives across many runs of the loop, so no group of one run can hold it
        self.owner = asyncio.get_running_loop().create_task(self.bus.run(), name="bus")
        await self.bus.wait_opened()
        self.opener.line.bytewise, self.opener.line.holds_back = self.bytewise, self.holds_back

    def _answer(self, packet: bytes) -> list[Say]:
        if packet == toy.FLUSH:
            return []
        number = toy.number_of(packet)
        self.writes[number] += 1
        if number in self.tasks and self.tasks[number].done():
            self.sent_for_nobody.append(number)
        says = [] if toy.node_of(packet) in self.mute else toy.answer(packet)
        fault = self.fault_of.pop(number, None) or (self.faults.popleft() if self.faults else whole)
        if not says:
            return []
        if fault is rejected:
            self.rejections[number] += 1
        return fault(says[0])

    # -- what may happen ---------------------------------------------------------------------------------------------

    @rule(count=st.integers(1, 8), seed=st.integers(0, 2**16), wait_for_port=st.booleans())
    def call(self, count: int, seed: int, *, wait_for_port: bool) -> None:
        # drawn from a seed: single draws repeat themselves so much that few faults would meet
        chosen = random.Random(seed * 1000 + len(self.exchanges))
        if wait_for_port:
            self.runner.run(self.bus.wait_opened())
        for _ in range(count):
            self._call(chosen, chosen.choice([Lane.COMMAND, Lane.COMMAND, Lane.STOP, Lane.BACKGROUND]))
        self.runner.run(asyncio.sleep(0))

    def _call(self, chosen: random.Random, lane: Lane) -> None:
        number = FIRST_NUMBER + len(self.exchanges)
        self.exchanges[number] = exchange = toy.exchange(
            number,
            node=chosen.randint(1, NODES),
            repeatable=chosen.random() < 0.5,
            reply_bytes=chosen.choice([toy.REPLY_BYTES, toy.REPLY_BYTES, toy.REPLY_BYTES, 5, 12, 0]),
        )
        self.fault_of[number] = chosen.choice([*FAULTS, whole, whole, whole, doubled, with_surplus])
        if lane is Lane.STOP:
            self.stops.add(number)
        task = self.runner.get_loop().create_task(self.bus.execute(exchange, lane), name=f"caller {number}")
        task.add_done_callback(partial(self._count, number))
        self.tasks[number] = task

    def _count(self, number: int, _task: asyncio.Task[int]) -> None:
        self.outcomes[number] += 1

    @rule(faults=st.lists(st.sampled_from(FAULTS), min_size=2, max_size=8))
    def break_replies(self, faults: list[Fault]) -> None:
        self.faults.extend(faults)

    @rule(node=st.integers(1, NODES))
    def switch_node(self, node: int) -> None:
        self.mute ^= {node}

    @rule(milliseconds=st.sampled_from([0.0, 0.1, 0.3, 0.7, 1.0, 1.6, 3.0, 5.0, 7.0, 12.0, 50.0, 400.0]))
    def wait(self, milliseconds: float) -> None:
        self.runner.run(asyncio.sleep(milliseconds / 1000))

    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        pending = [number for number, task in self.tasks.items() if not task.done()]
        if pending:
            self.tasks[data.draw(st.sampled_from(pending))].cancel()

    @rule(node=st.integers(1, NODES))
    def withdraw(self, node: int) -> None:
        self.bus.withdraw(node, BusDown("withdrawn"))

    @rule(count=st.integers(1, 12))
    def babble(self, count: int) -> None:
        self.opener.line.say(b"\xf0" * count)

    @rule(seed=st.integers(0, 2**16))
    def distrust(self, seed: int) -> None:
        # what reads something that cannot be stops its axis
        self.bus.distrust()
        self._call(random.Random(seed * 1000 + len(self.exchanges)), Lane.STOP)
        self.runner.run(asyncio.sleep(0))

    @rule(node=st.integers(1, NODES))
    def poll(self, node: int) -> None:
        if self.bus.is_open and len(self.pollers) < 9:
            poller = WatchfulPoller(node, self.runner.get_loop().time(), toy.REPLY_BYTES)
            self.pollers.append(poller)
            self.bus.add_poller(poller)

    @rule(data=st.data())
    def stop_polling(self, data: st.DataObject) -> None:
        if self.pollers:
            poller = data.draw(st.sampled_from(self.pollers))
            self.bus.remove_poller(poller)
            poller.removed = True

    @rule(refuses=st.booleans(), in_earnest=st.sampled_from([False, False, False, True]))
    def break_the_port(self, *, refuses: bool, in_earnest: bool) -> None:
        if not in_earnest:
            return
        if refuses:
            self.opener.line.fails_to_write = True
        else:
            self.opener.line.lose()

    # -- what must hold ----------------------------------------------------------------------------------------------

    @invariant()
    def every_value_is_its_own(self) -> None:
        for number, task in getattr(self, "tasks", {}).items():
            if task.done() and not task.cancelled() and not task.exception():
                assert task.result() == number
        for poller in getattr(self, "pollers", []):
            assert poller.miscredited == []

    @invariant()
    def nothing_is_sent_for_nobody(self) -> None:
        assert getattr(self, "sent_for_nobody", []) == []
        assert not any(poller.asked_after_removal for poller in getattr(self, "pollers", []))

    @invariant()
    def nothing_is_sent_too_often(self) -> None:
        for number, exchange in getattr(self, "exchanges", {}).items():
            allowed = 3 if exchange.repeatable else 1 + self.rejections[number]
            assert self.writes[number] <= min(3, allowed)

    @invariant()
    def every_error_is_one_of_the_promised(self) -> None:
        for number, task in getattr(self, "tasks", {}).items():
            if not task.done() or task.cancelled():
                continue
            error = task.exception()
            if error is None:
                continue
            assert isinstance(error, BusError)
            assert type(error) in {OutcomeUnknown, ReplyTimeout, PacketRejected, BadReply, BusDown, BusBusy}
            if isinstance(error, BusBusy):
                assert self.writes[number] == 0
            if isinstance(error, OutcomeUnknown):
                assert not self.exchanges[number].repeatable
                assert self.writes[number] >= 1 or self._port_refused_a_write()

    def _port_refused_a_write(self) -> bool:
        return any("refused" in line.history for line in self.opener.lines)

    def teardown(self) -> None:
        if not hasattr(self, "runner"):
            return
        try:
            self.runner.run(self._heal())
            self.every_value_is_its_own()
            self.nothing_is_sent_for_nobody()
            self.nothing_is_sent_too_often()
            self.every_error_is_one_of_the_promised()
            assert all(self.outcomes[number] == 1 for number in self.tasks)
            for poller in self.pollers:
                outcomes = len(poller.delivered) + len(poller.errors)
                assert outcomes == len(poller.asked_at_s)
                assert poller.timings == sorted(poller.timings, key=lambda timing: timing.sent_at_s)
        finally:
            self.runner.close()

    async def _heal(self) -> None:
        """Mend the far end: everyone gets an outcome, a fresh exchange works, nothing is left behind."""
        await asyncio.sleep(1.0)  # what still waits meets its faults
        self.faults.clear()
        self.fault_of.clear()
        self.mute.clear()
        self.opener.line.fails_to_write = False
        await self.bus.wait_opened()
        await asyncio.sleep(HEALED_S)
        assert all(task.done() for task in self.tasks.values())
        for poller in self.pollers:
            self.bus.remove_poller(poller)
        await asyncio.sleep(0.1)
        assert await self.bus.execute(toy.exchange(7)) == 7
        self.owner.cancel()
        await asyncio.wait([self.owner], timeout=1.0)
        assert self.owner.cancelled()
        assert asyncio.all_tasks() == {asyncio.current_task()}
        assert not [timer for timer in asyncio.get_running_loop()._scheduled if not timer.cancelled()]


@pytest.mark.long
def test_every_caller_of_an_unruly_line_has_one_outcome_and_it_is_its_own():
    run_state_machine_as_test(
        UnrulyLine,
        settings=settings(max_examples=25, stateful_step_count=40, deadline=None, derandomize=True, database=None),
    )
