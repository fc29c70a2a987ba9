"""Samples of an axis, and the instants at which what they said has become old."""

import asyncio
from collections.abc import AsyncIterator

from ldcnd.contract.condition import OLD_PERIODS, OLD_S
from ldcnd.contract.samples import PositionSample, Sample

FIRST_PERIOD_S = 1.0
"""What counts as the period of the positions of an axis before two have come, seconds."""


async def fresh_samples(samples: AsyncIterator[tuple[str, Sample]]) -> AsyncIterator[Sample | None]:
    """Yield the samples of one axis, and None each time that its position is old: nothing newer came.

    A drive may be mute while its daemon goes on publishing other things of the axis, so only positions count where
    there are any; where there are none, any sample does.

    Args:
        samples: survives that a wait for its next item is given up, as no generator does.
    """
    loop = asyncio.get_running_loop()
    gaps = (FIRST_PERIOD_S, FIRST_PERIOD_S)
    position_s: float | None = None
    due_s = loop.time() + OLD_S + OLD_PERIODS * FIRST_PERIOD_S
    while True:
        try:
            async with asyncio.timeout_at(due_s):
                _, sample = await anext(samples)
        except StopAsyncIteration:
            return
        except TimeoutError:
            due_s = loop.time() + OLD_S + OLD_PERIODS * min(gaps)
            yield None
            continue
        now_s = loop.time()
        if isinstance(sample, PositionSample):
            if position_s is not None:
                gaps = (gaps[1], now_s - position_s)  # the shorter one: an outage is no period
            position_s = now_s
        if position_s is None or position_s == now_s:
            due_s = now_s + OLD_S + OLD_PERIODS * min(gaps)
        yield sample
