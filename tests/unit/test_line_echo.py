import pytest

from ldcnd.line.exchange import Exchange
from tests.support import toy_family as toy
from tests.support.line_bench import REQUEST_S, Bench, RecordingTransaction, settle
from tests.support.scripted_line import Say


@pytest.mark.parametrize("bytewise", [False, True])
async def test_our_own_bytes_are_taken_off_by_count(*, bytewise: bool):
    bench = Bench(echo=True)
    bench.wire.bytewise = bytewise
    twin = toy.request(1, 1)
    same = Exchange(1, twin, len(twin), toy.check, len, 0.001, repeatable=True)
    bench.replies({1: [Say(twin)]})

    bench.queue(RecordingTransaction(same, bench.story))
    bench.add(2)
    await settle()

    assert bench.story == [f"completed {len(twin)}", "completed 2"]
    assert bench.statistics.resynchronisations == 0
    assert bench.statistics.stray_bytes == 0


async def test_an_echo_that_differs_is_a_collision():
    bench = Bench(echo=True)
    bench.wire.echo = False
    bench.replies({1: [Say(b"\x00" + toy.request(1, 1)[1:], after_s=-REQUEST_S), Say(toy.reply(1))]})

    bench.add(1)
    await settle()

    assert bench.story == ["lost 1"]


async def test_a_late_echo_of_a_packet_without_a_reply_is_still_our_own():
    bench = Bench(echo=True)
    bench.wire.echo = False
    quiet = toy.request(1, 1, 0)
    bench.replies(
        {
            1: [Say(quiet, after_s=-REQUEST_S, latency_s=0.0015, unbidden=True)],
            2: [Say(toy.request(1, 2), -REQUEST_S, 0.0006, unbidden=True), Say(toy.reply(2), latency_s=0.0006)],
        }
    )

    bench.add(1, reply_bytes=0, response_s=0.001)
    bench.add(2)
    await settle()

    assert bench.story == ["completed 1", "completed 2"]
    assert bench.statistics.stray_bytes == 0


async def test_an_echo_that_comes_after_the_time_out_counts_as_noise():
    bench = Bench(echo=True)
    bench.wire.echo = False
    bench.replies({1: [Say(toy.request(1, 1), -REQUEST_S, latency_s=0.009, unbidden=True)]})

    bench.add(1)
    await settle()

    assert bench.wire.packets()[1] == toy.FLUSH
    assert bench.wire.writes[1].at_s == pytest.approx(REQUEST_S + 0.009 + toy.RESYNC.quiet_s)


async def test_an_echoing_line_gets_back_in_step():
    bench = Bench(echo=True)
    bench.replies({1: [Say(toy.reply(1)[:-1] + b"\x00")]})

    bench.add(1)
    bench.add(2)
    await settle()

    assert bench.story == ["lost 1", "completed 2"]
    assert len(bench.sent(toy.PROBE_NUMBER)) == 1
