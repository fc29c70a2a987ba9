import asyncio
import random
import signal
import socket
import threading

import pytest

from ldcnd.testing.jumping_loop import JumpingLoop


async def test_an_hour_takes_no_time():
    loop = asyncio.get_running_loop()

    await asyncio.sleep(3600)

    assert loop.time() == pytest.approx(3600)


def test_a_deadlock_is_an_error():
    async def wait_for_ever() -> None:
        await asyncio.get_running_loop().create_future()

    with asyncio.Runner(loop_factory=JumpingLoop) as runner, pytest.raises(RuntimeError, match="deadlock"):
        runner.run(wait_for_ever())


@pytest.mark.real_time
async def test_real_time_is_real():
    assert not isinstance(asyncio.get_running_loop(), JumpingLoop)


@pytest.mark.parametrize("starts_at_s", [0.0, 1e5, 1e7])
def test_a_timer_never_comes_early_and_at_whole_nanoseconds(starts_at_s):
    """A timer that came early would be set again for the same instant, for ever."""
    randoms = random.Random(7)

    async def wait() -> None:
        loop = asyncio.get_running_loop()
        for _ in range(200):
            wanted_s = loop.time() + randoms.random()
            reached = loop.create_future()
            loop.call_at(wanted_s, reached.set_result, None)
            await reached
            assert loop.time() >= wanted_s
            assert float(f"{loop.time():.9f}") == loop.time()

    with asyncio.Runner(loop_factory=lambda: JumpingLoop(starts_at_s)) as runner:
        runner.run(wait())


async def test_what_a_thread_hands_over_comes_while_timers_run():
    loop, came = asyncio.get_running_loop(), asyncio.Event()
    thread = threading.Thread(target=loop.call_soon_threadsafe, args=(came.set,))
    thread.start()
    thread.join()

    async with asyncio.timeout(1.0):
        await came.wait()

    assert loop.time() == 0.0


async def test_a_signal_comes_while_timers_run():
    loop, came = asyncio.get_running_loop(), asyncio.Event()
    loop.add_signal_handler(signal.SIGUSR2, came.set)
    try:
        await asyncio.sleep(1.0)
        signal.raise_signal(signal.SIGUSR2)
        async with asyncio.timeout(1.0):
            await came.wait()
    finally:
        loop.remove_signal_handler(signal.SIGUSR2)


async def test_a_socket_is_read_while_timers_run():
    loop = asyncio.get_running_loop()
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.settimeout(0.0)
        theirs.sendall(b"x")
        async with asyncio.timeout(1.0):
            assert await loop.sock_recv(ours, 1) == b"x"
