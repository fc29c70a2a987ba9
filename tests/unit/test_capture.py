import pytest

from ldcnd.contract.errors import MalformedRequest
from ldcnd.line.capture import CaptureHeader, capture_lines, parse_capture
from ldcnd.line.flight_recorder import WireEvent, WireRecord, parse_records

HEADER = CaptureHeader(
    version="0.1.0",
    bus="line0",
    family="ldcn",
    port="/dev/ttyUSB0",
    baud=115_200,
    instance="ab12",
    zero_ns=1_699_999_999_000_000_000,
    started_s=0.75,
    until_s=12.5,
    first_record=0,
    config={"rig": "sim", "bus": [{"name": "line0", "note": "a # b: c"}]},
)
RECORDS = (
    WireRecord(1.0, WireEvent.OPENED),
    WireRecord(1.000000001, WireEvent.SENT, b"\xaa\x01\x0e\x0f"),
    WireRecord(1.25, WireEvent.PART, b"\x08"),
    WireRecord(1.5, WireEvent.RECEIVED, b"\x08", "is damaged"),
    WireRecord(2.0, WireEvent.COMMAND, b'x/halt {"client": "me # you"}'),
)


def text(describe=lambda _record: "") -> str:
    return "\n".join(capture_lines(HEADER, RECORDS, describe))


def test_a_capture_loads_back_whole():
    capture = parse_capture(text())

    assert capture.header == HEADER
    assert capture.records == RECORDS


def test_words_are_comments_behind_their_packets_and_change_nothing():
    in_words = text(lambda record: "node 1: NO_OPERATION" if record.event is WireEvent.SENT else "")

    assert "\n1.000000001 sent     aa 01 0e 0f\n#   node 1: NO_OPERATION\n" in in_words
    assert parse_capture(in_words) == parse_capture(text())


def test_what_reads_wire_logs_reads_captures():
    assert parse_records(text().splitlines()) == RECORDS


@pytest.mark.parametrize(
    ("spoilt", "complaint"),
    [
        ("", "first line"),
        ("1.0 opened", "first line"),
        ("# ldcnd wire capture\n1.0 opened", "header"),
        ("# ldcnd wire capture\n# format: {", "header"),
        (text().replace("# format: 1", "# format: 2"), "header"),
        (text().replace("# port", "# harbour"), "header"),
        (text() + "\n1.0 whispered aa", "whispered"),
    ],
)
def test_what_is_no_capture_is_refused(spoilt, complaint):
    with pytest.raises(MalformedRequest, match=complaint):
        parse_capture(spoilt)
