"""The line itself, with modules that know no protocol."""

import pytest

from ldcnd.line.exchange import NEVER_S
from ldcnd.sim.chain import Chain, Delivery, Module, ModuleReply, received_at

HOST_BYTE_S = 10 / 19_200


class Parrot(Module):
    """Answers every byte with a fixed text, a while later."""

    def __init__(self, answer=b"", delay_s=0.001, *, baud=19_200.0, lets_hear=True, yields=True):
        self.baud = baud
        self.address_out = lets_hear
        self.yields_to_host = yields
        self.answer = answer
        self.delay_s = delay_s
        self.heard = []

    def hear(self, value, at_s):
        self.heard.append((at_s, value))
        if self.answer:
            self.next_event_s = at_s + self.delay_s

    def advance(self, to_s):
        at_s, self.next_event_s = self.next_event_s, NEVER_S
        return ModuleReply(self.answer, at_s, 10 / self.baud)


def test_bytes_take_ten_bit_times_and_queue_behind_each_other():
    module = Parrot()
    chain = Chain([module])

    chain.write(1.0, b"ab")
    chain.write(1.0, b"c")
    chain.advance(2.0)

    assert [value for _, value in module.heard] == list(b"abc")
    assert [at_s for at_s, _ in module.heard] == pytest.approx([1 + n * HOST_BYTE_S for n in (1, 2, 3)])


def test_byte_is_not_heard_before_its_stop_bit():
    module = Parrot()
    chain = Chain([module])

    chain.write(0.0, b"a")
    chain.advance(0.99 * HOST_BYTE_S)

    assert module.heard == []


def test_reply_arrives_whole_at_its_last_bit():
    chain = Chain([Parrot(b"xyz", baud=19_531.25)])

    chain.write(0.0, b"a")
    pieces = chain.advance(1.0)

    assert [data for _, data in pieces] == [b"xyz"]
    assert pieces[0][0] == pytest.approx(HOST_BYTE_S + 0.001 + 30 / 19_531.25)


def test_reply_arrives_byte_by_byte_where_the_port_delivers_so():
    chain = Chain([Parrot(b"xyz")], delivery=Delivery.BYTEWISE)

    chain.write(0.0, b"a")
    pieces = chain.advance(1.0)

    assert [data for _, data in pieces] == [b"x", b"y", b"z"]
    start_s = HOST_BYTE_S + 0.001
    assert [at_s for at_s, _ in pieces] == pytest.approx([start_s + n * HOST_BYTE_S for n in (1, 2, 3)])


@pytest.mark.parametrize("delivery", list(Delivery))
def test_walking_from_event_to_event_gives_the_same_as_one_leap(delivery):
    leaping = Chain([Parrot(b"xyz")], delivery=delivery)
    walking = Chain([Parrot(b"xyz")], delivery=delivery)
    leaping.write(0.0, b"a")
    walking.write(0.0, b"a")

    walked = []
    while (at_s := walking.next_event_s()) is not None:
        walked += walking.advance(at_s)

    assert walked == leaping.advance(1.0)


def test_module_is_deaf_until_the_one_before_lets_it_hear():
    first, second, third = Parrot(lets_hear=False), Parrot(lets_hear=False), Parrot()
    chain = Chain([first, second, third])

    chain.write(0.0, b"a")
    chain.advance(0.1)
    first.address_out = True
    chain.write(0.1, b"b")
    chain.advance(0.2)

    assert [value for _, value in first.heard] == list(b"ab")
    assert [value for _, value in second.heard] == list(b"b")
    assert third.heard == []


def test_host_byte_ends_a_running_reply_after_its_complete_bytes():
    chain = Chain([Parrot(b"0123456789", delay_s=0.0)])
    chain.write(0.0, b"a")
    chain.advance(HOST_BYTE_S)

    chain.modules[0].answer = b""
    chain.write(3.5 * HOST_BYTE_S, b"b")  # complete at 4.5 byte times, 3.5 after the reply began
    pieces = chain.advance(1.0)

    assert b"".join(data for _, data in pieces) == b"012"


def test_module_that_does_not_listen_while_sending_finishes_its_reply():
    chain = Chain([Parrot(b"0123456789", delay_s=0.0, yields=False)])
    chain.write(0.0, b"a")
    chain.advance(HOST_BYTE_S)

    chain.modules[0].answer = b""
    chain.write(3.5 * HOST_BYTE_S, b"b")
    pieces = chain.advance(1.0)

    assert b"".join(data for _, data in pieces) == b"0123456789"


def test_overlapping_replies_spoil_each_other():
    chain = Chain([Parrot(b"AAAA"), Parrot(b"BBBB", delay_s=0.001 + 2.5 * HOST_BYTE_S)])

    chain.write(0.0, b"a")
    received = b"".join(data for _, data in chain.advance(1.0))

    assert received[:2] == b"AA"
    assert received[2:4] not in {b"AA", b"BB"}
    assert len(received) == 6  # 4 framed bytes, then what of the later reply the host can frame


def test_replies_one_after_the_other_are_intact():
    chain = Chain([Parrot(b"AA"), Parrot(b"BB", delay_s=0.001 + 2.5 * HOST_BYTE_S)])

    chain.write(0.0, b"a")

    assert [data for _, data in chain.advance(1.0)] == [b"AA", b"BB"]


def test_wrong_rate_is_a_framing_error_for_each_module_on_its_own():
    slow, fast = Parrot(), Parrot(baud=113_636.0)
    chain = Chain([slow, fast])
    chain.baud = 115_200

    chain.write(0.0, b"a")
    chain.advance(0.1)

    assert [value for _, value in slow.heard] == [None]
    assert [value for _, value in fast.heard] == [ord("a")]


@pytest.mark.parametrize(
    ("answer", "baud", "heard"),
    [
        (b"\x39\x39", 115_200, "e00000e00000"),  # six of its bits to one of the module's: 1 and 0 run together
        (b"\x39\x39", 38_400, "8698f8f8"),
        (b"\x39\x39", 9600, "ad"),  # half of its bits; the second byte is over before the stop bit of the first
        (b"\xff\xff", 1200, ""),  # both start bits are over too soon
    ],
)
def test_reply_at_another_rate_is_what_a_port_samples(answer, baud, heard):
    chain = Chain([Parrot(answer, delay_s=0.01)])
    chain.write(0.0, b"a")
    chain.advance(2 * HOST_BYTE_S)

    chain.baud = baud

    assert b"".join(data for _, data in chain.advance(1.0)).hex() == heard


def test_a_rate_that_is_a_little_off_is_received_and_one_that_is_off_by_a_bit_in_a_byte_is_not():
    text = bytes(range(256))

    assert [received_at(text, ratio) == text for ratio in (0.93, 0.96, 1.0, 1.04, 1.08)] == [
        False,
        True,
        True,
        True,
        False,
    ]


def test_without_baud_check_any_rate_is_understood():
    module = Parrot()
    chain = Chain([module], baud_check=False)
    chain.baud = 115_200

    chain.write(0.0, b"a")
    chain.advance(0.1)

    assert module.heard == [(pytest.approx(HOST_BYTE_S), ord("a"))]


def test_discarding_drops_what_has_arrived_and_nothing_else():
    chain = Chain([Parrot(b"0123", delay_s=0.0)])
    chain.write(0.0, b"a")
    chain.advance(3.5 * HOST_BYTE_S)

    chain.discard(3.5 * HOST_BYTE_S)

    assert b"".join(data for _, data in chain.advance(1.0)) == b"23"


def test_unplugging_loses_what_is_on_the_wires_and_tells_the_line_once():
    chain = Chain([Parrot(b"0123")])
    reasons = []
    chain.on_loss = reasons.append
    chain.write(0.0, b"a")

    chain.unplug(0.0)
    chain.write(0.0, b"b")

    assert len(reasons) == 1
    assert not chain.plugged(1e9)
    assert chain.advance(1.0) == []


def test_wire_time_counts_both_lines():
    chain = Chain([Parrot(b"xyz")])

    chain.write(0.0, b"a")
    chain.advance(1.0)

    assert chain.wire_busy_s == pytest.approx(4 * HOST_BYTE_S)
