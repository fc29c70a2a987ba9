"""Zenoh's sending threads wait for the event loop."""

import asyncio
import contextlib
import os
import sys
from pathlib import Path

import pytest

from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.net.zenoh_threads import senders_wait
from tests.support.session_pair import free_endpoint


@pytest.mark.real_time
async def test_sending_threads_interrupt_nobody_once_there_are_some():
    endpoint = free_endpoint()
    alone = open_zenoh_session(ZenohSettings(mode="peer", listen=(endpoint,), connect=()))
    client = open_zenoh_session(ZenohSettings(mode="client", listen=(), connect=(endpoint,)))
    async with asyncio.timeout(30), alone, client:
        await senders_wait()

    policies = {}
    for thread in threads():
        with contextlib.suppress(OSError):  # it has ended since
            policies[(thread / "comm").read_text().strip()] = os.sched_getscheduler(int(thread.name))
    senders = [policy for name, policy in policies.items() if name.startswith("tx-")]
    assert senders
    assert set(senders) == {os.SCHED_BATCH}
    assert {policy for name, policy in policies.items() if not name.startswith("tx-")} == {os.SCHED_OTHER}


def threads() -> list[Path]:
    return list(Path("/proc/self/task").iterdir())


ENOUGH = 8
LISTENING = """
import asyncio, sys
from ldcnd.net.zenoh_session import ZenohSettings, open_zenoh_session
from pathlib import Path
async def main():
    async with (
        open_zenoh_session(ZenohSettings(listen=(sys.argv[1],))),
        open_zenoh_session(ZenohSettings(connect=(sys.argv[1],), mode="client")),
    ):
        senders = 0
        async with asyncio.timeout(20):
            while senders < int(sys.argv[2]):  # a thread that has just begun has no name yet
                await asyncio.sleep(0.01)
                names = [(thread / "comm").read_text() for thread in Path("/proc/self/task").iterdir()]
                senders = sum(name.startswith("tx-") for name in names)
        print(senders)
asyncio.run(main())
"""


@pytest.mark.real_time
@pytest.mark.long
async def test_a_daemon_starts_enough_sending_threads():
    """While one closes the link of a client that takes nothing, the others send."""
    program = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", LISTENING, free_endpoint(), f"{ENOUGH}"),
        stdout=asyncio.subprocess.PIPE,
        cwd=Path(__file__).parents[2],
    )
    async with asyncio.timeout(30):
        said, _ = await program.communicate()

    assert int(said) >= ENOUGH
