import asyncio

import pytest

from tests.support.jumping_clock import JumpingLoop


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
