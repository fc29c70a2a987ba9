"""When a follower of samples learns that the position is old, on the jumping clock."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress

from ldcnd.contract.condition import OLD_PERIODS, OLD_S
from ldcnd.contract.samples import PositionSample, Quality, Sample, VelocitySample
from ldcnd.lab.fresh import fresh_samples


def position(value: float) -> PositionSample:
    return PositionSample(
        t=0, t_error_ns=0, seq=0, quality=Quality.GOOD, value=value, unit="mm", counts=0, following_error=None
    )


def velocity() -> VelocitySample:
    return VelocitySample(t=0, t_error_ns=0, seq=0, quality=Quality.GOOD, value=0.0, unit="mm/s", counts_per_s=0.0)


class Published(AsyncIterator[tuple[str, Sample]]):
    """Samples, each at its instant, and then nothing for ever."""

    def __init__(self, *samples: tuple[float, Sample]) -> None:
        self._samples = list(samples)

    async def __anext__(self) -> tuple[str, Sample]:
        at_s = self._samples[0][0] if self._samples else 1e6
        await asyncio.sleep(at_s - asyncio.get_running_loop().time())
        return "x", self._samples.pop(0)[1]


async def old_at_s(samples: AsyncIterator[tuple[str, Sample]], *, until_s: float) -> list[float]:
    loop, instants = asyncio.get_running_loop(), []
    with suppress(TimeoutError):
        async with asyncio.timeout_at(until_s):
            async for sample in fresh_samples(samples):
                instants += [loop.time()] if sample is None else []
    return instants


async def test_a_position_is_old_soon_after_its_last_one_whatever_else_is_published():
    positions = [(number / 20, position(number)) for number in range(21)]
    others = [(1.0 + number / 20, velocity()) for number in range(1, 100)]

    instants = await old_at_s(Published(*positions, *others), until_s=4.0)

    assert instants
    assert abs(instants[0] - (1.0 + OLD_S + OLD_PERIODS / 20)) < 1e-6


async def test_positions_that_are_polled_slowly_are_not_old_between_two_of_them():
    assert not await old_at_s(Published(*((number * 0.9, position(0.0)) for number in range(30))), until_s=27.0)


async def test_an_outage_counts_as_no_period():
    rates = [(number / 20, position(0.0)) for number in range(20)]
    after = [(50.0 + number / 20, position(0.0)) for number in range(2)]

    instants = await old_at_s(Published(*rates, *after), until_s=60.0)

    assert instants[0] < 3.0
    assert min(at_s for at_s in instants if at_s > 50.1) < 52.0


async def test_an_axis_without_positions_is_old_when_nothing_at_all_comes():
    instants = await old_at_s(Published(*((float(number), velocity()) for number in range(20))), until_s=30.0)

    assert 19.0 < instants[0] < 25.0
