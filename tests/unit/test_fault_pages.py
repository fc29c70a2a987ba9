"""Every code that an operator can meet has a page, and what the page says can be done."""

import re

import pytest
from click.testing import CliRunner

from ldcnd.axis.events import DriveLost
from ldcnd.axis.faults import OF_DAEMON
from ldcnd.cli.main import cli, main
from ldcnd.contract import errors
from ldcnd.contract.codec import error_reply
from ldcnd.contract.errors import DriveFault, ErrorCode, LdcndError
from ldcnd.contract.fault_pages import FOLDER, UNLISTED_ALARM, codes, page_of, page_text
from ldcnd.contract.samples import LinkState
from ldcnd.drives.ldcn.faults import FaultCode
from ldcnd.drives.smartstep.monitors import ALARMS, AlarmKind
from tests.support.axis_bench import tracked
from tests.support.pages import command_lines, require_command_line

DAEMON_FAULTS = {fault.code for fault in OF_DAEMON}
ALARM_CODES = {f"alarm_{known.code:04x}" for known in ALARMS if known.kind is not AlarmKind.NONE} | {UNLISTED_ALARM}
FAULTS = DAEMON_FAULTS | ALARM_CODES | set(FaultCode)
HEADINGS = [
    "## What it means",
    "## What the daemon has done",
    "## What to check",
    "## How to clear it",
    "## Never",
]
PLACEHOLDERS = {"VALUE": "1"}
ERROR_CLASSES = [
    member
    for member in vars(errors).values()
    if isinstance(member, type) and issubclass(member, LdcndError) and member is not LdcndError
]


def text_of(code: str) -> str:
    text = page_text(code)
    assert text is not None
    return text


def commands_of(text: str) -> list[str]:
    return [span for span in re.findall(r"`(ldcnd [^`]+)`", text) if span != "ldcnd run"]


def test_every_code_has_a_page_and_every_page_a_code():
    assert codes() == FAULTS | set(ErrorCode)


def test_a_page_has_the_answers_in_the_order_in_which_they_are_needed():
    for code in codes():
        lines = text_of(code).splitlines()
        assert lines[0].startswith(f"# {code}: ")
        assert [line for line in lines if line.startswith("#")][1:] == HEADINGS, code
        for heading in HEADINGS:
            assert not lines[lines.index(heading) + 2].startswith("#"), f"{code}: nothing below {heading!r}"


def test_a_page_is_plain():
    for code in codes():
        without_code = re.sub(r"`[^`]*`", "", text_of(code))
        assert not re.search(r"<[a-z/!]|&\w+;", without_code), f"{code}: no HTML, a console shows the page as it is"
        assert "{" not in without_code, code


def test_a_page_refers_to_pages_that_exist():
    for code in codes():
        referred = re.findall(r"page `(\w+)`|see `(\w+)`", text_of(code), re.IGNORECASE)
        for name in filter(None, (name for pair in referred for name in pair)):
            assert page_of(name), f"{code} refers to {name}"


def test_every_command_of_the_pages_is_one():
    for command in {span for code in codes() for span in commands_of(text_of(code))}:
        (words,) = command_lines(command)
        require_command_line([PLACEHOLDERS.get(word, word) for word in words])


def test_an_error_reply_leads_to_its_page():
    for error in ERROR_CLASSES:
        assert error_reply(error("it failed")).page == f"faults/{error.code}"


def test_a_drive_fault_leads_to_the_page_of_what_the_drive_says():
    assert error_reply(DriveFault("still open", value="stop_input")).page == "faults/stop_input"


@pytest.mark.parametrize(
    ("code", "page"),
    [("link_lost", "faults/link_lost"), ("alarm_0010", "faults/alarm_0010"), ("alarm_0123", "faults/alarm_unlisted")],
)
def test_a_fault_leads_to_its_page(code, page):
    assert page_of(code) == page
    assert (FOLDER / f"{page.removeprefix('faults/')}.md").exists()


def test_the_published_fault_names_its_page():
    tracker = tracked(link=LinkState.UP)

    tracker.take(DriveLost(now_ns=1, another=False))

    assert [fault.page for fault in tracker.status.active_faults] == ["faults/link_lost"]


def test_a_code_without_a_page_has_none():
    assert page_of("../errors") is None
    assert page_text("nonsense") is None


def test_the_command_line_leads_from_an_error_to_its_page(monkeypatch, capsys):
    def refuse(**_options):
        raise DriveFault("axis x: still the stop input is open", value="stop_input", remedy="close it")

    monkeypatch.setattr(cli, "main", refuse)
    with pytest.raises(SystemExit, match="1"):
        main()

    assert capsys.readouterr().err.splitlines() == [
        "axis x: still the stop input is open [drive_fault]",
        "  close it",
        "  more: ldcnd fault stop_input",
    ]


def test_the_command_line_shows_a_page_and_lists_all():
    runner = CliRunner()

    assert runner.invoke(cli, ["fault", "stop_input"]).output == text_of("stop_input")
    assert runner.invoke(cli, ["fault"]).output.split() == sorted(codes())
    refused = runner.invoke(cli, ["fault", "nonsense"])
    assert refused.exit_code == 2
    assert "nonsense" in refused.output
