import asyncio

import pytest

from ldcnd.line.exchange import Exchange, Timing
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.line.line import Phase
from tests.support import toy_family as toy
from tests.support.line_bench import MARGIN_S, REPLY_S, REQUEST_S, Bench, RecordingTransaction, settle
from tests.support.scripted_line import Say


def pending_timers() -> list[asyncio.TimerHandle]:
    return [timer for timer in asyncio.get_running_loop()._scheduled if not timer.cancelled()]


async def test_one_exchange_is_outstanding():
    bench = Bench()

    bench.add(1)
    bench.add(2)

    assert bench.wire.packets() == [toy.request(1, 1)]
    await settle()
    assert bench.wire.packets() == [toy.request(1, 1), toy.request(1, 2)]
    assert bench.sent(2) == pytest.approx([REQUEST_S + 0.0001 + REPLY_S])


async def test_the_next_request_is_written_before_the_last_reply_is_delivered():
    bench = Bench()
    seen: list[int] = []
    first = bench.add(1)
    bench.add(2)
    first.completed = lambda _reply, _timing: seen.append(len(bench.wire.writes))  # type: ignore[method-assign]

    await settle()

    assert seen == [2]


async def test_a_reply_in_pieces_is_one_reply():
    bench = Bench()
    bench.wire.bytewise = True

    bench.add(1)
    bench.add(2)
    await settle()

    assert bench.story == ["completed 1", "completed 2"]
    assert bench.statistics.resynchronisations == 0


@pytest.mark.parametrize("bytewise", [True, False])
@pytest.mark.parametrize("repeatable", [True, False])
@pytest.mark.parametrize("paced", [True, False])
async def test_any_whole_reply_shows_that_its_node_answers(*, bytewise: bool, repeatable: bool, paced: bool):
    bench = Bench(paced=paced)
    bench.wire.bytewise = bytewise
    bench.schedule.mute.missed(1)

    bench.add(1, repeatable=repeatable)
    await settle()

    assert (bench.story, bench.schedule.mute.failing()) == (["completed 1"], set())


async def test_timing_brackets_the_reply():
    bench = Bench()
    bench.replies({1: [Say(toy.reply(1), after_s=0.0005)]})

    turn = bench.add(1)
    await settle()

    assert turn.timing == Timing(
        pytest.approx(0.0),
        pytest.approx(REQUEST_S),
        pytest.approx(REQUEST_S + 0.0005),
        pytest.approx(REQUEST_S + 0.0005 + REPLY_S),
    )


async def test_a_mute_node_is_given_its_time_and_no_more():
    bench = Bench()
    bench.replies({1: []})

    bench.add(1)
    await settle(REQUEST_S + toy.RESPONSE_S + REPLY_S + MARGIN_S - 1e-6)
    assert bench.story == []
    await settle(2e-6)

    assert (bench.story, bench.schedule.mute.failing()) == (["lost 1"], {1})
    assert bench.statistics.timeouts == 1


async def test_a_far_end_without_pace_may_answer_at_once():
    bench = Bench(paced=False)
    bench.replies({1: [Say(toy.reply(1), after_s=-REQUEST_S)]})

    bench.add(1)
    await settle()

    assert bench.story == ["completed 1"]


async def test_a_foreign_reply_is_skipped():
    bench = Bench()
    bench.replies({1: [Say(toy.reply(9, kind=toy.FOREIGN)), Say(toy.reply(1), after_s=0.0002 + REPLY_S)]})

    bench.add(1)
    await settle()

    assert bench.story == ["completed 1"]
    assert bench.statistics.resynchronisations == 0


async def test_an_early_foreign_reply_does_not_spoil_the_right_one():
    bench = Bench()
    foreign = toy.reply(9, kind=toy.FOREIGN)
    bench.replies(
        {1: [Say(foreign[:4], -0.0005), Say(foreign[4:], -0.0001), Say(toy.reply(1), after_s=0.0005)]},
    )

    bench.add(1)
    await settle()

    assert bench.story == ["completed 1"]


async def test_a_rejected_packet_is_sent_again_at_once_without_a_quarantine():
    bench = Bench()
    bench.replies({1: [Say(toy.reply(1, kind=toy.REJECTED))]})

    turn = bench.add(1)
    turn.send_again = 1
    await settle()

    assert bench.story == ["rejected 1", "completed 1"]
    assert bench.sent(1) == pytest.approx([0.0, REQUEST_S + 0.0001 + REPLY_S])
    assert bench.statistics.resynchronisations == 0


async def test_a_reply_may_tell_its_own_length():
    bench = Bench()
    details = toy.exchange(1, reply_bytes=40)
    own_length = Exchange(
        node=1,
        request=details.request,
        reply_bytes=40,
        check=toy.check,
        decode=toy.decode,
        response_s=toy.RESPONSE_S,
        repeatable=True,
        total_bytes=lambda data: toy.REPLY_BYTES if len(data) > 2 else None,
    )
    bench.wire.bytewise = True
    bench.replies({1: [Say(toy.reply(1))]})

    bench.queue(RecordingTransaction(own_length, bench.story))
    await settle()

    assert bench.story == ["completed 1"]


async def test_an_exchange_without_a_reply_keeps_the_line_quiet():
    bench = Bench()

    bench.add(1, reply_bytes=0, response_s=0.002)
    bench.add(2)
    await settle()

    assert bench.sent(2) == pytest.approx([REQUEST_S + 0.002])
    assert bench.story == ["completed 1", "completed 2"]


async def test_the_rate_changes_before_the_next_request():
    bench = Bench()

    bench.add(1, then_baud=19_200)
    bench.add(2)
    await settle()

    assert bench.wire.history == [
        f"write {toy.request(1, 1).hex()}",
        "baud 19200",
        f"write {toy.request(1, 2).hex()}",
    ]
    assert bench.line.baud == 19_200
    assert bench.story == ["completed 1", "completed 2"]
    assert [record.note for record in bench.log.records() if record.event is WireEvent.BAUD] == ["19200"]


async def test_a_lost_reply_changes_no_rate():
    bench = Bench()
    bench.replies({1: []})

    bench.add(1, then_baud=19_200)
    await settle()

    assert bench.line.baud == 115_200


async def test_an_exchange_at_another_rate_leaves_the_line_at_its_own():
    bench = Bench()

    bench.add(1, at_baud=19_200)
    bench.add(2)
    await settle()

    assert bench.wire.history == [
        "baud 19200",
        f"write {toy.request(1, 1).hex()}",
        "baud 115200",
        f"write {toy.request(1, 2).hex()}",
    ]
    assert bench.sent(2) == pytest.approx([6 * (REQUEST_S + REPLY_S) + 0.0001])
    assert bench.story == ["completed 1", "completed 2"]


async def test_the_quarantine_of_an_exchange_at_another_rate_is_at_the_lines_own():
    bench = Bench()
    bench.replies({1: []})

    bench.add(1, at_baud=19_200)
    bench.add(2)
    await settle()

    assert bench.wire.history[:4] == [
        "baud 19200",
        f"write {toy.request(1, 1).hex()}",
        "baud 115200",
        f"write {toy.FLUSH.hex()}",
    ]
    assert bench.story == ["lost 1", "completed 2"]
    assert bench.line.baud == 115_200


async def test_a_port_that_is_lost_on_its_way_to_another_rate_loses_the_turn():
    bench = Bench()
    bench.wire.set_baud = lambda _baud: bench.wire.write(b"")  # type: ignore[method-assign]
    bench.wire.fails_to_write = True

    bench.add(1, at_baud=19_200)

    assert bench.story == ["lost 1", "line lost: the port is gone"]


async def test_a_port_that_is_lost_on_its_way_back_is_one_loss():
    bench = Bench()
    bench.replies({1: []})
    bench.add(1, at_baud=19_200)
    bench.wire.set_baud = lambda _baud: bench.wire.write(b"")  # type: ignore[method-assign]
    bench.wire.fails_to_write = True

    await settle()

    assert bench.story == ["lost 1", "line lost: the port is gone"]
    assert bench.line.phase is Phase.CLOSED


async def test_a_lost_port_ends_the_turn_then_the_line_once():
    bench = Bench()

    bench.add(1)
    bench.wire.lose("unplugged")
    bench.line.transport_lost("unplugged")
    bench.line.close("the bus was closed")
    bench.line.kick()

    assert bench.story == ["lost 1", "line lost: unplugged"]
    assert bench.statistics.losses == 1
    assert bench.line.phase is Phase.CLOSED


async def test_a_write_that_fails_is_one_loss_even_if_the_port_tells_it_again():
    bench = Bench()
    bench.wire.fails_to_write = True

    bench.add(1)
    bench.wire.lose("unplugged")

    assert bench.story == ["lost 1", "line lost: the port is gone"]
    assert bench.statistics.losses == 1
    assert [record.event for record in bench.log.records()].count(WireEvent.LOST) == 1


async def test_a_rate_that_fails_is_a_loss_and_the_reply_still_counts():
    bench = Bench()
    bench.wire.set_baud = lambda _baud: bench.wire.write(b"")  # type: ignore[method-assign]

    bench.add(1, then_baud=9600)
    bench.wire.fails_to_write = True
    await settle()

    assert bench.story == ["line lost: the port is gone", "completed 1"]


@pytest.mark.parametrize("after_s", [0.0, REQUEST_S, 0.01, 0.0145, 0.5])
async def test_a_closed_line_leaves_no_timer(after_s: float):
    bench = Bench()
    bench.replies({1: []})
    bench.add(1)
    await settle(after_s)

    bench.line.close("the bus was closed")
    await bench.wire.close()

    assert pending_timers() == []


async def test_an_exchange_costs_no_timer():
    bench = Bench()
    made: list[float] = []
    loop = asyncio.get_running_loop()
    real = loop.call_at
    bench.line._watchdog._loop = _Counting(real, made)  # type: ignore[assignment]

    for number in range(1, 501):
        bench.add(number)
        await settle(0.0014)

    assert bench.statistics.replies > 450
    assert len(made) < 120


class _Counting:
    """A loop that counts the timers the watchdog makes."""

    def __init__(self, call_at, made: list[float]):
        self._call_at = call_at
        self._made = made
        self.time = asyncio.get_running_loop().time

    def call_at(self, when, callback, *args):
        self._made.append(when)
        return self._call_at(when, callback, *args)


async def test_nothing_is_noted_or_counted_before_the_next_request_is_written():
    bench = Bench()
    bench.add(1)
    bench.add(2)
    seen: list[tuple[int, int]] = []
    write = bench.wire.write

    def watched(data: bytes) -> None:
        seen.append((bench.statistics.replies, len(bench.log.records())))
        write(data)

    bench.wire.write = watched  # type: ignore[method-assign]
    await settle()

    assert seen == [(0, 1)]  # the first request alone
    events = [record.event for record in bench.log.records()]
    assert events == [WireEvent.SENT, WireEvent.RECEIVED, WireEvent.SENT, WireEvent.RECEIVED]


async def test_a_whole_reply_is_one_wake_up():
    bench = Bench()
    bench.wire.bytewise = bench.wire.holds_back = True

    bench.add(1)
    assert bench.wire.expected == toy.REPLY_BYTES
    await settle()

    assert bench.story == ["completed 1"]
    assert [record.event for record in bench.log.records()] == [WireEvent.SENT, WireEvent.RECEIVED]
    assert bench.wire.expected == 1  # on an idle line every byte is news


@pytest.mark.parametrize("settings", [{"repeatable": False}, {"reply_bytes": 0}, {"then_baud": 57_600}])
async def test_every_byte_is_news_to_an_exchange_that_is_more_than_its_reply(settings):
    bench = Bench()

    bench.add(1, **settings)

    assert bench.wire.expected == 1


async def test_every_byte_is_news_behind_an_echo():
    bench = Bench(echo=True)

    bench.add(1)

    assert bench.wire.expected == 1


async def test_a_short_reply_that_was_held_back_is_seen_when_the_time_is_over():
    bench = Bench()
    bench.wire.holds_back = True
    bench.replies({1: [Say(toy.reply(1)[:-2])]})

    turn = bench.add(1)
    await settle()

    assert f"sent {toy.REPLY_BYTES - 2} of {toy.REPLY_BYTES} bytes in time" in str(turn.error)
    parts = [record.data for record in bench.log.records() if record.event is WireEvent.PART]
    assert parts == [toy.reply(1)[:-2]]


async def test_stray_bytes_are_seen_on_a_line_that_has_come_to_rest():
    bench = Bench()
    bench.wire.holds_back = True
    bench.add(1)
    await settle()

    bench.wire.say(b"\xf0")

    assert bench.line.phase is Phase.QUARANTINE
    assert bench.statistics.stray_bytes == 1
    assert [record.event for record in bench.log.records()][-2:] == [WireEvent.STRAY, WireEvent.RESYNC]


async def test_what_takes_long_behind_a_request_is_begun_once_the_request_is_on_its_way():
    bench = Bench()
    story: list[str] = []
    bench.wire.pushes = True
    bench.wire.push = lambda: story.append("push")  # type: ignore[method-assign]

    bench.add(1)
    second = bench.add(2, slow_to_deliver=True)
    second.completed = lambda _reply, _timing: story.append("completed 2")  # type: ignore[method-assign]
    bench.add(3)
    await settle()

    assert story == ["push", "completed 2"]


async def test_behind_much_work_the_line_is_woken_for_the_byte_before_the_last_one():
    byte_s = REPLY_S / toy.REPLY_BYTES
    reply_over_s = REQUEST_S + 0.0001 + REPLY_S
    bench = Bench()
    bench.wire.bytewise = bench.wire.holds_back = True

    bench.add(1, slow_to_deliver=True)
    bench.add(2)
    assert bench.wire.expected == toy.REPLY_BYTES  # nothing is done meanwhile
    await settle(reply_over_s + byte_s / 2)
    assert bench.wire.expected == toy.REPLY_BYTES - 1
    await settle(reply_over_s - byte_s)
    assert bench.wire.expected == 1
    await settle()

    assert bench.story == ["completed 1", "completed 2"]
    events = [record.event for record in bench.log.records()]
    assert events == [WireEvent.SENT, WireEvent.RECEIVED, WireEvent.SENT, WireEvent.PART, WireEvent.RECEIVED]
    assert bench.statistics.bytes_in == 2 * toy.REPLY_BYTES


async def test_the_next_request_is_written_first_also_behind_a_reply_in_pieces():
    bench = Bench()
    bench.wire.bytewise = True
    bench.add(1)
    bench.add(2)
    seen: list[int] = []
    write = bench.wire.write

    def watched(data: bytes) -> None:
        seen.append(bench.statistics.replies)
        write(data)

    bench.wire.write = watched  # type: ignore[method-assign]
    await settle()

    assert seen == [0]
    assert bench.story == ["completed 1", "completed 2"]


async def test_an_early_piece_spoils_the_reply_also_when_the_rest_comes_in_time():
    bench = Bench()
    whole = toy.reply(1)
    bench.replies({1: [Say(whole[:2], after_s=-REQUEST_S), Say(whole[2:], after_s=0.0005)]})

    bench.add(1)
    await settle()

    assert bench.story == ["lost 1"]
