"""A bare bus that polls simulated LS-182AP at their addresses, as fast as the line allows, on the jumping clock."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import pairwise

from typing_extensions import override

from ldcnd.contract.errors import BusError
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.packet import StatusItem, StatusPacket
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S, actual_baud, baud_divisor
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, Poller, Timing
from ldcnd.line.settings import BusSettings, ServoCycle
from ldcnd.line.transport import Transport
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.module import SimulatedModule
from ldcnd.sim.line import open_simulated_line
from tests.support.late_host import LateHost

BAUD = 115_200
ITEMS = StatusItem.POSITION | StatusItem.VELOCITY | StatusItem.AUX
CYCLE = ServoCycle(SERVO_CYCLE_S, BAUD / actual_baud(baud_divisor(BAUD)))


class DrivePoller(Poller[StatusPacket]):
    """Asks a drive for position, velocity and inputs; absolute deadlines, turns that have passed are left out."""

    def __init__(self, address: int, period_s: float) -> None:
        self.node = address
        self.due_at_s = 0.0
        self.deadline_at_s = self.period_s = period_s
        self.asked_at_s: list[float] = []
        self.timings: list[Timing] = []
        self.errors: list[BusError] = []
        self._exchange = commands.read_status(Node(address, PROFILES["ls-182ap"]), ITEMS)

    @override
    def next_exchange(self, now_s: float) -> Exchange[StatusPacket]:
        self.asked_at_s.append(now_s)
        self.due_at_s += max(1, 1 + int((now_s - self.due_at_s) / self.period_s)) * self.period_s
        self.deadline_at_s = self.due_at_s + self.period_s
        return self._exchange

    @override
    def deliver(self, reply: StatusPacket, timing: Timing) -> None:
        del reply
        self.timings.append(timing)

    @override
    def missed(self, error: BusError) -> None:
        self.errors.append(error)


@dataclass(frozen=True, slots=True)
class Polled:
    """How drives were polled.

    Attributes:
        per_s: polls a second.
        wait_s: mean time between a request and its reply.
        longest_gap: between two polls of one drive, in mean gaps.
    """

    per_s: float
    wait_s: float
    longest_gap: float


@asynccontextmanager
async def polled_bus(
    drives: int, period_s: float, *, by_phase: bool, late_s: tuple[float, float] | None = None
) -> AsyncIterator[tuple[Bus, list[DrivePoller]]]:
    """Run a bus that polls drives whose servo cycles drift apart.

    Args:
        drives: how many.
        period_s: of each poll.
        by_phase: polls are ordered by servo cycles.
        late_s: what the host adds between a reply and the next request, at least and at most; None for nothing.
    """
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"),) * drives, baud_check=False))
    for address, module in enumerate(chain.modules, 1):
        assert isinstance(module, SimulatedModule)
        module.address, module.address_out = address, True
        module.baud = actual_baud(baud_divisor(BAUD))
    chain.baud = BAUD

    async def opener() -> Transport:
        line = await open_simulated_line(chain)
        return LateHost(line, *late_s, seed=1) if late_s else line

    bus = Bus(BusSettings("line0", BAUD, cycle=CYCLE if by_phase else None), opener)
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name="bus")
        await bus.wait_opened()
        pollers = [DrivePoller(address, period_s) for address in range(1, drives + 1)]
        for poller in pollers:
            bus.add_poller(poller)
        yield bus, pollers
        owner.cancel()


async def saturated(
    drives: int, seconds: float, *, by_phase: bool, late_s: tuple[float, float] | None = None
) -> Polled:
    """Poll as fast as the line allows for so long, once the servo cycles are known."""
    async with polled_bus(drives, 0.0005, by_phase=by_phase, late_s=late_s) as (_, pollers):
        await asyncio.sleep(1.0)
        for poller in pollers:
            poller.asked_at_s.clear()
            poller.timings.clear()
        await asyncio.sleep(seconds)
        assert not any(poller.errors for poller in pollers)
    timings = [timing for poller in pollers for timing in poller.timings]
    gaps_s = [later - earlier for poller in pollers for earlier, later in pairwise(poller.asked_at_s)]
    waits_s = [timing.true_until_s - timing.true_from_s for timing in timings]
    return Polled(len(timings) / seconds, sum(waits_s) / len(waits_s), max(gaps_s) / (sum(gaps_s) / len(gaps_s)))
