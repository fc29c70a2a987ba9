"""`ldcnd bus wire-log` against a daemon in its own process over loopback TCP."""

import asyncio
from asyncio.subprocess import PIPE

import pytest

from ldcnd.bus.wire_log import WireEvent, parse_records
from tests.support.process import LDCND, ROOT, daemon

pytestmark = pytest.mark.real_time


async def ldcnd(*arguments):
    """Run `ldcnd ARGUMENTS` and return its exit code and what it printed, errors last."""
    running = await asyncio.create_subprocess_exec(*LDCND, *arguments, stdout=PIPE, stderr=PIPE)
    async with asyncio.timeout(45):
        printed, errors = await running.communicate()
    return running.returncode, printed.decode(), errors.decode()


async def test_a_line_is_dumped_as_text_in_words_and_for_wireshark(tmp_path):
    text, capture = tmp_path / "line0.txt", tmp_path / "line0.pcapng"
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        written = await ldcnd("bus", "wire-log", "line0", "-e", endpoint, "--decode", "--out", str(text))
        captured = await ldcnd("bus", "wire-log", "line0", "-e", endpoint, "--out", str(capture))
        refused = await ldcnd("bus", "wire-log", "nowhere", "-e", endpoint)

    lines = text.read_text(encoding="utf-8").splitlines()
    assert (written[0], captured[0]) == (0, 0), written[2] + captured[2]
    assert lines[0] == "# ldcnd wire log: bus line0, family ldcn"
    assert {WireEvent.SENT, WireEvent.RECEIVED} <= {record.event for record in parse_records(lines)}
    assert any(line.startswith("#   node ") for line in lines)
    assert any(line.startswith("#   status ") and "position" in line for line in lines)
    assert capture.read_bytes()[:4] == b"\x0a\x0d\x0d\x0a"
    assert refused[0] == 1
    assert "line0" in refused[2]
