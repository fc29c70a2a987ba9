"""What commands leave to polls on a saturated line, on the jumping clock: how long an axis can be without one."""

import asyncio
import random
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise, product
from typing import Literal

from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Lane
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.line.line import AT_ONCE, LANES
from tests.bench.report import Row
from tests.bench.saturated_rig import on_jumping_clock, saturating
from tests.support.rig import RunningRig

Order = Literal["deadline", "phase"]
ORDERS: tuple[Order, ...] = ("deadline", "phase")
CROWDS = (8, 31)
"""How many drives."""
MOST_ROUNDS = 2.0
MOST_WAIT = 1.0
TRIALS = 100
CALLERS = 8
"""Callers that each have a command under way at any time: more wait than may pass a due poll."""


class Load(StrEnum):
    """How a line is commanded."""

    HALF = "commands for half of the time"
    """Evenly spaced, most of them alone."""
    FULL = "commands waiting at any time"


@dataclass(frozen=True, slots=True)
class Shared:
    """How commands and polls shared a line.

    Attributes:
        commands: share of the time for which a command was under way.
        longest_rounds: longest time between two polls of one axis, in rounds: in a mean round each axis is polled once.
        longest_wait: for its first bit, of a command that was queued while no other waited or was under way, over the
            longest exchange; 0 if there was none.
    """

    commands: float
    longest_rounds: float
    longest_wait: float


def rows(seconds: float) -> list[Row]:
    """Measure every order, number of drives and load for so many virtual seconds each."""
    found = []
    for order, drives, load in product(ORDERS, CROWDS, Load):
        seen = shared(order, drives, load, seconds)
        what = f"{load}, {drives} drives by {order}"
        rounds, wait = seen.longest_rounds, seen.longest_wait
        found.append(Row(f"{what}: longest time without a poll / round", rounds, "", MOST_ROUNDS, at_most=True))
        if load is Load.HALF:
            found.append(Row(f"{what}: longest wait / longest exchange", wait, "", MOST_WAIT, at_most=True))
    return found


def shared(order: Order, drives: int, load: Load, seconds: float) -> Shared:
    """Command the drives of a saturated line for so many virtual seconds, once their servo cycles are known."""

    async def work(rig: RunningRig) -> Shared:
        await asyncio.sleep(1.0)
        line = CommandedLine(rig.daemon.rig.buses[0].bus, drives)
        await (line.command_half(seconds) if load is Load.HALF else line.command_always(seconds))
        return line.shared()

    # probes of the stop lane go before commands, as stops do
    return on_jumping_clock(
        saturating(drives, order=order, stop_probe_hz=0.0, recorder={"seconds": 86_400, "memory_mb": 4096}), work
    )


class CommandedLine:
    """A saturated line of LS-182AP at addresses from 1 on; they are asked in the command lane, at random."""

    def __init__(self, bus: Bus, drives: int) -> None:
        self._bus = bus
        self._loop = asyncio.get_running_loop()
        self._began_s = self._loop.time()
        self._dice = random.Random(1)
        self._exchanges = [commands.no_operation(Node(each, PROFILES["ls-182ap"])) for each in range(1, drives + 1)]
        self._queued: list[tuple[float, bool]] = []  # when, and whether alone
        self._open = 0

    async def command_half(self, seconds: float) -> None:
        """Queue commands one by one, so often that they take half of the line's time."""
        for _ in range(TRIALS):
            await self._command()
        tried_s = [until_s - from_s for lane, _, from_s, until_s in self._exchanged() if lane is Lane.COMMAND]
        period_s = 2 * sum(tried_s) / len(tried_s)
        due_s = self._loop.time()
        async with asyncio.TaskGroup() as group:
            for _ in range(int(seconds / period_s)):
                due_s += period_s
                await asyncio.sleep(due_s - self._loop.time())
                group.create_task(self._command(), name="command")

    async def command_always(self, seconds: float) -> None:
        """Let commands wait at any time."""
        until_s = self._loop.time() + seconds

        async def insist() -> None:
            while self._loop.time() < until_s:
                await self._command()

        async with asyncio.TaskGroup() as group:
            for caller in range(CALLERS):
                group.create_task(insist(), name=f"caller {caller}")

    def shared(self) -> Shared:
        """Tell how the line was shared so far."""
        lasted_s = self._loop.time() - self._began_s
        exchanged = list(self._exchanged())
        sent_s = [from_s for lane, _, from_s, _ in exchanged if lane is Lane.COMMAND]
        waits_s = [at_s - queued_s for at_s, (queued_s, alone) in zip(sent_s, self._queued, strict=True) if alone]
        polls_s: dict[int, list[float]] = {}
        for lane, address, from_s, _ in exchanged:
            if lane is Lane.POLL:
                polls_s.setdefault(address, []).append(from_s)
        round_s = lasted_s * len(self._exchanges) / sum(map(len, polls_s.values()))
        return Shared(
            sum(until_s - from_s for lane, _, from_s, until_s in exchanged if lane is Lane.COMMAND) / lasted_s,
            max(later - earlier for each in polls_s.values() for earlier, later in pairwise(each)) / round_s,
            max(waits_s, default=0.0) / max(until_s - from_s for _, _, from_s, until_s in exchanged),
        )

    async def _command(self) -> None:
        self._queued.append((self._loop.time(), self._open == 0))
        self._open += 1
        await self._bus.execute(self._dice.choice(self._exchanges))
        self._open -= 1

    def _exchanged(self) -> Iterator[tuple[Lane, int, float, float]]:
        """Yield lane, address, first bit and last of each exchange."""
        records = [record for record in self._bus.wire_log.records() if record.at_s >= self._began_s]
        for request, reply in pairwise(records):
            if (request.event, reply.event) == (WireEvent.SENT, WireEvent.RECEIVED):
                remarks = LANES if request.note in LANES else AT_ONCE
                yield Lane(remarks.index(request.note)), request.data[1], request.at_s, reply.at_s
