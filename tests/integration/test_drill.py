"""The drills of the command line against a daemon in its own process."""

import asyncio
import json
import signal
from asyncio.subprocess import PIPE, create_subprocess_exec

import pytest

from ldcnd.contract.leases import ListHolders
from tests.support.process import LDCND, ROOT, client, daemon

pytestmark = [pytest.mark.system, pytest.mark.real_time]

LEASE_S = 0.8


async def drill(endpoint: str, kind: str, *options: str) -> dict[str, float]:
    words = ("drill", kind, "x", "--velocity", "5", "--yes", "--json", "--connect", endpoint, *options)
    done = await create_subprocess_exec(*LDCND, *words, stdout=PIPE, cwd=ROOT)
    printed, _ = await done.communicate()
    assert done.returncode == 0
    return json.loads(printed)


async def reset(endpoint: str) -> None:
    """Reset x as soon as its drive has said that it stands: it is refused before."""
    words = ("reset", "x", "--connect", endpoint)
    async with asyncio.timeout(20):
        while True:
            done = await create_subprocess_exec(*LDCND, *words, stdout=PIPE, stderr=PIPE, cwd=ROOT)
            _, said = await done.communicate()
            if done.returncode == 0:
                return
            assert b"[wrong_state]" in said


async def test_each_loss_is_rehearsed_and_measured():
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        lost = await drill(endpoint, "client-loss", "--lease", str(LEASE_S))
        stop = await drill(endpoint, "daemon-stop")
        bus = await drill(endpoint, "bus-loss")
        await reset(endpoint)

    assert -0.5 < lost["reacted_after_lease_s"] < 0.5  # the client counts from the reply, which a slow host brings late
    assert lost["stands_after_lease_s"] < 1.5
    assert stop["stands_s"] < 1.5
    assert bus["stands_s"] < 5.0


async def until(rig, moving):
    async with asyncio.timeout(60):
        while (state := await rig.state("x")) is None or state.moving != moving:
            await asyncio.sleep(0.02)


@pytest.mark.promise("ctrl-c-halts")
@pytest.mark.parametrize(
    ("kind", "ending"),
    [("client-loss", signal.SIGINT), ("client-loss", signal.SIGTERM), ("bus-loss", signal.SIGTERM)],
)
async def test_a_drill_that_is_interrupted_halts_the_axis_and_leaves_no_lease_behind(kind, ending):
    words = ("drill", kind, "x", "--velocity", "3", "--yes", "--lease", "60", "--connect")
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint, client(endpoint) as rig:
        running = await create_subprocess_exec(*LDCND, *words, endpoint, stdout=PIPE, stderr=PIPE, cwd=ROOT)
        await until(rig, "yes")
        running.send_signal(ending)
        async with asyncio.timeout(60):
            _, said = await running.communicate()
        await until(rig, "no")
        position = (await rig.position("x")).value
        holders = (await rig.ask(ListHolders())).holders

    assert running.returncode == 130, said
    assert said.startswith(b"sim: x: ")
    assert position < 30.0
    assert [each.client for each in holders] == [None] * 4
