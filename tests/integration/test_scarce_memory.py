"""A daemon whose disk takes nothing and whose memory is limited: it serves, and stops go through."""

import asyncio
import resource

import pytest

from ldcnd.contract.commands import Power
from tests.support.process import ROOT, answering, client, free_port, process

RIG = ROOT / "config" / "simulated.toml"
MEMORY = 2 << 30
"""Address space of the daemon; threads reserve 8 MB each, Zenoh's and those that answer."""


@pytest.mark.real_time
@pytest.mark.long
async def test_a_daemon_that_may_write_no_file_and_has_little_memory_serves_and_stops():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with process("run", "--config", str(RIG), "--listen", endpoint) as running:
        # from outside: the program that starts it must keep its own limits
        resource.prlimit(running.pid, resource.RLIMIT_FSIZE, (0, 0))
        resource.prlimit(running.pid, resource.RLIMIT_AS, (MEMORY, MEMORY))
        await answering(running, endpoint)
        async with client(endpoint) as rig:
            await rig.command("x", Power(on=True))
            reads = [asyncio.create_task(rig.buses()) for _ in range(20)]
            stopped = await rig.stop("x")
            for read in reads:
                await read

    assert stopped.confirmed == ("x",)
