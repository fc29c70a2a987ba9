"""Which versions of Zenoh a daemon of today serves: as clients with nothing but the keys, and as routers in between."""

import asyncio
import os
import sys
from asyncio.subprocess import PIPE, STDOUT
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import pytest

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import MoveAbsolute, Power, Reset
from ldcnd.contract.samples import LinkState, Moving
from tests.support.process import ROOT, answering, client, free_port, process
from tests.support.router import router

pytestmark = [pytest.mark.edges, pytest.mark.real_time]

VERSIONS = ("1.0.0", "1.1.1", "1.2.1", "1.3.4", "1.4.0", "1.5.1", "1.6.2", "1.7.2", "1.9.0", "1.10.2")
"""The last of each minor version, and the first of all."""
STOP = """
import json, sys, zenoh
from importlib.metadata import version
config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [sys.argv[1]]}}))
with zenoh.open(config) as session:
    replies = [json.loads(each.ok.payload.to_string()) for each in session.get(
        "ldcn/sim/@stop", payload="{}", encoding="application/json")]
print(version("eclipse-zenoh"), json.dumps(replies))
"""
INSTALL_TIME_S, RUN_TIME_S = 180.0, 90.0


async def installed(version: str, folder: Path) -> Path:
    """Return a folder with a version of the Python package, for PYTHONPATH."""
    command = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(folder))
    pip = await asyncio.create_subprocess_exec(*command, f"eclipse-zenoh=={version}", stdout=PIPE, stderr=STDOUT)
    async with asyncio.timeout(INSTALL_TIME_S):
        said, _ = await pip.communicate()
    if pip.returncode:
        pytest.skip(f"eclipse-zenoh {version} cannot be had: {said.decode()[-200:]}")
    return folder


async def run(zenoh: Path, *arguments: str) -> str:
    """Run a Python program with a version of Zenoh and return what it prints."""
    environment = {**os.environ, "PYTHONPATH": str(zenoh)}
    program = await asyncio.create_subprocess_exec(
        sys.executable, *arguments, stdout=PIPE, stderr=STDOUT, env=environment, cwd=zenoh
    )
    async with asyncio.timeout(RUN_TIME_S):
        said, _ = await program.communicate()
    assert program.returncode == 0, said.decode()
    return said.decode()


async def ready(rig: RigClient, axis: str = "x") -> None:
    """Wait until an axis can be moved."""
    while (await rig.state(axis)).link is not LinkState.UP:
        await asyncio.sleep(0.1)
    await rig.command(axis, Reset())
    await rig.command(axis, Power(on=True))


@asynccontextmanager
async def daemon(*arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    async with process("run", "--config", str(ROOT / "config/simulated.toml"), *arguments) as running:
        yield running


@pytest.mark.parametrize("version", VERSIONS)
async def test_a_client_with_nothing_but_the_keys_moves_watches_and_stops_an_axis(tmp_path, version):
    zenoh, endpoint = await installed(version, tmp_path), f"tcp/127.0.0.1:{free_port()}"
    async with daemon("--listen", endpoint) as running:
        await answering(running, endpoint)
        async with client(endpoint) as rig:
            told = await run(zenoh, str(ROOT / "examples/move_and_watch.py"), endpoint)
            assert "accepted" in told
            assert abs((await rig.position("x")).value - 10.0) < 0.05

            while (await rig.state("x")).command:  # it has arrived, and may settle
                await asyncio.sleep(0.05)
            await rig.command("x", MoveAbsolute(position=-50.0))
            stopped = await run(zenoh, "-c", STOP, endpoint)
            while (state := await rig.state("x")).moving is not Moving.NO:
                await asyncio.sleep(0.05)
            assert stopped.startswith(version)
            assert '"x"' in stopped
            assert state.stop_latched
    print(f"client of Zenoh {version}: moves, watches, stops")


@pytest.mark.parametrize("version", VERSIONS)
async def test_a_daemon_and_its_clients_meet_at_a_router(tmp_path, version):
    zenoh, endpoint = await installed(version, tmp_path), f"tcp/127.0.0.1:{free_port()}"
    async with AsyncExitStack() as faces, router(endpoint, path=zenoh):
        running = await faces.enter_async_context(
            daemon("--listen", f"tcp/127.0.0.1:{free_port()}", "--connect", endpoint)
        )
        await answering(running, endpoint)
        rig = await faces.enter_async_context(client(endpoint))
        await ready(rig)
        reply = await rig.command("x", MoveAbsolute(position=3.0))
        await rig.wait_for_end("x", reply.command_id)
        assert abs((await rig.position("x")).value - 3.0) < 0.05
        assert "x" in (await rig.stop()).confirmed
    print(f"router of Zenoh {version}: between a daemon and its clients")
