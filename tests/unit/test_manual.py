"""The reference of the command line and the man pages say what the commands say."""

import shutil
import subprocess

import pytest

from ldcnd.cli.names import COMMANDS
from tests.support.pages import ROOT
from tools.__main__ import write_man_pages
from tools.manual import as_markdown, entries, man_pages

PAGES = man_pages()
REFERENCE = as_markdown()


def test_the_page_is_what_the_commands_say():
    assert (ROOT / "docs" / "reference" / "cli.md").read_text() == REFERENCE, "run `make fix`"


def test_every_command_says_what_it_does():
    assert [entry.path for name in COMMANDS for entry in entries(name) if not entry.paragraphs[0]] == []


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


def test_the_man_pages_are_written_into_a_folder(tmp_path):
    write_man_pages(tmp_path / "man1")

    assert {path.name for path in (tmp_path / "man1").iterdir()} == set(PAGES)
