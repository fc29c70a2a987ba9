"""Zenoh's sending threads wait for the event loop."""

import asyncio
import os
from pathlib import Path

import pytest

from ldcnd.messaging.zenoh_session import open_zenoh_session
from ldcnd.messaging.zenoh_settings import ZenohSettings
from ldcnd.messaging.zenoh_threads import senders_wait
from tests.support.session_pair import free_endpoint


@pytest.mark.real_time
async def test_sending_threads_interrupt_nobody_once_there_are_some():
    endpoint = free_endpoint()
    alone = open_zenoh_session(ZenohSettings(mode="peer", listen=(endpoint,), connect=()))
    client = open_zenoh_session(ZenohSettings(mode="client", listen=(), connect=(endpoint,)))
    async with asyncio.timeout(30), alone, client:
        await senders_wait()

    policies = {(thread / "comm").read_text().strip(): os.sched_getscheduler(int(thread.name)) for thread in threads()}
    senders = [policy for name, policy in policies.items() if name.startswith("tx-")]
    assert senders
    assert set(senders) == {os.SCHED_BATCH}
    assert {policy for name, policy in policies.items() if not name.startswith("tx-")} == {os.SCHED_OTHER}


def threads() -> list[Path]:
    return list(Path("/proc/self/task").iterdir())
