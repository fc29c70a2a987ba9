"""Seeded faults."""

import pytest

from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, LineFault

REQUEST = bytes(range(1, 9))


def injector(*faults, seed=1):
    return FaultInjector(FaultPlan(faults, seed))


def bits(data):
    return int.from_bytes(bytes(data), "big")


def test_no_fault_changes_nothing():
    dice = injector()

    assert dice.request(REQUEST, 0.0).values == tuple(REQUEST)
    assert dice.reply(REQUEST, 0.0).data == REQUEST


def test_lost_request_reaches_nobody():
    assert injector(LineFault(FaultKind.REQUEST_LOST)).request(REQUEST, 0.0).values == (None,) * 8


def test_one_byte_of_a_request_is_lost():
    values = injector(LineFault(FaultKind.REQUEST_BYTE_LOST)).request(REQUEST, 0.0).values

    assert values.count(None) == 1
    assert all(value in {None, sent} for value, sent in zip(values, REQUEST, strict=True))


def test_one_bit_of_a_request_flips():
    values = injector(LineFault(FaultKind.REQUEST_BIT_FLIPPED)).request(REQUEST, 0.0).values

    assert (bits(values) ^ bits(REQUEST)).bit_count() == 1


def test_lost_reply_is_empty():
    assert injector(LineFault(FaultKind.REPLY_LOST)).reply(REQUEST, 0.0).data == b""


def test_one_byte_of_a_reply_is_lost():
    data = injector(LineFault(FaultKind.REPLY_BYTE_LOST)).reply(REQUEST, 0.0).data

    assert any(data == REQUEST[:at] + REQUEST[at + 1 :] for at in range(8))


def test_one_bit_of_a_reply_flips():
    data = injector(LineFault(FaultKind.REPLY_BIT_FLIPPED)).reply(REQUEST, 0.0).data

    assert (bits(data) ^ bits(REQUEST)).bit_count() == 1


def test_delay_stays_within_its_bound():
    dice = injector(LineFault(FaultKind.REPLY_DELAYED, longest_s=0.1))

    delays = [dice.reply(REQUEST, 0.0).delay_s for _ in range(100)]

    assert 0.0 < min(delays) < max(delays) <= 0.1


def test_duplicated_reply_comes_twice():
    assert injector(LineFault(FaultKind.REPLY_DUPLICATED)).reply(REQUEST, 0.0).copies == 2


def test_unplugging_says_for_how_long():
    assert injector(LineFault(FaultKind.UNPLUGGED, longest_s=3.0)).request(REQUEST, 0.0).unplugged_s == 3.0


def test_fault_only_strikes_within_its_schedule():
    dice = injector(LineFault(FaultKind.REPLY_LOST, from_s=1.0, until_s=2.0))

    assert [bool(dice.reply(REQUEST, at_s).data) for at_s in (0.9, 1.0, 1.9, 2.0)] == [True, False, False, True]


def test_probability_is_the_share_of_packets_that_suffer():
    dice = injector(LineFault(FaultKind.REQUEST_LOST, probability=0.25))

    lost = sum(dice.request(REQUEST, 0.0).values[0] is None for _ in range(2000))

    assert lost / 2000 == pytest.approx(0.25, abs=0.03)


def test_same_seed_gives_the_same_faults_and_another_seed_others():
    fault = LineFault(FaultKind.REPLY_BIT_FLIPPED, probability=0.5)

    def play(seed):
        dice = injector(fault, seed=seed)
        return [dice.reply(REQUEST, 0.0).data for _ in range(50)]

    assert play(1) == play(1)
    assert play(1) != play(2)
