"""What a newcomer does first: `make run`, the first program of the README, the tour in a notebook."""

import asyncio
import os
import re
import signal
import sys
from asyncio.subprocess import PIPE, STDOUT
from contextlib import suppress
from urllib.parse import urlsplit

import pytest

from tests.support.browser import WebQuestion, ask_over_tcp, path_of
from tests.support.pages import blocks_of
from tests.support.process import ROOT, free_port

UP_S = 180.0
TOUR = ROOT / "examples" / "tour.ipynb"
RUN_CELLS = """
import ast, json, sys

names = {}
for cell in json.load(open(sys.argv[1], encoding="utf-8"))["cells"]:
    if cell["cell_type"] == "code":
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, "cell", "exec"), names)
        if last is not None:
            shown = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
            print(shown._repr_html_() if hasattr(shown, "_repr_html_") else repr(shown))
"""
"""Runs a notebook as Jupyter does: the last expression of each cell is shown."""
LINES = 8


pytestmark = [pytest.mark.system, pytest.mark.real_time, pytest.mark.timeout(240)]


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
            tour = await asyncio.create_subprocess_exec(
                sys.executable, "-c", RUN_CELLS, str(TOUR), stdout=PIPE, env={**os.environ, "LDCND_CONNECT": endpoint}
            )
            toured, _ = await tour.communicate()
    finally:
        os.killpg(make.pid, signal.SIGINT)
        await make.communicate()

    code = [
        line for line in program.splitlines() if line.strip() and not line.startswith(("#", "async def", "asyncio"))
    ]
    assert len(code) <= LINES
    assert "Rig sim is up: x, y, z, c." in said
    assert f"ldcnd move x 10 --wait -e {endpoint}" in said
    assert answer.status == 303
    assert first.returncode == 0
    assert tour.returncode == 0
    assert "rig sim" in toured.decode()
    assert "<polyline" in toured.decode()
    assert "above the limit" in toured.decode()
    assert float(printed.split()[0]) == pytest.approx(5, abs=0.05)


async def test_run_without_a_configuration_offers_the_simulated_rig():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    ours, theirs = os.openpty()
    run = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "ldcnd", "run", "--listen", endpoint, "--console", "127.0.0.1:0"),
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
    )
    os.close(theirs)
    said = ""
    try:
        async with asyncio.timeout(UP_S):
            for wanted, answer in (("Run it?", b"y\n"), ("Ctrl-C here ends it", b"")):
                while wanted not in said:
                    said += (await asyncio.to_thread(os.read, ours, 4096)).decode(errors="replace")
                os.write(ours, answer)
            run.send_signal(signal.SIGTERM)
            await asyncio.gather(run.wait(), asyncio.to_thread(_drain, ours))
    finally:
        if run.returncode is None:
            run.kill()
        os.close(ours)
    assert "Rig sim is up" in said


def _drain(terminal):
    with suppress(OSError):  # Linux ends a terminal without a process so
        while os.read(terminal, 4096):
            pass


async def test_run_without_a_configuration_and_a_terminal_says_what_to_type():
    run = await asyncio.create_subprocess_exec(sys.executable, "-m", "ldcnd", "run", stdout=PIPE, stderr=STDOUT)
    said, _ = await run.communicate()
    assert run.returncode == 2
    assert b"--config rig.toml" in said
    assert b"simulated.toml" in said


async def _run_until_it_names_a_link(endpoint, port):
    run = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "ldcnd", "run", "--config", str(ROOT / "config" / "simulated.toml")),
        *("--listen", endpoint, "--console", f"127.0.0.1:{port}", "--log-level", "warning"),
        stdout=PIPE,
    )
    async with asyncio.timeout(UP_S):
        said = (await run.stdout.readuntil(b"Ctrl-C here ends it")).decode()
    return run, re.search(r"http://\S+", said)


async def _listens(port):
    try:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
    except ConnectionRefusedError:
        return False
    writer.close()
    await writer.wait_closed()
    return True


async def test_the_console_beside_a_daemon_ends_with_it_however_that_ends():
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    first, link = await _run_until_it_names_a_link(endpoint, port)
    assert link
    first.kill()
    await first.wait()
    async with asyncio.timeout(UP_S):
        while await _listens(port):
            await asyncio.sleep(0.05)

    second, link = await _run_until_it_names_a_link(endpoint, port)
    second.send_signal(signal.SIGTERM)
    await second.communicate()
    assert link
