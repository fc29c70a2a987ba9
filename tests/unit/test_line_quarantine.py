from dataclasses import replace

import pytest

from ldcnd.line.exchange import Lane, Resync
from ldcnd.line.line import LONGEST_QUARANTINE, Phase
from tests.support import toy_family as toy
from tests.support.line_bench import BYTE_S, FENCE_S, MARGIN_S, REPLY_S, REQUEST_S, Bench, settle
from tests.support.scripted_line import Say

BAD_REPLIES = {
    "surplus": [Say(toy.reply(1) + b"\x00")],
    "damaged": [Say(toy.reply(1)[:-1] + b"\x00")],
    "cut": [Say(toy.reply(1)[:-3])],
    "doubled at once": [Say(toy.reply(1) * 2)],
    "too early": [Say(toy.reply(1), after_s=-0.0005)],
    "begun too early": [Say(toy.reply(7)[:3], after_s=-0.0004), Say(toy.reply(1)[:5], after_s=0.0005)],
}


@pytest.mark.parametrize("says", BAD_REPLIES.values(), ids=BAD_REPLIES.keys())
async def test_a_reply_that_cannot_be_trusted_loses_the_turn_and_puts_the_line_in_quarantine(says: list[Say]):
    bench = Bench()
    bench.replies({1: says})

    first = bench.add(1)
    bench.add(2)
    await settle()

    assert bench.story == ["lost 1", "completed 2"]
    assert first.error
    assert bench.wire.history == [
        f"write {toy.request(1, 1).hex()}",
        f"write {toy.FLUSH.hex()}",
        "discard",
        f"write {toy.request(toy.PROBE_NODE, toy.PROBE_NUMBER, toy.PROBE_BYTES).hex()}",
        f"write {toy.request(1, 2).hex()}",
    ]
    assert bench.statistics.resynchronisations == 1


async def test_the_quarantine_is_quiet_flush_settle_probe():
    bench = Bench()
    bench.replies({1: []})

    bench.add(1)
    bench.add(2)
    await settle()

    lost_s = REQUEST_S + toy.RESPONSE_S + REPLY_S + MARGIN_S
    flush_s, probe_s, second_s = (written.at_s for written in bench.wire.writes[1:])
    assert flush_s == pytest.approx(lost_s + toy.RESYNC.quiet_s)
    assert probe_s == pytest.approx(lost_s + FENCE_S)
    assert second_s == pytest.approx(probe_s + REQUEST_S + 0.0001 + toy.PROBE_BYTES * BYTE_S)


async def test_a_reply_begun_too_early_is_spoilt_even_if_its_sum_is_right():
    begun = toy.reply(7)[:3]
    bench = Bench()
    rest = bytes(4)
    late = Say(rest + bytes([sum(begun + rest) & 0xFF]), after_s=0.0005)
    bench.replies({1: [Say(begun, after_s=-0.0004), late]})

    bench.add(1)
    await settle()

    assert bench.story == ["lost 1"]
    assert bench.statistics.corrupt_replies == 1


async def test_a_reply_after_the_time_out_is_credited_to_nobody():
    bench = Bench()
    bench.replies({1: [Say(toy.reply(1), after_s=0.008, unbidden=True)]})

    bench.add(1)
    bench.add(2)
    await settle()

    assert bench.story == ["lost 1", "completed 2"]
    assert bench.statistics.stray_bytes == toy.REPLY_BYTES


async def test_a_doubled_reply_is_credited_to_nobody():
    bench = Bench()
    bench.replies({1: [Say(toy.reply(1)), Say(toy.reply(1), after_s=0.0001 + 1.5 * REPLY_S, unbidden=True)]})

    bench.add(1)
    bench.add(2)
    bench.add(3)
    await settle()

    assert bench.story == ["completed 1", "lost 2", "completed 3"]


async def test_stray_bytes_on_an_idle_line_quarantine_it():
    bench = Bench()

    bench.wire.say(b"\x55")
    bench.add(1)
    await settle()

    assert bench.story == ["completed 1"]
    assert bench.wire.packets()[:2] == [toy.FLUSH, toy.request(toy.PROBE_NODE, toy.PROBE_NUMBER, toy.PROBE_BYTES)]
    assert bench.sent(1)[0] > FENCE_S


async def test_bytes_in_the_quarantine_make_it_wait_for_silence():
    bench = Bench()

    bench.wire.say(b"\x55")
    await settle(0.004)
    bench.wire.say(b"\x55")
    await settle(0.004)
    bench.wire.say(b"\x55")
    await settle()

    assert bench.wire.writes[0].at_s == pytest.approx(0.008 + toy.RESYNC.quiet_s)


async def test_a_line_that_is_never_silent_is_flushed_all_the_same():
    bench = Bench()

    for _ in range(200):
        bench.wire.say(b"\x55")
        await settle(0.001)

    assert bench.wire.packets()[0] == toy.FLUSH
    assert bench.wire.writes[0].at_s <= LONGEST_QUARANTINE * toy.RESYNC.quiet_s + 0.001


async def test_a_stop_shortens_the_quarantine_to_flush_and_settle():
    bench = Bench()
    bench.wire.say(b"\x55")
    await settle(0.001)

    bench.add(1)
    bench.add(2, Lane.STOP).send_again = 1
    bench.wire.say(b"\x55")
    await settle()

    assert bench.wire.packets()[:2] == [toy.FLUSH, toy.request(1, 2)]
    assert bench.sent(2)[0] == pytest.approx(0.001 + len(toy.FLUSH) * BYTE_S + toy.RESYNC.settle_s)
    assert bench.story == ["lost 2", "completed 2", "completed 1"]


@pytest.mark.parametrize("late_s", [0.0005 * count for count in range(30)])
async def test_a_late_reply_to_an_older_packet_does_not_confirm_a_stop(late_s: float):
    """The stop is lost, and the reply to the command before it comes at any instant."""
    bench = Bench()
    bench.replies({1: [Say(toy.reply(1), after_s=late_s, unbidden=True)], 2: []})

    bench.add(1)
    await settle(0.001)
    bench.add(2, Lane.STOP).send_again = 9
    await settle()

    assert bench.story[-1] == "completed 2"
    assert bench.wire.packets()[-1] == toy.request(1, 2)
    assert len(bench.sent(2)) >= 2


async def test_a_stop_that_comes_while_another_one_waits_for_its_proof_goes_first():
    bench = Bench()
    bench.wire.say(b"\x55")
    await settle(0.001)
    bench.add(1, Lane.STOP).send_again = 1
    await settle(bench.sent(1)[0] - 0.001 + REQUEST_S + REPLY_S + 0.001 if bench.sent(1) else 0.004)
    bench.add(2, Lane.STOP).send_again = 1
    await settle()

    first, second, *_ = (each for each in bench.wire.packets() if each != toy.FLUSH)
    assert (first, second) == (toy.request(1, 1), toy.request(1, 2))
    assert bench.story == ["lost 1", "lost 2", "completed 1", "completed 2"]


async def test_after_a_stop_the_line_is_proven_before_anything_else():
    bench = Bench()
    bench.wire.say(b"\x55")

    bench.add(1)
    bench.add(2, Lane.STOP).send_again = 1
    await settle()

    probe, stop = toy.request(toy.PROBE_NODE, toy.PROBE_NUMBER, toy.PROBE_BYTES), toy.request(1, 2)
    assert bench.wire.packets() == [toy.FLUSH, stop, toy.FLUSH, probe, stop, toy.request(1, 1)]


async def test_a_stop_that_is_sent_again_waits_for_no_silence():
    bench = Bench()
    bench.replies({1: []})

    turn = bench.add(1, Lane.STOP)
    turn.send_again = 1
    await settle()

    first_s, second_s = bench.sent(1)
    lost_s = first_s + REQUEST_S + toy.RESPONSE_S + REPLY_S + MARGIN_S
    assert second_s == pytest.approx(lost_s + len(toy.FLUSH) * BYTE_S + toy.RESYNC.settle_s)


ONE_NODE = replace(toy.RESYNC, probe=lambda _avoid: toy.probe(set()))
"""A line with no other node to ask."""


async def test_a_probe_that_fails_is_repeated_three_times_at_most():
    bench = Bench(resync=ONE_NODE)
    bench.wire.script = toy.all_but(toy.PROBE_NODE)

    bench.wire.say(b"\x55")
    bench.add(1)
    await settle()

    assert len(bench.sent(toy.PROBE_NUMBER)) == 3
    assert bench.story == ["completed 1"]


async def test_a_late_reply_does_not_pass_for_the_probes():
    bench = Bench(resync=ONE_NODE)
    bench.replies({toy.PROBE_NUMBER: [Say(toy.reply(1, toy.PROBE_BYTES))]})

    bench.wire.say(b"\x55")
    bench.add(1)
    await settle()

    assert len(bench.sent(toy.PROBE_NUMBER)) == 2
    assert bench.story == ["completed 1"]


async def test_the_probe_is_told_which_nodes_fail():
    asked: list[set[int]] = []
    bench = Bench(resync=Resync(probe=lambda avoid: asked.append(set(avoid))))
    bench.schedule.mute.missed(4)

    bench.wire.say(b"\x55")
    await settle()

    assert asked == [{4}]
    assert bench.line.phase is Phase.IDLE
