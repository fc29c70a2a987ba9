"""What a poll, a command, a stop and a sample cost in counts that no machine changes, held by upper bounds.

Times scatter from hour to hour; these numbers do not, so a change that costs more fails here and says what. Each is an
upper bound: whoever lowers a cost lowers its bound.
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import astuple, dataclass

import pytest

from ldcnd.bus.bus import Bus
from ldcnd.config.rig import RigConfig
from ldcnd.messaging.codec import Encoding, encode
from ldcnd.messaging.keys import Keys
from ldcnd.messaging.session import Qos
from ldcnd.model.commands import MoveRelative, Power
from ldcnd.model.samples import TelemetryItem
from tests.integration.test_cost_of_a_poll import ITEMS, config
from tests.support.counted import blocks_in_use, counted_bytecodes
from tests.support.rig import running_rig

GAINS = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "cl": 0, "el": 4000, "sr": 1, "deadband": 0}
POLLS_S = 0.2
TIMES = 20


@dataclass(frozen=True, slots=True)
class Bound:
    """The most that one poll, command, stop or sample may cost.

    Attributes:
        calls, turns, bytecodes: see `Count`.
        kept: blocks of memory that it leaves in use.
    """

    calls: float
    turns: float
    bytecodes: float
    kept: float


POLL = Bound(calls=60, turns=3.45, bytecodes=2515, kept=2.5)
"""One poll of position, velocity, A/D value, state and faults, from its turn until all are published."""
COMMAND = Bound(calls=1236, turns=77, bytecodes=30620, kept=55)
"""A move that aborts the one before: planned, halted, asked where the axis is, loaded, permitted and started;
permission is asked again as the turn of each packet comes."""
STOP = Bound(calls=223, turns=10.5, bytecodes=7440, kept=27)
SAMPLE = Bound(calls=13.1, turns=2.0, bytecodes=425, kept=0.5)
"""From what a session delivers to what a program's loop over samples has in its hands."""


def quiet_rig() -> RigConfig:
    """One drive that is hardly polled, so that what is counted is the command's."""
    drive = {"name": "a1", "address": 1, "model": "ls-182ap", "velocity": 1, "acceleration": 100, "gains": GAINS}
    rates = dict.fromkeys(ITEMS, 0.0) | {"state": 1.0}
    bus = {
        "name": "line0",
        "port": "sim:line0",
        "baud": 115_200,
        "stop_probe_hz": 0.0,
        "axis": [drive | {"rates": rates}],
    }
    sim = {"name": "line0", "module": [{"model": "ls182ap"}]}
    return RigConfig.model_validate({"rig": "sim", "bus": [bus], "sim": [sim]})


async def cost(work: Callable[[], Awaitable[float]]) -> Bound:
    """Return what each costs of what `work` does and counts; memory is looked at when it is done again."""
    with counted_bytecodes() as count:
        times = await work()
    before = blocks_in_use()
    again = await work()
    kept = (blocks_in_use() - before) / again
    found = Bound(count.calls / times, count.turns / times, count.bytecodes / times, kept)
    print(
        f"each of {times:g}: {found.calls:.1f} calls, {found.turns:.2f} turns, {found.bytecodes:.0f} bytecodes,"
        f" {found.kept:.1f} blocks kept"
    )
    return found


def holds(found: Bound, bound: Bound) -> bool:
    return all(cost <= most for cost, most in zip(astuple(found), astuple(bound), strict=True))


async def all_delivered(bus: Bus) -> None:
    """Wait for an instant at which as many replies were delivered as have come."""
    assert bus._line
    while bus._line.undelivered:
        await asyncio.sleep(0.001)


async def test_a_poll_of_five_items_costs_so_much_and_no_more():
    async with running_rig(config(axes=8, items=ITEMS, order="deadline")) as rig:
        bus = rig.daemon.rig.buses[0].bus
        await asyncio.sleep(1.0)
        await all_delivered(bus)

        async def polls() -> float:
            before = bus.statistics.replies
            await asyncio.sleep(POLLS_S)
            await all_delivered(bus)
            return bus.statistics.replies - before

        assert holds(await cost(polls), POLL)


async def test_a_command_costs_so_much_and_no_more():
    async with running_rig(quiet_rig()) as rig:
        await rig.until("a1", lambda state: state.link == "up")
        await rig.client.command("a1", Power(on=True))
        await asyncio.sleep(1.0)

        async def commands() -> float:
            for _ in range(TIMES):
                await rig.client.command("a1", MoveRelative(distance=0.001, buffer_mode="aborting"))
            return TIMES

        assert holds(await cost(commands), COMMAND)


async def test_a_stop_costs_so_much_and_no_more():
    async with running_rig(quiet_rig()) as rig:
        await rig.until("a1", lambda state: state.link == "up")
        await rig.client.command("a1", Power(on=True))
        await asyncio.sleep(1.0)

        async def stops() -> float:
            for _ in range(TIMES):
                await rig.client.stop("a1")
            return TIMES

        assert holds(await cost(stops), STOP)


@pytest.mark.parametrize("batch", [1, 32])
async def test_a_sample_costs_a_client_so_much_and_no_more(batch):
    async with running_rig(quiet_rig()) as rig:
        key = Keys("sim").telemetry("a1", TelemetryItem.STATE)
        async with rig.client.samples("a1", "state") as samples, rig.broker.session() as sender:
            _, sample = await anext(samples)
            payload, encoding = encode(sample, Encoding.MSGPACK)

            async def taken() -> float:
                for _ in range(TIMES):
                    for _ in range(batch):
                        sender.publish(key, payload, encoding=encoding, qos=Qos.TELEMETRY)
                    for _ in range(batch):
                        await anext(samples)
                return TIMES * batch

            assert holds(await cost(taken), SAMPLE)
