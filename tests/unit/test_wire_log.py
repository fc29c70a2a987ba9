import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldcnd.bus.wire_log import WireEvent, WireLog, WireRecord, parse_record, parse_records
from ldcnd.errors import MalformedRequest


def test_records_come_oldest_first():
    log = WireLog()

    log.add(1.0, WireEvent.SENT, b"\xaa")
    log.add(2.0, WireEvent.RECEIVED, b"\x00", "fine")

    assert log.records() == [
        WireRecord(1.0, WireEvent.SENT, b"\xaa"),
        WireRecord(2.0, WireEvent.RECEIVED, b"\x00", "fine"),
    ]


def test_a_full_log_drops_the_oldest():
    log = WireLog(records=3)

    for number in range(5):
        log.add(float(number), WireEvent.SENT, bytes([number]))

    assert [record.data for record in log.records()] == [b"\x02", b"\x03", b"\x04"]


def test_a_record_reads_as_one_line():
    assert str(WireRecord(1.5, WireEvent.SENT, b"\xaa\x01")) == "1.500000 sent     aa 01"
    assert str(WireRecord(2.0, WireEvent.TIMEOUT, b"", "node 3")) == "2.000000 timeout   # node 3"
    assert str(WireRecord(0.0, WireEvent.OPENED)) == "0.000000 opened"


def test_what_was_dropped_is_still_counted():
    log = WireLog(records=3)

    for number in range(5):
        log.add(float(number), WireEvent.SENT)

    assert log.added == 5


@given(
    at_us=st.integers(0, 10**12),
    event=st.sampled_from(WireEvent),
    data=st.binary(max_size=40),
    note=st.text(max_size=40),
)
def test_a_line_of_text_loads_back(at_us, event, data, note):
    record = WireRecord(at_us / 1e6, event, data, " ".join(note.split()))

    line = str(WireRecord(at_us / 1e6, event, data, note))

    assert line.splitlines() == [line]
    assert parse_record(line) == record


def test_comments_and_empty_lines_are_skipped():
    records = parse_records(["# ldcnd wire log", "", "1.000000 opened", "#   in words", "2.5 sent aa 00"])

    assert records == (WireRecord(1.0, WireEvent.OPENED), WireRecord(2.5, WireEvent.SENT, b"\xaa\x00"))


@pytest.mark.parametrize("line", ["x sent aa", "1.0 whispered aa", "1.0 sent a", "1.0", "1.0 sent zz"])
def test_what_is_no_record_is_refused_with_the_line(line):
    with pytest.raises(MalformedRequest) as refused:
        parse_record(line)

    assert repr(line) in refused.value.message
