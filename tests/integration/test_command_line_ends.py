"""How commands end: a waited move by Ctrl-C, the daemon with its terminal, output nobody reads."""

import asyncio
import os
import pty
import signal
import sys
from asyncio.subprocess import DEVNULL, PIPE
from contextlib import asynccontextmanager

import pytest
import pytest_asyncio

from ldcnd.contract.commands import Halt, Power, SetPosition
from ldcnd.contract.events import ReadEvents
from tests.support.process import LDCND, ROOT, answering, client, daemon, free_port

pytestmark = [
    pytest.mark.system,
    pytest.mark.real_time,
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.timeout(200),
]

CONFIG = ROOT / "config" / "simulated.toml"
PATIENCE_S = 60.0
ON_TERMINAL = """
import fcntl, os, sys, termios
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.executable, sys.argv[1:])
"""
"""Runs a program as a shell in a window does: its standard input is its controlling terminal."""


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def served():
    """Run a daemon; yields its endpoint and a client."""
    async with daemon(CONFIG) as endpoint, client(endpoint) as rig:
        yield endpoint, rig


async def standing(rig, axis):
    await rig.command(axis, Halt())
    await until(rig, axis, lambda state: state.moving == "no")
    await rig.command(axis, Power(on=True))
    await rig.command(axis, SetPosition(position=0.0))


async def until(rig, axis, wanted):
    async with asyncio.timeout(PATIENCE_S):
        while not ((state := await rig.state(axis)) and wanted(state)):
            await asyncio.sleep(0.02)
    return state


@asynccontextmanager
async def moving(served, *options):
    """Let a command wait for a long move of x; yields its process once x moves."""
    endpoint, rig = served
    await standing(rig, "x")
    words = ("move", "x", "90", "--velocity", "3", "--wait", "-e", endpoint, *options)
    running = await asyncio.create_subprocess_exec(*LDCND, *words, stdout=PIPE, stderr=PIPE)
    try:
        await until(rig, "x", lambda state: state.moving == "yes")
        assert await running.stdout.readline()
        yield running
    finally:
        if running.returncode is None:
            running.kill()
        await running.communicate()


@pytest.mark.promise("ctrl-c-halts")
@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
async def test_a_waited_move_that_is_interrupted_is_halted(served, ending):
    async with moving(served) as running:
        running.send_signal(ending)
        async with asyncio.timeout(PATIENCE_S):
            _, said = await running.communicate()

    state = await until(served[1], "x", lambda state: state.moving == "no")
    position = (await served[1].last("x", "position")).value
    assert running.returncode == 130
    assert said.decode().startswith("sim: x: halted at ")
    assert "Traceback" not in said.decode()
    assert position < 80
    assert not state.stop_latched


async def test_a_move_that_waits_behind_another_is_withdrawn_by_the_end_of_its_command(served):
    async with moving(served, "--leave-running"):
        endpoint, rig = served
        words = ("move", "x", "0", "--buffer-mode", "buffered", "--wait", "-e", endpoint)
        behind = await asyncio.create_subprocess_exec(*LDCND, *words, stdout=PIPE, stderr=PIPE)
        async with asyncio.timeout(PATIENCE_S):
            accepted = (await behind.stdout.readline()).decode()
            behind.send_signal(signal.SIGINT)
            await behind.communicate()
        state = await until(rig, "x", lambda state: state.command is None)
        events = (await rig.ask(ReadEvents(axis="x", count=100))).events

    assert "waits until" in accepted
    assert behind.returncode == 130
    assert state.moving == "no"
    assert [event.status for event in events if "overtaken by halt" in (event.reason or "")] == ["aborted"]


async def test_a_waited_move_may_be_left_running(served):
    async with moving(served, "--leave-running") as running:
        running.send_signal(signal.SIGINT)
        async with asyncio.timeout(PATIENCE_S):
            _, said = await running.communicate()

        assert (await served[1].state("x")).moving == "yes"
    await standing(served[1], "x")
    assert running.returncode == 130
    assert "ldcnd halt x" in said.decode()


async def test_output_that_nobody_reads_ends_a_command_without_a_word(served):
    endpoint, _ = served
    watching = await asyncio.create_subprocess_shell(
        f"{' '.join(LDCND)} watch -e {endpoint} | head -1", stdout=PIPE, stderr=PIPE
    )
    async with asyncio.timeout(PATIENCE_S):
        printed, said = await watching.communicate()

    assert printed.count(b"\n") == 1
    assert said == b""


async def test_the_daemon_ends_with_its_terminal_and_reads_its_configuration_at_a_signal(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    master, slave = pty.openpty()
    log = (tmp_path / "log").open("wb")
    words = [sys.executable, "-m", "ldcnd", "run", "--config", str(CONFIG), "--listen", endpoint]
    running = await asyncio.create_subprocess_exec(
        sys.executable, "-c", ON_TERMINAL, *words, stdin=slave, stdout=DEVNULL, stderr=log, cwd=ROOT
    )
    os.close(slave)
    await answering(running, endpoint)
    running.send_signal(signal.SIGHUP)
    async with asyncio.timeout(PATIENCE_S):
        while b"configuration" not in (tmp_path / "log").read_bytes():
            await asyncio.sleep(0.05)
    assert running.returncode is None

    os.close(master)
    async with asyncio.timeout(PATIENCE_S):
        code = await running.wait()

    assert code == 0
    log.close()
