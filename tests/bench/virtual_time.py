"""What the bus does with the line's time, on the jumping clock: exact, the host takes no time at all."""

import asyncio
import gc
import random
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar

from ldcnd.client.lease import control
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import MoveVelocity, Power
from ldcnd.daemon.service import settle_heap
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.line.bus import Bus
from ldcnd.line.flight_recorder import WireEvent, WireRecord
from ldcnd.sim.ldcn.module import SimulatedModule
from ldcnd.sim.line import SimulatedLine
from tests.bench import commands_and_polls, trace_upload
from tests.bench.report import Row
from tests.bench.saturated_rig import on_jumping_clock, saturating, saturating_smartsteps
from tests.support.rig import SIMULATED, RunningRig

DRIVES = 31
COMMANDS = 400
SLOW = 1.0
"""Of axes that move for a whole run within their limits, mm/s and deg/s."""
ResultT = TypeVar("ResultT")


def rows(seconds: float) -> list[Row]:
    """Measure for so many virtual seconds each."""
    full_per_s, busy = _run(DRIVES, lambda rig: _saturated(rig, seconds))
    alive_per_s, _ = _run(DRIVES, lambda rig: _with_one_dead(rig, seconds))
    found = [
        Row(f"jumping clock: line busy, {DRIVES} drives", busy, target=0.9999),
        Row("jumping clock: line busy, 2 SmartSteps", smartsteps_busy(seconds), target=0.999),
        Row(f"jumping clock: good polls with 1 of {DRIVES} dead, share", alive_per_s / full_per_s, target=0.98),
        Row("longest wait of a command / longest exchange", _run(DRIVES, _longest_wait), target=1.0, at_most=True),
        Row("full collections in steady state", _run(8, lambda rig: _collections(rig, seconds)), "", 0.0, at_most=True),
    ]
    found += commands_and_polls.rows(seconds)
    found += trace_upload.rows()
    found = [replace(row, exact=True) for row in found]
    for drives in (1, 8, DRIVES):
        speed = _run(drives, lambda rig: _speed(rig, min(seconds, 10.0)))
        what = f"simulated line and daemon, {drives} drive(s), line saturated"
        found.append(Row(f"{what}: virtual seconds per second", speed, "x"))
    moving = on_jumping_clock(load_config(SIMULATED), lambda rig: _four_moving(rig, seconds))
    return [*found, Row("config/simulated.toml, four drives moving: virtual seconds per second", moving, "x", 25.0)]


def smartsteps_busy(seconds: float) -> float:
    """Return for which share of so many virtual seconds a line of SmartSteps that is asked for too much is busy."""
    _, busy = on_jumping_clock(saturating_smartsteps(), lambda rig: _saturated(rig, seconds))
    return busy


def _run(drives: int, work: Callable[[RunningRig], Awaitable[ResultT]]) -> ResultT:
    return on_jumping_clock(saturating(drives), work)


def _bus(rig: RunningRig) -> Bus:
    return rig.daemon.rig.buses[0].bus


async def _saturated(rig: RunningRig, seconds: float) -> tuple[float, float]:
    bus = _bus(rig)
    await asyncio.sleep(1.0)
    before, began_s = bus.statistics.replies, asyncio.get_running_loop().time()
    await asyncio.sleep(seconds)
    records = [record for record in bus.wire_log.records() if record.at_s >= began_s]  # the start is not saturated
    return (bus.statistics.replies - before) / seconds, _busy(records)


async def _with_one_dead(rig: RunningRig, seconds: float) -> tuple[float, float]:
    line = _bus(rig)._line
    assert line
    assert isinstance(line.transport, SimulatedLine)
    module = line.transport._chain.modules[-1]
    assert isinstance(module, SimulatedModule)
    module.power(on=False, at_s=asyncio.get_running_loop().time())
    return await _saturated(rig, seconds)


def _busy(records: list[WireRecord]) -> float:
    """Return for which share of the recorded time an exchange was under way."""
    records = [record for record in records if record.event in (WireEvent.SENT, WireEvent.RECEIVED)]
    gaps_s = sum(
        later.at_s - earlier.at_s
        for earlier, later in pairwise(records)
        if earlier.event is WireEvent.RECEIVED and later.event is WireEvent.SENT
    )
    return 1 - gaps_s / (records[-1].at_s - records[0].at_s)


async def _longest_wait(rig: RunningRig) -> float:
    """Queue commands at random instants; return their longest wait for the line over the longest exchange on it."""
    bus, loop, dice = _bus(rig), asyncio.get_running_loop(), random.Random(1)
    exchanges = [commands.no_operation(Node(address, PROFILES["ls-182ap"])) for address in range(1, DRIVES + 1)]
    longest_wait_s = longest_exchange_s = 0.0
    for _ in range(COMMANDS):
        await asyncio.sleep(dice.expovariate(200.0))
        exchange = dice.choice(exchanges)
        queued_at_s = loop.time()
        await bus.execute(exchange)
        recent = bus.wire_log.records()[-12:]
        sent = [record for record in recent if record.event is WireEvent.SENT and record.data == exchange.request]
        longest_wait_s = max(longest_wait_s, sent[-1].at_s - queued_at_s)
        for earlier, later in pairwise(recent):
            if earlier.event is WireEvent.SENT and later.event is WireEvent.RECEIVED:
                longest_exchange_s = max(longest_exchange_s, later.at_s - earlier.at_s)
    return longest_wait_s / longest_exchange_s


async def _collections(rig: RunningRig, seconds: float) -> float:
    del rig
    await asyncio.sleep(2.0)
    settle_heap()
    with _counted() as counted:
        await asyncio.sleep(seconds)
    return float(len(counted))


@contextmanager
def _counted() -> Iterator[list[int]]:
    """Count full collections."""
    counted: list[int] = []

    def note(phase: str, about: dict[str, int]) -> None:
        if phase == "stop" and about["generation"] == 2:
            counted.append(about["collected"])

    gc.callbacks.append(note)
    try:
        yield counted
    finally:
        gc.callbacks.remove(note)
        gc.unfreeze()


async def _four_moving(rig: RunningRig, seconds: float) -> float:
    await asyncio.sleep(1.0)  # until each drive has been polled
    async with control(rig.client, "bench") as held:
        for axis in held.lease.axes:
            await held.command(axis, Power(on=True))
            await held.command(axis, MoveVelocity(velocity=SLOW))
        return await _speed(rig, seconds)


async def _speed(rig: RunningRig, seconds: float) -> float:
    del rig
    began_s = time.perf_counter()
    await asyncio.sleep(seconds)
    return seconds / (time.perf_counter() - began_s)
