"""The how-to on captures says what works: its commands and its code are executed."""

import re
import runpy
import shutil

import pytest

from tests.support.captures import FOLDER
from tests.support.command_line import run_all
from tests.support.process import ROOT

TEXT = (ROOT / "docs" / "how-to" / "replay-a-capture.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```sh\n(.+?)^```", TEXT, re.MULTILINE | re.DOTALL)
COMMANDS = [line for block in BLOCKS for line in block.splitlines()]
ON_FILES = [command for command in COMMANDS if "wire-log" not in command]  # test_wire_log_cli.py has the others


@pytest.mark.system
@pytest.mark.real_time
async def test_what_the_page_does_with_a_capture_can_be_done(tmp_path):
    shutil.copy(FOLDER / "power_loss.capture", tmp_path / "fault.capture")

    ran = await run_all(tmp_path, *ON_FILES)

    assert [each.code for each in ran] == [0, 0, 0, 0], ran
    assert "node 1: ReadStatus" in ran[0].printed
    assert "x link_lost (the drive does not answer" in ran[2].printed
    assert ran[2].printed.endswith("packets as they were, 2 commands, to the end\n")
    assert (tmp_path / "fault.jsonl").read_bytes() == (FOLDER / "power_loss.jsonl").read_bytes()
    assert (tmp_path / "fault.pcapng").read_bytes()[:4] == b"\x0a\x0d\x0d\x0a"


def test_the_test_on_the_page_passes(tmp_path, monkeypatch):
    shutil.copy(FOLDER / "power_loss.capture", tmp_path / "fault.capture")
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"^```python\n(.+?)^```", TEXT, re.MULTILINE | re.DOTALL)
    (tmp_path / "test_fault.py").write_text(code, encoding="utf-8")

    facts = runpy.run_path(str(tmp_path / "test_fault.py"))

    assert len(facts["published"]) > 100
