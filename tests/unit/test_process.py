"""The daemon's process: its loop, its processor, its heap."""

import asyncio
import gc
import sys

import pytest

from ldcnd.daemon.service import held_awake, loop_factory, settle_heap


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
