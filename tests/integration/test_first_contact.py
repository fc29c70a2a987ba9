"""What a newcomer does first: `make run`, and the first program of the README."""

import asyncio
import os
import re
import signal
import sys
from asyncio.subprocess import PIPE, STDOUT
from urllib.parse import urlsplit

import pytest

from tests.support.browser import WebQuestion, ask_over_tcp, path_of
from tests.support.pages import blocks_of
from tests.support.process import ROOT, free_port

UP_S = 50.0
LINES = 8


pytestmark = pytest.mark.real_time


async def test_make_run_says_what_to_type_and_the_first_program_moves(tmp_path):
    program = next(block.text for block in blocks_of(ROOT / "README.md") if "# first.py" in block.text)
    (tmp_path / "first.py").write_text(program)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    words = ("run", f"ARGS=--listen {endpoint} --console 127.0.0.1:0 --log-level warning")
    make = await asyncio.create_subprocess_exec(
        "make",
        "--no-print-directory",
        "-o",
        ".venv/ready",
        *words,
        cwd=ROOT,
        stdout=PIPE,
        stderr=STDOUT,
        start_new_session=True,
    )
    try:
        async with asyncio.timeout(UP_S):
            said = (await make.stdout.readuntil(b"Ctrl-C here ends it")).decode()
            link = re.search(r"http://\S+", said)[0]
            at = urlsplit(link)
            answer = await ask_over_tcp(at.hostname, at.port, WebQuestion("GET", path_of(link), {"host": at.netloc}))
            first = await asyncio.create_subprocess_exec(
                sys.executable, "first.py", stdout=PIPE, cwd=tmp_path, env={**os.environ, "LDCND_CONNECT": endpoint}
            )
            printed, _ = await first.communicate()
    finally:
        os.killpg(make.pid, signal.SIGINT)
        await make.communicate()

    code = [
        line for line in program.splitlines() if line.strip() and not line.startswith(("#", "async def", "asyncio"))
    ]
    assert len(code) <= LINES
    assert "Rig sim is up: x, y, z, c." in said
    assert f"ldcnd axis move x 10 --wait -e {endpoint}" in said
    assert answer.status == 303
    assert first.returncode == 0
    assert float(printed.split()[0]) == pytest.approx(5, abs=0.05)
