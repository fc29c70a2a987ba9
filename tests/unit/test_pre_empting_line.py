import pytest

from ldcnd.bus.exchange_queue import Lane
from ldcnd.bus.line_phase import Phase
from ldcnd.bus.pre_empting_line import AHEAD, NOT_BELIEVED, PreEmptingLine
from ldcnd.bus.settings import HOST_LATE_S, WORTH_S
from ldcnd.bus.wire_log import WireEvent
from tests.support import toy_family as toy
from tests.support.line_bench import BYTE_S, MARGIN_S, REPLY_S, REQUEST_S, Bench, settle
from tests.support.scripted_line import Say

LONG_BYTES = 80
LONG_S = LONG_BYTES * BYTE_S
EXECUTED_S = REQUEST_S + toy.RESPONSE_S + HOST_LATE_S
"""From a request to the instant at which it has surely been executed."""
POLL, STOP, OTHER_STOP, COMMAND = 1, 2, 3, 4


class PreEmptingBench(Bench):
    make_line = PreEmptingLine


def polled(says: list[Say] | None = None) -> PreEmptingBench:
    """Return a line that waits for the reply to a poll, which is long unless it is given."""
    bench = PreEmptingBench()
    if says is not None:
        bench.replies({POLL: says})
    bench.add(POLL, Lane.POLL, reply_bytes=LONG_BYTES)
    return bench


async def test_a_stop_goes_ahead_of_the_reply_to_a_poll_and_again_behind_the_fence():
    bench = polled()
    bench.add(STOP, Lane.STOP)
    await settle()

    ahead_s, again_s = bench.sent(STOP)
    assert ahead_s == pytest.approx(EXECUTED_S)
    no_reply_after_s = ahead_s + EXECUTED_S + REPLY_S + MARGIN_S
    assert again_s == pytest.approx(no_reply_after_s + len(toy.FLUSH) * BYTE_S + toy.RESYNC.settle_s)
    assert bench.users.story == ["taken back 1", "answered 1", "completed 2", "answered 99"]
    assert bench.statistics.taken_back == 1
    assert bench.statistics.timeouts == bench.statistics.corrupt_replies == bench.statistics.stray_bytes == 0


async def test_nothing_that_comes_back_behind_a_stop_that_went_ahead_is_believed():
    bench = polled()
    bench.add(STOP, Lane.STOP)
    await settle()

    story = [(record.event, record.note, record.data) for record in bench.log.records()]
    assert story[1:5] == [
        (WireEvent.SENT, AHEAD, toy.request(1, STOP)),
        (WireEvent.RECEIVED, NOT_BELIEVED, toy.reply(STOP)),
        (WireEvent.RECEIVED, NOT_BELIEVED, toy.reply(POLL, LONG_BYTES)),
        (WireEvent.RESYNC, "", b""),
    ]
    assert bench.story == ["taken back 1", "completed 2"]


async def test_a_stop_that_comes_in_the_middle_of_a_long_reply_goes_at_once():
    bench = polled()
    bench.wire.bytewise = True
    await settle(EXECUTED_S + WORTH_S)
    bench.add(STOP, Lane.STOP)
    await settle()

    assert bench.sent(STOP)[0] == pytest.approx(EXECUTED_S + WORTH_S)
    assert bench.story == ["taken back 1", "completed 2"]


async def test_what_a_module_sends_that_takes_nothing_back_is_credited_to_nobody():
    bench = polled([Say(toy.reply(POLL), after_s=EXECUTED_S, unbidden=True)])
    bench.add(OTHER_STOP, Lane.STOP)
    await settle()

    assert bench.story == ["taken back 1", "completed 3"]


async def test_a_short_rest_of_a_reply_is_waited_for():
    bench = polled([Say(toy.reply(POLL, LONG_BYTES), after_s=toy.RESPONSE_S)])
    await settle(REQUEST_S + toy.RESPONSE_S + LONG_S - WORTH_S + 0.0001)
    bench.add(STOP, Lane.STOP)
    await settle()

    assert bench.story == ["completed 1", "completed 2"]
    assert len(bench.sent(STOP)) == 1


async def test_the_reply_to_a_command_is_always_waited_for():
    bench = PreEmptingBench()
    bench.add(COMMAND, Lane.COMMAND, reply_bytes=LONG_BYTES)
    bench.add(STOP, Lane.STOP)
    await settle()

    assert bench.story == ["completed 4", "completed 2"]
    assert bench.statistics.taken_back == 0


async def test_every_stop_that_waits_goes_ahead_each_when_the_one_before_is_executed():
    bench = polled()
    bench.add(STOP, Lane.STOP)
    bench.add(OTHER_STOP, Lane.STOP)
    await settle()

    first_s, second_s = bench.sent(STOP)[0], bench.sent(OTHER_STOP)[0]
    assert first_s == pytest.approx(EXECUTED_S)
    assert second_s == pytest.approx(2 * EXECUTED_S)
    assert bench.story == ["taken back 1", "completed 2", "completed 3"]
    assert len(bench.sent(STOP)) == len(bench.sent(OTHER_STOP)) == 2


async def test_a_stop_that_comes_while_another_is_ahead_goes_as_soon_as_it_may():
    bench = polled()
    bench.add(STOP, Lane.STOP)
    await settle(2 * EXECUTED_S + 0.001)
    bench.add(OTHER_STOP, Lane.STOP)
    await settle()

    assert bench.sent(OTHER_STOP)[0] == pytest.approx(2 * EXECUTED_S + 0.001)
    assert bench.story == ["taken back 1", "completed 2", "completed 3"]


async def test_the_reply_counts_when_nobody_wants_to_stop_any_more():
    bench = polled()
    bench.add(STOP, Lane.STOP)
    bench.users.waiting.clear()
    await settle()

    assert bench.story == ["completed 1"]
    assert bench.sent(STOP) == []


async def test_a_reply_that_never_comes_is_still_missed_in_time_behind_a_stop_that_was_withdrawn():
    bench = polled([])
    bench.add(STOP, Lane.STOP)
    bench.users.waiting.clear()
    await settle()

    assert bench.statistics.timeouts == 1


async def test_a_stop_that_must_not_be_repeated_waits_for_the_reply():
    bench = polled()
    bench.add(STOP, Lane.STOP, repeatable=False)
    await settle()

    assert bench.story == ["completed 1", "completed 2"]
    assert len(bench.sent(STOP)) == 1


async def test_a_reply_that_is_there_already_counts():
    bench = PreEmptingBench()
    bench.add(POLL, Lane.POLL, reply_bytes=LONG_BYTES, response_s=0.02)
    bench.wire.expect(LONG_BYTES + 1)
    bench.wire.holds_back = True
    bench.add(STOP, Lane.STOP)
    await settle()

    assert bench.story == ["completed 1", "completed 2"]
    assert bench.statistics.taken_back == 0


async def test_behind_stops_that_went_ahead_the_line_is_proven_before_anything_else():
    bench = polled()
    bench.add(STOP, Lane.STOP)
    bench.add(COMMAND, Lane.COMMAND)
    await settle()

    probe = toy.request(toy.PROBE_NODE, toy.PROBE_NUMBER, toy.PROBE_BYTES)
    assert bench.wire.packets()[-2:] == [probe, toy.request(1, COMMAND)]
    assert bench.story == ["taken back 1", "completed 2", "completed 4"]


async def test_a_port_that_is_lost_with_a_stop_ahead_loses_the_line():
    bench = polled()
    bench.add(STOP, Lane.STOP)
    bench.wire.fails_to_write = True
    await settle()

    assert bench.story == ["taken back 1", "line lost: the port is gone"]
    assert bench.line.phase is Phase.CLOSED


async def test_without_the_option_a_stop_waits_for_the_reply():
    bench = Bench()
    bench.add(POLL, Lane.POLL, reply_bytes=LONG_BYTES)
    bench.add(STOP, Lane.STOP)
    await settle()

    assert bench.story == ["completed 1", "completed 2"]
    assert len(bench.sent(STOP)) == 1
