"""A reply to a packet that must not be repeated is believed only when no other reply can come any more."""

import pytest

from ldcnd.line.line import Phase
from ldcnd.line.settings import LINGER_S
from tests.support import toy_family as toy
from tests.support.line_bench import REPLY_S, REQUEST_S, Bench, settle
from tests.support.scripted_line import Say

EARLIEST_S = REQUEST_S + REPLY_S
LATEST_S = REQUEST_S + toy.RESPONSE_S + REPLY_S + LINGER_S


async def test_the_line_is_kept_quiet_until_no_other_reply_can_come():
    bench = Bench()

    bench.add(1, repeatable=False)
    bench.add(2)
    await settle(EARLIEST_S + 0.0002)
    assert (bench.line.phase, bench.story) == (Phase.LINGER, [])
    await settle()

    assert bench.story == ["completed 1", "completed 2"]
    assert bench.sent(2) == pytest.approx([LATEST_S])


async def test_a_second_reply_makes_the_first_one_worthless():
    bench = Bench()
    stale, own = Say(toy.reply(1), after_s=0.0), Say(toy.reply(1), after_s=REPLY_S + 0.0002)
    bench.replies({1: [stale, own]})

    bench.add(1, repeatable=False)
    await settle()

    assert bench.story == ["lost 1"]
    assert bench.statistics.corrupt_replies == 1


async def test_a_stale_refusal_does_not_send_it_again():
    bench = Bench()
    stale, own = Say(toy.reply(1, kind=toy.REJECTED), after_s=0.0), Say(toy.reply(1), after_s=REPLY_S + 0.0002)
    bench.replies({1: [stale, own]})

    bench.add(1, repeatable=False)
    await settle()

    assert bench.story == ["lost 1"]
    assert len(bench.sent(1)) == 1


async def test_what_may_be_repeated_is_believed_at_once():
    bench = Bench()

    bench.add(1)
    await settle(EARLIEST_S + 0.0002)

    assert bench.story == ["completed 1"]
