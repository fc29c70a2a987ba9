"""`ldcnd bus wire-log` against a daemon in its own process over loopback TCP."""

import json
import re
import shutil

import pytest

from ldcnd.line.capture import parse_capture
from ldcnd.line.flight_recorder import WireEvent
from tests.support.captures import FOLDER
from tests.support.command_line import run_all
from tests.support.process import ROOT, daemon

pytestmark = [pytest.mark.system, pytest.mark.real_time]


PAGE = (ROOT / "docs" / "how-to" / "replay-a-capture.md").read_text(encoding="utf-8")
ON_LINES = re.findall(r"^ldcnd bus wire-log line0 .+$", PAGE, re.MULTILINE)
ON_FILES = re.findall(r"^ldcnd bus wire-log fault\.capture .+$", PAGE, re.MULTILINE)


async def test_a_line_is_dumped_as_a_capture_in_words_as_json_and_for_wireshark(tmp_path):
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        asked = [f"{command} -e {endpoint}" for command in ON_LINES]
        as_json = f"ldcnd bus wire-log line0 --seconds 3 --json -e {endpoint}"
        refused = f"ldcnd bus wire-log nowhere -e {endpoint}"
        *ran, jsons, refusal = await run_all(tmp_path, *asked, as_json, refused)

    assert [each.code for each in (*ran, jsons)] == [0, 0, 0, 0], ran
    text = (tmp_path / "now.capture").read_text(encoding="utf-8")
    file = parse_capture(text)
    assert (file.header.bus, file.header.family, file.header.baud) == ("line0", "ldcn", 115_200)
    assert file.header.first_record == 0
    assert {WireEvent.SENT, WireEvent.RECEIVED} <= {record.event for record in file.records}
    assert "#   node " in text
    assert any("received" in line and "position" in line for line in ran[1].printed.splitlines())
    assert (tmp_path / "now.pcapng").read_bytes()[:4] == b"\x0a\x0d\x0d\x0a"
    records = [json.loads(line) for line in jsons.printed.splitlines()]
    assert any(record["event"] == "received" and "position" in record["words"] for record in records)
    assert refusal.code == 1
    assert "line0" in refusal.errors


async def test_replies_of_a_module_that_is_no_axis_are_read_by_what_stands_there(tmp_path):
    async with daemon(ROOT / "config" / "centrifuge.toml") as endpoint:
        commands = [f"ldcnd bus wire-log line0 --seconds 3 --format words -e {endpoint}"]
        commands.append(f"ldcnd bus wire-log line0 --seconds 3 --out one.capture -e {endpoint}")
        *ran, converted = await run_all(tmp_path, *commands, "ldcnd bus wire-log one.capture --format words")
    for each in (ran[0], converted):
        assert each.code == 0, each
        assert "levels" in each.printed
        assert "Logosol" not in each.printed


async def test_what_the_page_does_with_a_capture_can_be_done(tmp_path):
    shutil.copy(FOLDER / "power_loss.capture", tmp_path / "fault.capture")

    ran = await run_all(tmp_path, *ON_FILES)

    assert [each.code for each in ran] == [0, 0], ran
    assert "node 1: ReadStatus" in ran[0].printed
    assert (tmp_path / "fault.pcapng").read_bytes()[:4] == b"\x0a\x0d\x0d\x0a"
