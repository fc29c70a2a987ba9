"""`ldcnd sim --smartstep`: drives behind a pseudo-terminal, for any host."""

import asyncio
import json
import os
import signal
from asyncio.subprocess import PIPE
from pathlib import Path

import pytest

from tests.support.process import LDCND, ROOT

UNITS = """
[[unit]]
number = 1
stored = { Pn102 = 55 }
[[unit]]
number = 2
run = true
event = [{ at_s = 0.0, alarm = 0x10 }]
"""


async def answered(terminal: int, packet: bytes) -> bytes:
    os.write(terminal, packet)
    reply = b""
    async with asyncio.timeout(20):
        while not reply.endswith(b"\r"):
            try:
                reply += os.read(terminal, 64)
            except BlockingIOError:
                await asyncio.sleep(0.01)
    return reply


@pytest.mark.real_time
@pytest.mark.long
async def test_drives_of_a_file_answer_behind_a_terminal(tmp_path: Path):
    file, log = tmp_path / "units.toml", tmp_path / "host.capture"
    file.write_text(UNITS)
    running = await asyncio.create_subprocess_exec(
        *LDCND, "sim", "--smartstep", str(file), "--wire-log", str(log), "--json", stdout=PIPE, cwd=ROOT
    )
    try:
        async with asyncio.timeout(40):
            ready = json.loads(await running.stdout.readline())
        terminal = os.open(ready["terminal"], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            stored = await answered(terminal, b"W1001020000ED\r")
            alarm = await answered(terminal, b"W20850A000051\r")
        finally:
            os.close(terminal)
    finally:
        running.send_signal(signal.SIGTERM)
        await running.wait()

    assert ready["units"] == [1, 2]
    assert stored[7:11] == b"0037"
    assert alarm[7:11] == b"0010"
    assert "unit 1: REFERENCE 0102H, 0037H" in log.read_text()


@pytest.mark.real_time
@pytest.mark.long
async def test_what_are_no_units_is_refused():
    for wrong in ("1,1", "16"):
        running = await asyncio.create_subprocess_exec(*LDCND, "sim", "--smartstep", wrong, stderr=PIPE, cwd=ROOT)
        _, complaints = await running.communicate()

        assert running.returncode == 78
        assert b"different unit numbers" in complaints
