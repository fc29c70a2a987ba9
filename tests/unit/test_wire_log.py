import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldcnd.contract.errors import MalformedRequest
from ldcnd.line.flight_recorder import (
    BLOCK,
    RECORD_BYTES,
    WireEvent,
    WireLog,
    WireRecord,
    _Block,
    parse_record,
    parse_records,
)


def test_records_come_oldest_first():
    log = WireLog()

    log.add(1.0, WireEvent.SENT, b"\xaa")
    log.add(2.0, WireEvent.RECEIVED, b"\x00", "fine")

    assert log.records() == [
        WireRecord(1.0, WireEvent.SENT, b"\xaa"),
        WireRecord(2.0, WireEvent.RECEIVED, b"\x00", "fine"),
    ]


def test_the_last_seconds_are_kept_however_many_packets_they_have():
    log = WireLog(kept_s=10.0)

    for number in range(5000):
        log.add(number / 100, WireEvent.SENT, bytes([number % 256]))

    assert [record.at_s for record in log.records()] == [number / 100 for number in range(3999, 5000)]


def test_memory_is_bounded_also_when_little_time_has_passed():
    log = WireLog(kept_s=1e6, kept_bytes=10 * RECORD_BYTES)

    for number in range(50):
        log.add(0.0, WireEvent.SENT, bytes([number]))
    few = [record.data[0] for record in log.records()]
    log.add(0.0, WireEvent.STRAY, bytes(100 * RECORD_BYTES))

    assert few == list(range(41, 50))
    assert [record.event for record in log.records()] == [WireEvent.STRAY]


def test_a_record_reads_as_one_line():
    assert str(WireRecord(1.5, WireEvent.SENT, b"\xaa\x01")) == "1.500000000 sent     aa 01"
    assert str(WireRecord(2.0, WireEvent.TIMEOUT, b"", "node 3")) == "2.000000000 timeout   # node 3"
    assert str(WireRecord(0.0, WireEvent.OPENED)) == "0.000000000 opened"


def test_what_was_dropped_is_still_counted():
    log = WireLog(kept_s=0.5)

    for number in range(5):
        log.add(float(number), WireEvent.SENT)

    assert (log.added, len(log.records())) == (5, 1)


@given(
    at_ns=st.integers(0, 10**16),
    event=st.sampled_from(sorted(set(WireEvent) - {WireEvent.COMMAND})),
    data=st.binary(max_size=40),
    note=st.text(max_size=40),
)
def test_a_line_of_text_loads_back(at_ns, event, data, note):
    """To the nanosecond for any uptime: 10 ** 16 ns are 115 days, where a float has steps of 2 ns."""
    record = WireRecord(at_ns / 1e9, event, data, " ".join(note.split()))

    line = str(WireRecord(at_ns / 1e9, event, data, note))

    assert line.splitlines() == [line]
    assert parse_record(line) == record


def test_a_command_loads_back_whatever_is_in_its_text():
    record = WireRecord(1.0, WireEvent.COMMAND, b'x/move_absolute {"position": 1.5, "client": "a # b  c"}')

    line = str(record)

    assert line == '1.000000000 command  x/move_absolute {"position": 1.5, "client": "a # b  c"}'
    assert parse_record(line) == record


def test_comments_and_empty_lines_are_skipped():
    records = parse_records(["# ldcnd wire log", "", "1.000000 opened", "#   in words", "2.5 sent aa 00"])

    assert records == (WireRecord(1.0, WireEvent.OPENED), WireRecord(2.5, WireEvent.SENT, b"\xaa\x00"))


@pytest.mark.parametrize("line", ["x sent aa", "1.0 whispered aa", "1.0 sent a", "1.0", "1.0 sent zz", "x command y"])
def test_what_is_no_record_is_refused_with_the_line(line):
    with pytest.raises(MalformedRequest) as refused:
        parse_record(line)

    assert repr(line) in refused.value.message


@given(
    steps=st.lists(st.tuples(st.floats(0.0, 0.05), st.binary(max_size=4), st.sampled_from(["", "poll"])), max_size=600),
    kept_s=st.sampled_from([0.5, 3.0, 1e6]),
    since_s=st.floats(0.0, 12.0),
    skipped=st.integers(0, 600),
)
def test_packed_records_are_those_that_were_added(steps, kept_s, since_s, skipped):
    log, added, at_s = WireLog(kept_s=kept_s), [], 0.0

    for after_s, data, note in steps:
        at_s += after_s
        log.add(at_s, WireEvent.RECEIVED, data, note)
        added.append(WireRecord(at_s, WireEvent.RECEIVED, data, note))
    kept = [record for record in added if record.at_s >= at_s - kept_s]

    entries = log.entries()
    assert log.records() == kept
    assert len(entries) == len(kept)
    assert log.added == len(added)
    assert entries.first_since(since_s) == len([record for record in kept if record.at_s < since_s])
    assert [WireRecord(*entry) for entry in entries.behind(skipped)] == kept[skipped:]


def test_a_page_of_a_long_log_is_found_without_unpacking_what_is_before_it(monkeypatch):
    log = WireLog(kept_s=1e6)
    for number in range(100 * BLOCK):
        log.add(float(number), WireEvent.SENT, b"\x01")
    unpacked = []
    monkeypatch.setattr(_Block, "__iter__", lambda block: (unpacked.append(block), iter([(block.times_s[0],)]))[1])

    entries = log.entries()
    skipped = entries.first_since(50.5 * BLOCK)

    assert skipped == 50.5 * BLOCK
    assert not unpacked
    assert next(entries.behind(51 * BLOCK)) == (51.0 * BLOCK,)
    assert len(unpacked) == 1


def test_what_was_taken_from_a_log_stays_as_it_was():
    log = WireLog(kept_s=2.0)
    log.add(0.0, WireEvent.SENT, b"\x01")
    taken = log.entries()

    for number in range(3 * BLOCK):
        log.add(float(number), WireEvent.SENT)

    assert list(taken) == [(0.0, WireEvent.SENT, b"\x01", "")]


def test_packed_records_are_dropped_when_they_take_too_much_memory():
    log = WireLog(kept_s=1e6, kept_bytes=4 * BLOCK * RECORD_BYTES)

    for number in range(20 * BLOCK):
        log.add(float(number), WireEvent.SENT)

    assert 3 * BLOCK <= len(log.records()) <= 4 * BLOCK
    assert log.records()[-1].at_s == 20 * BLOCK - 1
    assert log.added == 20 * BLOCK


def test_a_record_takes_as_much_memory_as_is_said():
    log = WireLog()
    requests = [bytes([0xAA, address, 0x13, 0x4D, 0x60 + address]) for address in range(4)]
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for number in range(40 * BLOCK):
            log.add(number / 100, WireEvent.SENT, requests[number % 4], " at once")
        taken = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()

    assert 0.75 < taken / (40 * BLOCK * (RECORD_BYTES + 5)) <= 1.0
