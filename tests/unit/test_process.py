"""The daemon's process: its loop, its processor, its heap."""

import asyncio
import gc
import os
import sys
from pathlib import Path

import pytest

from ldcnd.daemon.process import held_awake, loop_factory, senders_wait, settle_heap
from ldcnd.messaging.zenoh_session import open_zenoh_session
from ldcnd.messaging.zenoh_settings import ZenohSettings
from tests.support.session_pair import free_endpoint


@pytest.mark.real_time
def test_uvloop_tells_the_time_finer_than_a_packet_lasts():
    pytest.importorskip("uvloop")
    loop = loop_factory(uvloop=True)()

    async def stamps() -> list[float]:
        return [loop.time() for _ in range(1000)]

    try:
        seen = loop.run_until_complete(stamps())
    finally:
        loop.close()

    assert len(set(seen)) > 100
    assert seen == sorted(seen)


@pytest.mark.real_time
def test_both_loops_count_from_the_same_instant():
    pytest.importorskip("uvloop")
    fast, plain = loop_factory(uvloop=True)(), loop_factory(uvloop=False)()
    try:
        assert fast.time() == pytest.approx(plain.time(), abs=0.5)
    finally:
        fast.close()
        plain.close()


def test_without_uvloop_the_daemon_runs_on_asyncio(monkeypatch):
    monkeypatch.setitem(sys.modules, "uvloop", None)

    assert loop_factory(uvloop=True) is asyncio.new_event_loop


def test_the_processor_is_held_awake_by_four_zero_bytes(tmp_path):
    device = tmp_path / "cpu_dma_latency"
    device.write_bytes(b"")

    with held_awake(wanted=True, device=device):
        assert device.read_bytes() == bytes(4)


def test_a_processor_that_may_not_be_held_awake_does_no_harm(tmp_path):
    ran = False

    with held_awake(wanted=True, device=tmp_path / "none"):
        ran = True

    assert ran


def test_what_start_up_left_behind_is_not_collected_again():
    settle_heap()
    frozen = gc.get_freeze_count()
    gc.unfreeze()

    assert frozen > 1000


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
