"""The bound of a SmartStep line, against real pollers on the simulated line: no item is read later than planned."""

import asyncio
import random
from collections import defaultdict
from itertools import pairwise

import pytest

from ldcnd.contract.samples import MonitorName
from ldcnd.drives.cost import Cost
from ldcnd.drives.line_plan import LinePlan, Poll, Urgent, plan_line
from ldcnd.drives.smartstep.family import words_of
from ldcnd.drives.smartstep.monitors import OUTPUT_SIGNALS, SPEED_FEEDBACK, WORDS
from ldcnd.drives.smartstep.poller import Basic, Item, Listeners, UnitPoller
from ldcnd.drives.smartstep.profiles import SMARTSTEP
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.smartstep_line import simulated, smartstep_line

VARIANT = SimulatedVariant()
WORD_S = 28 * 10 / 9600 + VARIANT.response_s + SMARTSTEP.quiet_s
LAST_WORD: dict[Item, int] = {
    Basic.STATE: OUTPUT_SIGNALS.address,
    Basic.VELOCITY: SPEED_FEEDBACK.address,
    **{
        name: WORDS[name].address
        for name in (
            MonitorName.TORQUE_REFERENCE,
            MonitorName.POSITION_DEVIATION,
            MonitorName.CUMULATIVE_LOAD,
            MonitorName.REGENERATIVE_LOAD,
        )
    },
}
PERIODS_S = (0.25, 0.5, 1.0, 2.0, 4.0)
UNSETTLED_S = 12.0
"""Units begin one after the other, and each is first asked who it is, which is not planned."""
SECONDS = 72.0
SEEDS = (0, 3, 12, 23, 25, 57)
"""Each of them is late with units that begin late items out of turn, or choose an item after they have queued."""

Rates = dict[int, dict[Item, float]]


def planned(rates: Rates) -> LinePlan:
    polls = [
        Poll(str(unit), (item.value,), hz, Cost(words_of(item) * WORD_S, 0, 0, 0), 0.0, exchanges=words_of(item))
        for unit, items in rates.items()
        for item, hz in items.items()
    ]
    return plan_line(polls, Urgent(WORD_S, 0.0, 0.0, 0.0), by_deadline=False)


def filled(dice: random.Random, units: int) -> Rates:
    """Return rates that hold, and that hardly any further item fits beside."""
    rates: Rates = {unit: {} for unit in range(1, units + 1)}
    for _ in range(100):
        unit, item, hz = dice.randint(1, units), dice.choice(list(LAST_WORD)), 1 / dice.choice(PERIODS_S)
        more = {**rates, unit: {**rates[unit], item: hz}}
        if planned({each: items for each, items in more.items() if items}).holds:
            rates = more
    return {unit: items for unit, items in rates.items() if items}


async def read_at_s(rates: Rates, starts_s: dict[int, float]) -> dict[tuple[int, int], list[float]]:
    """Poll for a while; return when the replies came, by unit and address."""
    drives = [simulated(unit, VARIANT) for unit in rates]
    heard: dict[tuple[int, int], list[float]] = defaultdict(list)
    async with smartstep_line(drives) as line:
        for unit, items in rates.items():
            deaf = Listeners(
                lambda *_: None,
                lambda *_: None,
                lambda *_: None,
                lambda *_: None,
                lambda: None,
                lambda _: False,
                lambda *_: False,
            )
            line.bus.add_poller(UnitPoller(line.bus, unit, SMARTSTEP, items, starts_s[unit], deaf))
        await asyncio.sleep(SECONDS)
        for request, reply in pairwise(line.bus.wire_log.records()):
            if (request.event, reply.event) == (WireEvent.SENT, WireEvent.RECEIVED):
                heard[int(request.data[1:2], 16), int(request.data[3:7], 16)].append(reply.at_s)
    return heard


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.sweep(6)
async def test_no_item_is_read_later_than_planned(seed):
    dice = random.Random(seed)
    rates = filled(dice, dice.randint(1, 4))
    plan = planned(rates)
    bounds_s = dict(zip([(poll.axis, poll.items[0]) for poll in plan.polls], plan.responses_s, strict=True))
    now_s = asyncio.get_running_loop().time()
    starts_s = {unit: now_s + dice.choice([0.0, 0.0, dice.uniform(0.0, 4.0)]) for unit in rates}

    heard = await read_at_s(rates, starts_s)

    from_s = now_s + UNSETTLED_S
    shares = []
    for unit, items in rates.items():
        for item, hz in items.items():
            settled_s = [at_s for at_s in heard[unit, LAST_WORD[item]] if at_s >= from_s]
            assert len(settled_s) == pytest.approx((SECONDS - UNSETTLED_S) * hz, abs=1.0)  # none was skipped
            late_s = [(at_s - starts_s[unit]) % (1 / hz) for at_s in settled_s]
            shares.append(max(late_s) / bounds_s[str(unit), item.value])
    assert 0.3 < max(shares) <= 1.0
