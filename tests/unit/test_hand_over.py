"""Hand-over and workers: from any thread to the loop and back, bounded and in order."""

import asyncio
import threading

import pytest

from ldcnd.net.hand_over import HandOver, Load, TokenChanges
from ldcnd.net.workers import Workers

pytestmark = pytest.mark.real_time


async def test_items_of_a_thread_arrive_in_order_and_the_oldest_are_lost_and_counted() -> None:
    arrived: asyncio.Queue[int] = asyncio.Queue()
    hand_over = HandOver(asyncio.get_running_loop(), arrived.put_nowait, capacity=10)

    # joined on the loop, so nothing is delivered meanwhile
    thread = threading.Thread(target=lambda: [hand_over.offer(number) for number in range(25)])
    thread.start()
    thread.join()

    async with asyncio.timeout(2):
        assert [await arrived.get() for _ in range(10)] == list(range(15, 25))
    assert hand_over.load() == Load(waiting=0, lost=15)


async def test_a_closed_hand_over_delivers_nothing_and_returns_what_was_left() -> None:
    arrived: list[int] = []
    hand_over = HandOver(asyncio.get_running_loop(), arrived.append, capacity=10)
    hand_over.offer(1)

    left = hand_over.close()
    hand_over.offer(2)
    await asyncio.sleep(0)
    await asyncio.sleep(0)

    assert (left, arrived) == ([1], [])


async def test_a_token_that_is_reported_twice_is_told_once() -> None:
    told: asyncio.Queue[tuple[str, bool]] = asyncio.Queue()
    changes = TokenChanges(asyncio.get_running_loop(), lambda key, alive: told.put_nowait((key, alive)))

    for alive in (False, True, True, False, False, True):
        changes.offer("k", alive=alive)

    async with asyncio.timeout(2):
        assert [(await told.get())[1] for _ in range(3)] == [True, False, True]
    assert told.empty()


async def test_a_result_that_comes_too_late_is_undone() -> None:
    workers, release, undone = Workers("test", 1), threading.Event(), threading.Event()

    def work() -> str:
        release.wait(5)
        return "late"

    with pytest.raises(TimeoutError):
        await workers.run(work, 0.01, lambda result: undone.set() if result == "late" else None)
    release.set()

    assert await workers.stop(2)
    assert undone.wait(2)


async def test_what_work_raises_reaches_its_caller_and_spares_the_worker() -> None:
    workers = Workers("test", 1)

    with pytest.raises(ZeroDivisionError):
        await workers.run(lambda: 1 // 0, 2, print)
    result = await workers.run(lambda: 42, 2, print)

    assert result == 42
    assert await workers.stop(2)


async def test_a_job_that_raises_costs_the_others_no_thread() -> None:
    workers = Workers("test", 1)

    def fails() -> None:
        raise KeyboardInterrupt  # no Exception, as a panic in Zenoh

    for _ in range(3):
        workers.submit(fails)
    result = await workers.run(lambda: 42, 2, print)

    assert result == 42
    assert await workers.stop(2)


async def test_stopping_finishes_the_jobs_there_are() -> None:
    workers, done = Workers("test", 1), []
    for number in range(5):
        workers.submit(lambda number=number: done.append(number))

    assert await workers.stop(2)
    assert done == [0, 1, 2, 3, 4]


async def test_stopping_does_not_wait_for_a_stuck_worker() -> None:
    workers, release = Workers("test", 1), threading.Event()
    workers.submit(lambda: release.wait(5) and None)

    in_time = await workers.stop(0.01)
    release.set()

    assert not in_time
    assert await workers.stop(2)


async def test_a_job_that_finds_no_memory_for_a_thread_is_done_by_another(monkeypatch: pytest.MonkeyPatch) -> None:
    workers, done = Workers("test", 2), []
    start = threading.Thread.start
    refused = ["the first"]

    def scarce(thread: threading.Thread) -> None:
        if refused:
            raise RuntimeError(f"can't start {refused.pop()} thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", scarce)

    workers.submit(lambda: done.append(1))
    workers.submit(lambda: done.append(2))

    assert await workers.stop(2)
    assert done == [1, 2]
