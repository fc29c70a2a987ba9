"""What a daemon does not know any more is said: from when on its log is whole."""

import json
import re

import pytest

from ldcnd.client.history import beginning
from ldcnd.daemon.ledger import KEPT_EVENTS
from tests.support.command_line import virtual_rig


@pytest.fixture
def rig(monkeypatch):
    with virtual_rig(monkeypatch) as found:
        found.wait(found.rig.until("x", lambda state: state.link == "up"))
        yield found


def rows(ran):
    return [json.loads(line) for line in ran.printed.splitlines() if line.startswith("{")]  # the daemon logs beside


LOST = re.compile(
    r"^events before (\S+) are not known: this daemon began then; a recorder keeps them: ldcnd record$", re.MULTILINE
)


def test_the_log_says_from_when_on_events_are_known_whatever_else_it_leaves_out(rig):
    for _ in range(4):
        rig.run("halt x")
    started = next(row for row in rows(rig.run("log --json")) if row["what"] == "started")["t"]

    shown = rig.run("log --since 2000-01-01 --kind command --count 2")
    told = rig.run("log --since 2000-01-01 --kind command --count 2 --json")

    assert LOST.search(shown.printed)
    assert "2 earlier rows are left out" in shown.printed
    assert LOST.search(told.errors)
    assert [row["known_from"] for row in rows(told)] == [started, started]


def test_the_log_says_nothing_of_what_was_before_the_time_that_is_asked_for(rig):
    rig.run("halt x")

    assert not LOST.search(rig.run("log --since 2999-01-01").printed)
    assert LOST.search(rig.run("log").printed)
    assert not LOST.search(rig.run("log --count 1").printed)


def test_the_log_says_that_the_oldest_events_of_the_daemon_were_discarded(rig):
    note = rig.rig.daemon.note_reload
    for number in range(KEPT_EVENTS + 7):
        note("x", f"change {number}")

    shown = rig.run("log --since 2000-01-01 --count 1000")
    known_from = rig.wait(beginning(rig.rig.client))

    assert "the 7 events before " in shown.printed
    assert known_from.discarded == 7
    assert rows(rig.run("log --count 1000 --json"))[-1]["known_from"] == known_from.t
