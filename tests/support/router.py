"""A Zenoh router in a process of its own, which can be killed."""

import asyncio
import contextlib
import os
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from tests.support.process import START_TIME_S

PROGRAM = """
import json, sys, zenoh
off = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
config = {"mode": "router", "listen": {"endpoints": [sys.argv[1]]}, "scouting": off}
session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
print("ready", flush=True)
sys.stdin.read()
session.close()
"""


@asynccontextmanager
async def router(endpoint: str, path: Path | None = None) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a router until the context ends; it listens when the context begins.

    Args:
        endpoint: where.
        path: a folder with another version of Zenoh; that of this environment when missing.
    """
    environment = {**os.environ, **({"PYTHONPATH": str(path)} if path else {})}
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", PROGRAM, endpoint, env=environment,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        assert process.stdout
        async with asyncio.timeout(START_TIME_S):
            assert await process.stdout.readline() == b"ready\n"
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.communicate()
