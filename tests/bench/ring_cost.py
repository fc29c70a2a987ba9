"""What the ring of readings behind `at` costs a poll, beside the same daemon whose ring keeps nothing."""

import asyncio
import time
from unittest import mock

from ldcnd.axis.history import ReadingRing
from ldcnd.axis.status import AxisStatus
from ldcnd.drives.driver import AxisReading
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.bench.counts import HZ, POLLS_S, SETTLED_S, config_of, counted
from tests.bench.report import Row
from tests.support.rig import running_rig

AXES = 8
CALL = 13
"""Bytecodes by which a poll asks whether to keep its reading, and has it kept; see `AxisReadings`."""
TIMES = 20
MOST_RATIO = 1.02

Taken = tuple[ReadingRing, AxisReading, AxisStatus, int, int]


def rows() -> list[Row]:
    """Return the calls, bytecodes and time of a poll with the ring and without, and their ratios."""
    calls, codes, _, _ = _measure(keeps=True)
    calls_without, codes_without, _, _ = _measure(keeps=False)
    _, _, poll_us, taken = _measure(keeps=True, is_timed=True)
    ring_us = _time_of(taken)
    ratios = {
        "calls": calls / calls_without,
        "bytecodes": codes / (codes_without - CALL),
        "time, with the simulated drives": poll_us / (poll_us - ring_us),
    }
    return [
        Row("calls of a poll", calls, exact=True),
        Row("bytecodes of a poll", codes, exact=True),
        Row("keeping a reading", ring_us, "us"),
        *(Row(f"{what}, with ring / without", ratio, "", MOST_RATIO, at_most=True) for what, ratio in ratios.items()),
    ]


def _measure(*, keeps: bool, is_timed: bool = False) -> tuple[float, float, float, list[Taken]]:
    taken: list[Taken] = []
    take = ReadingRing.take

    def watch(ring: ReadingRing, reading: AxisReading, status: AxisStatus, t: int, t_error_ns: int) -> None:
        if keeps:
            take(ring, reading, status, t, t_error_ns)
        if is_timed:
            taken.append((ring, reading, status, t, t_error_ns))

    with mock.patch.object(ReadingRing, "take", watch), asyncio.Runner(loop_factory=JumpingLoop) as runner:
        return *runner.run(_polls(is_timed=is_timed)), taken


async def _polls(*, is_timed: bool) -> tuple[float, float, float]:
    async with running_rig(config_of(axes=AXES, hz=HZ)) as rig:
        await asyncio.sleep(SETTLED_S)
        statistics = rig.daemon.rig.buses[0].bus.statistics
        before, began_s = statistics.replies, time.process_time()
        if is_timed:
            await asyncio.sleep(POLLS_S)
            return 0, 0, (time.process_time() - began_s) * 1e6 / (statistics.replies - before)
        with counted() as count:
            await asyncio.sleep(POLLS_S)
        polls = statistics.replies - before
        return count.calls / polls, count.bytecodes / polls, 0.0


def _time_of(taken: list[Taken]) -> float:
    """Return the time in which a reading is kept, in microseconds: the least of several times, as others disturb it."""
    least_s = float("inf")
    for _ in range(TIMES):
        began_s = time.perf_counter()
        for ring, reading, status, t, t_error_ns in taken:
            ring.take(reading, status, t, t_error_ns)
        least_s = min(least_s, time.perf_counter() - began_s)
    return least_s * 1e6 / len(taken)
