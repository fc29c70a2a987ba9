"""Real processes of ldcnd, for tests on the wall clock."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

from ldcnd.client.rig_client import RigClient, find_rigs
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import LinkState
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings

ROOT = Path(__file__).parents[2]
LDCND = (sys.executable, "-m", "ldcnd")
START_TIME_S = 90.0
END_TIME_S = 15.0


_kept: list[int] = []


def free_port() -> int:
    """Return a TCP port of the loopback interface that nobody uses, and that nobody else gets while this process lives.

    A client may wait a whole run for a daemon that is down: another test's would answer it there.
    """
    probe = socket.socket()
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # whoever wants it by number can listen there
    probe.bind(("127.0.0.1", 0))
    port: int = probe.getsockname()[1]
    _kept.append(probe.detach())
    return port


@asynccontextmanager
async def process(*arguments: str, tree: Path = ROOT) -> AsyncIterator[Process]:
    """Run `ldcnd ARGUMENTS` of a source tree until the context ends; it must then leave by itself when asked to."""
    running = await asyncio.create_subprocess_exec(
        *LDCND, *arguments, stdout=PIPE, stderr=None, cwd=tree, env={**os.environ, "PYTHONUNBUFFERED": "1"}
    )
    try:
        yield running
    finally:
        with contextlib.suppress(ProcessLookupError):
            running.send_signal(signal.SIGTERM)
        try:
            async with asyncio.timeout(END_TIME_S):
                await running.communicate()
        except TimeoutError:
            running.kill()
            await running.communicate()
            raise


@contextmanager
def piped(*command: str, **environment: str) -> Iterator["subprocess.Popen[str]"]:
    """Run a program that reads lines and writes lines until the context ends; it ends with its input, or is ldcnd."""
    pipe = subprocess.PIPE
    with subprocess.Popen(  # noqa: S603
        command, stdin=pipe, stdout=pipe, text=True, cwd=ROOT, env={**os.environ, **environment}
    ) as running:
        try:
            yield running
        finally:
            assert running.stdin
            running.stdin.close()
            if command[: len(LDCND)] == LDCND:
                running.terminate()
            running.wait(2 * END_TIME_S)


@asynccontextmanager
async def daemon(config: Path, tree: Path = ROOT) -> AsyncIterator[str]:
    """Run a daemon of a source tree on a free port; yields its endpoint once every axis answers."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with process("run", "--config", str(config), "--listen", endpoint, tree=tree) as running:
        await answering(running, endpoint)
        yield endpoint


async def answering(running: Process, endpoint: str) -> None:
    """Wait until every axis of a daemon answers."""
    async with asyncio.timeout(START_TIME_S):
        while not await _all_axes_answer(endpoint):
            assert running.returncode is None, "the daemon has ended"
            await asyncio.sleep(0.1)  # nothing tells a client that a port has begun to listen


@asynccontextmanager
async def client(endpoint: str) -> AsyncIterator[RigClient]:
    """Connect to a daemon's only rig."""
    async with open_zenoh_session(ZenohSettings(mode="client", connect=(endpoint,))) as session:
        rigs = await find_rigs(session)
        yield RigClient(session, rigs[0].rig)


async def _all_axes_answer(endpoint: str) -> bool:
    try:
        async with open_zenoh_session(ZenohSettings(mode="client", connect=(endpoint,))) as session:
            rigs = await find_rigs(session)
            if not rigs:
                return False
            rig = RigClient(session, rigs[0].rig)
            states = [await rig.state(axis) for axis in rigs[0].axes]
            return all(state is not None and state.link is LinkState.UP for state in states)
    except LdcndError:
        return False


@asynccontextmanager
async def simulated_terminal(link: Path, *modules: str) -> AsyncIterator[None]:
    """Run `ldcnd sim` behind a symbolic link until the context ends."""
    async with process("sim", "--json", "--baud-check", "--pty", str(link), "--chain", " ".join(modules)) as running:
        assert running.stdout
        async with asyncio.timeout(START_TIME_S):
            told = json.loads(await running.stdout.readline())
        assert Path(told["terminal"]) == link.resolve()
        yield
