"""A program in JavaScript, with the library that npm serves and nothing of ldcnd."""

import asyncio
import shutil
from asyncio.subprocess import PIPE, STDOUT
from pathlib import Path

import pytest

from tests.support.process import ROOT, answering, client, free_port, process
from tests.support.remote_api import remote_api

pytestmark = [
    pytest.mark.edges,
    pytest.mark.real_time,
    pytest.mark.skipif(not shutil.which("npm"), reason="no npm: apt-get install nodejs npm"),
]

PACKAGES = ("@eclipse-zenoh/zenoh-ts@1.10.1", "@msgpack/msgpack@3")
NODE = ("node", "--no-warnings", "--experimental-websocket", "--experimental-wasm-modules")
EXAMPLE = ROOT / "examples" / "move_and_watch.mjs"


async def told(*command: str, place: Path, within_s: float) -> tuple[int | None, str]:
    running = await asyncio.create_subprocess_exec(*command, cwd=place, stdout=PIPE, stderr=STDOUT)
    async with asyncio.timeout(within_s):
        said, _ = await running.communicate()
    return running.returncode, said.decode()


async def test_javascript_moves_an_axis_and_watches_it(tmp_path: Path):
    install = ("npm", "install", "--silent", "--no-audit", "--no-fund", "--ignore-scripts", *PACKAGES)
    code, said = await told(*install, place=tmp_path, within_s=300)
    if code:
        pytest.skip(f"zenoh-ts cannot be had: {said[-200:]}")
    example = shutil.copy(EXAMPLE, tmp_path)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with process("run", "--config", str(ROOT / "config/simulated.toml"), "--listen", endpoint) as running:
        await answering(running, endpoint)
        async with client(endpoint) as rig, remote_api(endpoint) as locator:
            code, said = await told(*NODE, str(example), locator, place=tmp_path, within_s=60)
            assert code == 0, said
            assert "accepted: {" in said
            assert abs((await rig.position("x")).value - 10.0) < 0.05
    print(said)
