"""The reference of the command line and the man pages say what the commands say."""

import re
import shutil
import subprocess

import pytest
from click.testing import CliRunner

from ldcnd.cli.main import COMMANDS, cli
from ldcnd.cli.manual import as_markdown, entries, man_pages
from tests.support.pages import ROOT

PAGES = man_pages()
REFERENCE = as_markdown()


def plain(page: str) -> str:
    return page.replace("\\-", "-").replace("\\&", "").replace("\\e", "\\").replace("\\(dq", '"')


def test_the_page_is_what_the_commands_say():
    assert (ROOT / "docs" / "reference" / "cli.md").read_text() == REFERENCE, "run `make fix`"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_and_every_option_is_on_both(name):
    page = plain(PAGES[f"ldcnd-{name}.1"])

    for entry in entries(name):
        assert f"`{entry.path}" in REFERENCE
        assert entry.path in page
        for written, meaning in entry.options:
            assert f"`{written.replace('|', chr(92) + '|')}`" in REFERENCE
            assert written in page
            assert meaning.strip(), f"{entry.path} {written} says nothing"


def test_every_command_says_what_it_does():
    assert [entry.path for name in COMMANDS for entry in entries(name) if not entry.paragraphs[0]] == []


@pytest.mark.parametrize("name", COMMANDS)
def test_the_overview_leads_to_every_command(name):
    assert f"ldcnd-{name}(1)" in plain(PAGES["ldcnd.1"])


def test_a_command_with_options_of_its_own_by_these_names_asks_no_daemon():
    asking = {entry.path for name in COMMANDS for entry in entries(name) if entry.asks_a_daemon}

    assert "ldcnd axis move" in asking
    assert not asking & {"ldcnd run", "ldcnd check-config", "ldcnd console", "ldcnd doctor smartstep", "ldcnd sim"}


@pytest.mark.skipif(not shutil.which("groff"), reason="no groff")
def test_groff_takes_every_man_page_without_a_warning():
    done = subprocess.run(
        ["groff", "-man", "-ww", "-Tascii", "-z"],  # noqa: S607
        input="".join(PAGES.values()),
        capture_output=True,
        text=True,
        timeout=20,
        check=True,
    )

    assert done.stderr == ""


def test_a_man_page_has_its_sections():
    for page in PAGES.values():
        sections = re.findall(r"^\.SH (.+)$", page, re.MULTILINE)
        assert sections[:2] == ["NAME", "SYNOPSIS"]
        assert sections[-2:] == ["EXIT STATUS", "SEE ALSO"]


def test_the_man_pages_are_written_into_a_folder(tmp_path):
    result = CliRunner().invoke(cli, ["schema", "man", str(tmp_path / "man1")], catch_exceptions=False)

    assert result.exit_code == 0
    assert {path.name for path in (tmp_path / "man1").iterdir()} == set(PAGES)
