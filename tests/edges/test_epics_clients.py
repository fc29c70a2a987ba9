"""Other people's EPICS clients, unmodified, with a daemon and a gateway in processes of their own."""

import asyncio
import os
import sys
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import Power
from ldcnd.contract.samples import Moving
from tests.edges.epics_clients import CLIENTS
from tests.support.process import ROOT, client, daemon, free_port, process

pytestmark = [pytest.mark.edges, pytest.mark.real_time, pytest.mark.timeout(400)]


@asynccontextmanager
async def gateway(*options: str) -> AsyncIterator[tuple[str, dict[str, str]]]:
    """Run a daemon and a gateway; yields the daemon's endpoint, and the environment of clients."""
    port, pva_port = free_port(), free_port()
    options = (*options, "--pva", f"127.0.0.1:{pva_port}")
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        async with client(endpoint) as rig:
            await rig.command("x", Power(on=True))
        arguments = ("epics", "x", "-e", endpoint, "--address", f"127.0.0.1:{port}", "--prefix", "T:", *options)
        async with process(*arguments) as running:
            assert running.stdout
            assert b"motor records T:{x}" in await running.stdout.readline()
            yield (
                endpoint,
                {
                    **os.environ,
                    "EPICS_CA_ADDR_LIST": "127.0.0.1",
                    "EPICS_CA_AUTO_ADDR_LIST": "NO",
                    "EPICS_CA_SERVER_PORT": str(port),
                    "EPICS_CA_REPEATER_PORT": str(free_port()),
                    "EPICS_PVA_NAME_SERVERS": f"127.0.0.1:{pva_port}",
                    "EPICS_PVA_AUTO_ADDR_LIST": "NO",
                },
            )


@pytest.mark.parametrize("name", CLIENTS)
async def test_an_unmodified_client_uses_the_record(name: str) -> None:
    async with gateway("--moves") as (_, environment):
        code = await run(name, environment)

    assert code == 0


async def test_libca_sees_a_record_that_it_cannot_write() -> None:
    program = """
import epics
pv = epics.PV("T:x")
pv.wait_for_connection(60)
assert (pv.read_access, pv.write_access) == (True, False), pv
try:
    epics.caput("T:x", 5.0, wait=True, timeout=30)
except epics.ca.CASeverityException as refused:
    assert "denied" in str(refused)
else:
    raise AssertionError("a put to a read-only record was taken")
"""
    async with gateway() as (endpoint, environment):
        written = await asyncio.create_subprocess_exec(sys.executable, "-c", program, env=environment)
        code = await written.wait()
        async with client(endpoint) as rig:
            state = await rig.state("x")

    assert code == 0
    assert state.moving is Moving.NO


LOOKS = """
import time
from p4p.client.thread import Context
there = Context("pva")
seen = []
watching = there.monitor("T:x.JOGF", seen.append)
while not seen:
    time.sleep(0.01)
print("looks", flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("is_watched", [False, True])
async def test_a_jog_over_pv_access_ends_when_its_client_is_gone(*, is_watched: bool) -> None:
    program = """
import time
from p4p.client.thread import Context
there = Context("pva")
there.put("T:x.JOGF", 1)
print("jogs", flush=True)
time.sleep(600)
"""
    async with gateway("--moves") as (endpoint, environment), client(endpoint) as rig, asyncio.timeout(120):
        if is_watched:
            looking = await asyncio.create_subprocess_exec(sys.executable, "-c", LOOKS, env=environment, stdout=PIPE)
            assert looking.stdout
            assert await looking.stdout.readline() == b"looks\n"
        jogging = await asyncio.create_subprocess_exec(sys.executable, "-c", program, env=environment, stdout=PIPE)
        assert jogging.stdout
        assert await jogging.stdout.readline() == b"jogs\n"
        await moves(rig, Moving.YES)
        jogging.kill()
        await jogging.wait()
        await moves(rig, Moving.NO)
        place = await rig.position("x")
        if is_watched:
            looking.kill()
            await looking.wait()

    assert place is not None
    assert place.value < 90  # the software limit is at 100


async def moves(rig: RigClient, moving: Moving) -> None:
    while (state := await rig.state("x")) is None or state.moving is not moving:
        await asyncio.sleep(0.05)


async def run(name: str, environment: dict[str, str]) -> int:
    running = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "tests.edges.epics_clients", name, "T:x", env=environment, cwd=ROOT
    )
    async with asyncio.timeout(240):
        return await running.wait()
