import contextlib
import resource
from collections.abc import Iterator

import pytest
from structlog.testing import capture_logs

from ldcnd.daemon.capture import CaptureStore
from ldcnd.line.capture import Capture, parse_capture
from ldcnd.line.flight_recorder import WireEvent, WireRecord
from tests.unit.test_capture import HEADER, RECORDS


def capture(number: int, records=RECORDS) -> Capture:
    """Return captures that were made one second after another."""
    return Capture(HEADER.model_copy(update={"until_s": 100.0 + number, "cause": "x over_current"}), records)


def test_a_capture_is_written_whole_and_named_for_time_line_and_cause(tmp_path):
    path = CaptureStore(tmp_path / "new", 5, 10**6).write(capture(1))

    assert path.parent == tmp_path / "new"
    assert path.name == "20231114T221500.000000Z-line0-x-over-current.capture"
    assert parse_capture(path.read_text(encoding="utf-8")) == capture(1)


def test_the_oldest_are_thrown_away_when_there_are_too_many(tmp_path):
    store = CaptureStore(tmp_path, 3, 10**6)

    written = [store.write(capture(number)) for number in range(5)]

    assert sorted(tmp_path.iterdir()) == written[2:]


def test_disk_space_is_bounded_but_the_newest_stays(tmp_path):
    burst = (WireRecord(1.0, WireEvent.STRAY, bytes(5000)),)
    store = CaptureStore(tmp_path, 100, 40_000)

    written = [store.write(capture(number, burst)) for number in range(4)]
    kept = sorted(tmp_path.iterdir())
    alone = CaptureStore(tmp_path, 100, 10).write(capture(9))

    assert kept == written[2:]
    assert list(tmp_path.iterdir()) == [alone]


def test_other_files_are_left_alone_and_unfinished_ones_cleared_away(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "old.part").write_text("cut short")

    CaptureStore(tmp_path, 1, 1).write(capture(1))

    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".capture", ".txt"]


def test_a_disk_that_takes_nothing_is_told_and_harms_nothing(tmp_path):
    (tmp_path / "file").write_text("not a directory")

    with capture_logs() as told:
        assert CaptureStore(tmp_path / "file", 3, 10**6).write(capture(1)) is None

    assert [line["event"] for line in told] == ["capture not written"]


def test_the_log_says_where_the_file_is(tmp_path):
    with capture_logs() as told:
        path = CaptureStore(tmp_path, 3, 10**6).write(capture(1))

    assert [(line["event"], line["file"]) for line in told] == [("capture written", str(path))]


@contextlib.contextmanager
def files_end_at(size: int) -> Iterator[None]:
    """Let no file grow beyond a size, as on a disk that is nearly full: what fits is written, then nothing."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_a_disk_that_fills_up_meanwhile_leaves_no_part_of_a_capture(tmp_path, share):
    whole = CaptureStore(tmp_path / "whole", 3, 10**6).write(capture(1))
    store = CaptureStore(tmp_path / "full", 3, 10**6)

    with capture_logs() as told, files_end_at(int(share * whole.stat().st_size)):
        written = store.write(capture(1))

    assert written is None
    assert [line["event"] for line in told] == ["capture not written"]
    assert list((tmp_path / "full").iterdir()) == []
