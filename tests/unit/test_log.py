import io
import logging
import os
from pathlib import Path

import pytest
import structlog

from ldcnd.log import LogLimit, PrefixedLines, configure_logging, get_logger, is_journal
from ldcnd.printable import is_printable


def test_stream_is_the_journal_only_when_the_numbers_agree(tmp_path: Path):
    with (tmp_path / "stream").open("w") as stream:
        status = os.fstat(stream.fileno())

        assert is_journal(stream, {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"})
        assert not is_journal(stream, {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino + 1}"})
        assert not is_journal(stream, {})
    assert not is_journal(io.StringIO(), {"JOURNAL_STREAM": "1:2"})


def test_every_line_of_a_record_carries_its_priority():
    record = logging.makeLogRecord({"msg": "line lost\nTraceback", "levelno": logging.WARNING})

    assert PrefixedLines().format(record) == "<4>line lost\n<4>Traceback"


def test_journal_entries_have_text_priority_and_fields(tmp_path: Path, monkeypatch, caplog):
    with (tmp_path / "journal").open("w") as journal:
        status = os.fstat(journal.fileno())
        monkeypatch.setattr("sys.stderr", journal)
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        monkeypatch.setitem(__import__("sys").modules, "logging_journald", None)  # as if it were not installed
        records: list[logging.LogRecord] = []
        try:
            configure_logging(level="info")
            keeper = logging.Handler()
            keeper.emit = records.append  # type: ignore[method-assign]
            logging.getLogger().addHandler(keeper)

            get_logger("test").warning("reply lost", bus="line0", axis="x", command_id="a-1", code="bus_down", name="n")
            get_logger("test").debug("not wanted")
        finally:
            logging.getLogger().handlers.clear()
            structlog.reset_defaults()

    text = (tmp_path / "journal").read_text()
    assert text == "<4>reply lost bus=line0 axis=x command_id=a-1 code=bus_down name=n\n"
    (record,) = records
    assert (record.bus, record.axis, record.command_id, record.code) == ("line0", "x", "a-1", "bus_down")
    assert record.name == "ldcnd.test"
    assert record.name_ == "n"


@pytest.mark.parametrize("json", [False, True])
def test_what_strangers_send_is_logged_as_escapes(*, json: bool, monkeypatch: pytest.MonkeyPatch):
    said = io.StringIO()
    monkeypatch.setattr("sys.stderr", said)
    try:
        configure_logging(json=json)
        get_logger("test").info("refused", key="ldcn/sim/@cmd/\x1b[2J/\u202efly\nforged line")
    finally:
        logging.getLogger().handlers.clear()
        structlog.reset_defaults()

    text = said.getvalue()
    assert text.count("\n") == 1
    assert is_printable(text.rstrip("\n"))
    assert "\\x1b[2J" in text.replace("\\\\", "\\")


def test_records_that_anyone_can_cause_are_limited_and_those_held_back_are_counted():
    now_s = 0.0
    limit = LogLimit(count=2, period_s=10, now_s=lambda: now_s)

    admitted = [limit.admit() for _ in range(5)]
    now_s = 10.0

    assert admitted == [{}, {}, None, None, None]
    assert limit.admit() == {"held_back": 3}
    assert limit.admit() == {}
