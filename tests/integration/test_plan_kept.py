"""What the plan predicts and what 31 axes then do, through a host that takes as long as the plan reckons with."""

import asyncio
from dataclasses import dataclass

import pytest

from ldcnd.config.plan import require_plan
from ldcnd.config.rig import RigConfig
from ldcnd.contract.plan import BusPlan
from ldcnd.line.exchange import Lane
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import rig_on
from tests.support.late_host import open_late_host

AXES = 31
FAST_HZ, SLOW_HZ = 20.0, 8.0


def thirty_one(order: str) -> RigConfig:
    """Return a rig of 31 axes that nearly fills its line."""
    axes = [
        {
            "name": f"a{address}",
            "address": address,
            "model": "ls-182ap",
            "velocity": 1.0,
            "acceleration": 1.0,
            "rates": {"position": hz, "velocity": hz, "adc": hz, "state": hz},
        }
        for address in range(1, AXES + 1)
        for hz in [FAST_HZ if address % 4 == 0 else SLOW_HZ]
    ]
    bus = {
        "name": "line0",
        "port": "sim:line0",
        "baud": 115_200,
        "adapter_latency_ms": 0.0,
        "order": order,
        "axis": axes,
    }
    sim = {"name": "line0", "module": [{"model": "ls182ap"}] * AXES}
    return RigConfig.model_validate({"rig": "sim", "bus": [bus], "sim": [sim]})


@dataclass(frozen=True, slots=True)
class Kept:
    """How a plan was kept.

    Attributes:
        planned: what was promised.
        load: share of the time for which an exchange was under way.
        exchanges_per_s: that were made.
        longest_s: from a poll's due time to its end.
    """

    planned: BusPlan
    load: float
    exchanges_per_s: float
    longest_s: float


async def kept(order: str, seconds: float) -> Kept:
    config = thirty_one(order)
    (planned,) = require_plan(config).buses
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"),) * AXES))
    host_s = planned.turnaround_s
    opened = []

    async def opener():
        opened.append(await open_late_host(chain, host_s, host_s))
        return opened[-1]

    async with rig_on(chain, config, opener=opener) as rig:
        bus, (host,) = rig.line.bus, opened
        await asyncio.sleep(2.0)
        busy_s, exchanges = host.busy_s, bus.statistics.exchanges
        await asyncio.sleep(seconds)
        return Kept(
            planned,
            (host.busy_s - busy_s) / seconds,
            (bus.statistics.exchanges - exchanges) / seconds,
            bus.statistics.latency[Lane.POLL].longest_s,
        )


def check(seen: Kept) -> None:
    """Hold what was seen against the plan."""
    wanted_per_s = sum(poll.rate_hz for poll in seen.planned.polls) + seen.planned.stop_probe_hz
    assert seen.exchanges_per_s == pytest.approx(wanted_per_s, rel=0.005)
    assert seen.load <= seen.planned.load
    assert seen.load == pytest.approx(seen.planned.mean_load, rel=0.03)
    assert seen.longest_s <= max(poll.response_s for poll in seen.planned.polls)


@pytest.mark.long
async def test_31_axes_use_the_line_as_planned_and_no_poll_is_later_than_planned():
    seen = await kept("deadline", 2.0)

    check(seen)
    assert seen.longest_s > 0.7 * max(poll.response_s for poll in seen.planned.polls)


@pytest.mark.long
async def test_ordered_by_phase_they_use_less_of_it():
    seen = await kept("phase", 2.0)

    check(seen)
    (by_deadline,) = require_plan(thirty_one("deadline")).buses
    assert seen.planned.mean_load < 0.97 * by_deadline.mean_load
    assert seen.planned.load == by_deadline.load


@pytest.mark.soak
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("order", ["deadline", "phase"])
async def test_ten_minutes_of_31_axes_are_as_planned(order):
    seen = await kept(order, 600.0)
    print(seen.load / seen.planned.mean_load, seen.longest_s / max(poll.response_s for poll in seen.planned.polls))
    check(seen)
