import asyncio
from collections.abc import Callable

import pytest

from ldcnd.line.exchange import NEVER_S
from ldcnd.line.watchdog import Watchdog


class CountingLoop:
    """The running loop, with its timers counted."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self.timers: list[asyncio.TimerHandle] = []

    def time(self) -> float:
        return self._loop.time()

    def call_at(self, when: float, callback: Callable[[], None]) -> asyncio.TimerHandle:
        timer = self._loop.call_at(when, callback)
        self.timers.append(timer)
        return timer


@pytest.fixture
async def loop() -> CountingLoop:
    return CountingLoop()


@pytest.fixture
async def fired() -> list[float]:
    return []


@pytest.fixture
async def watchdog(loop: CountingLoop, fired: list[float]) -> Watchdog:
    return Watchdog(loop, fired.append)  # type: ignore[arg-type]


async def test_it_calls_once_at_its_deadline(watchdog: Watchdog, fired: list[float]):
    watchdog.set(0.5)

    await asyncio.sleep(2)

    assert fired == pytest.approx([0.5])


async def test_moving_the_deadline_later_makes_no_timer(watchdog: Watchdog, loop: CountingLoop, fired: list[float]):
    for step in range(1, 1001):
        watchdog.set(step / 1000 + 1)

    await asyncio.sleep(3)

    assert fired == pytest.approx([2.0])
    assert len(loop.timers) == 2


async def test_moving_the_deadline_earlier_replaces_the_timer(
    watchdog: Watchdog, loop: CountingLoop, fired: list[float]
):
    watchdog.set(2.0)
    watchdog.set(0.5)

    assert [timer.cancelled() for timer in loop.timers] == [True, False]

    await asyncio.sleep(1)

    assert fired == pytest.approx([0.5])


async def test_a_deadline_in_the_past_calls_at_once(watchdog: Watchdog, fired: list[float]):
    await asyncio.sleep(1)

    watchdog.set(0.25)
    await asyncio.sleep(0.001)

    assert fired == pytest.approx([1.0])


async def test_never_is_never(watchdog: Watchdog, fired: list[float]):
    watchdog.set(1.0)
    watchdog.set(NEVER_S)

    await asyncio.sleep(10)

    assert fired == []


async def test_it_may_be_set_again_from_its_own_call(loop: CountingLoop):
    fired: list[float] = []

    def again(now_s: float) -> None:
        fired.append(now_s)
        if len(fired) < 3:
            watchdog.set(now_s + 1)

    watchdog = Watchdog(loop, again)  # type: ignore[arg-type]
    watchdog.set(1.0)
    await asyncio.sleep(10)

    assert fired == pytest.approx([1.0, 2.0, 3.0])


async def test_cancelling_leaves_no_timer_and_setting_again_works(
    watchdog: Watchdog, loop: CountingLoop, fired: list[float]
):
    watchdog.set(1.0)

    watchdog.cancel()
    watchdog.cancel()
    await asyncio.sleep(2)

    assert all(timer.cancelled() for timer in loop.timers)
    assert fired == []
    watchdog.set(3.0)
    await asyncio.sleep(2)
    assert fired == pytest.approx([3.0])
