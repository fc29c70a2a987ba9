"""A line that cannot carry all polls: who keeps its rate, who gives way, and what health says of it."""

import asyncio

import pytest
from click.testing import CliRunner

from ldcnd.cli.main import cli
from ldcnd.client.traces import arm_trace
from ldcnd.config.plan import plan_rig
from ldcnd.config.rig import RigConfig
from ldcnd.contract.codec import decode
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.traces import TakeTrace
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.priority_rig import Asked, granted, ranked_config
from tests.support.rig import SIMULATED, running_rig

KEPT = 0.97
"""What axes of the highest priority are granted at least of what they ask for."""
ALIVE_HZ = 0.2
"""How often those of the lowest are asked at least."""
orders = pytest.mark.parametrize("order", ["deadline", "phase"])


def chain_of(drives: int, *faults: LineFault):
    return build_chain(ChainSpec((ModuleSpec("ls182ap"),) * drives, faults=FaultPlan(faults)))


@orders
@pytest.mark.sweep(2)
async def test_of_31_axes_at_50_hz_the_high_one_keeps_its_rate_and_the_others_share_what_remains(order):
    config = ranked_config({"high": Asked(1, 50.0), "normal": Asked(26, 50.0), "low": Asked(4, 50.0)}, order=order)

    async with running_rig(config) as rig:
        await asyncio.sleep(2.0)
        seen = await granted(rig, 2)

    assert seen.of("high")[0] >= KEPT
    assert 0.3 < seen.of("normal")[0] <= seen.of("normal")[-1] < 0.5
    assert ALIVE_HZ / 50.0 < seen.of("low")[0] <= seen.of("low")[-1] < seen.of("normal")[0]


@pytest.mark.long
async def test_low_axes_are_polled_now_and_then_even_where_high_ones_want_all_of_a_slow_line():
    config = ranked_config({"high": Asked(1, 200.0), "low": Asked(30, 10.0)}, baud=19_200)

    async with running_rig(config) as rig:
        await asyncio.sleep(12.0)  # two rounds, until the rates are known
        seen = await granted(rig, 20)

    assert seen.of("low")[0] * 10.0 >= ALIVE_HZ * 0.9
    assert seen.of("low")[-1] < 0.03


@orders
@pytest.mark.sweep(2)
async def test_a_mute_drive_and_commands_that_are_sent_again_cost_high_axes_nothing(order):
    asked = {"high": Asked(2, 50.0), "normal": Asked(10, 36.0), "low": Asked(2, 36.0)}
    chain, node = chain_of(14, LineFault(FaultKind.REPLY_LOST, 0.005)), Node(5, PROFILES["ls-182ap"])

    async def command(bus):
        while True:
            await asyncio.sleep(0.01)
            try:
                await bus.execute(commands.no_operation(node))
            except LdcndError:
                continue

    async with running_rig(ranked_config(asked, order=order), {"line0": chain}) as rig:
        bus = rig.daemon.rig.buses[0].bus
        chain.modules[-1].power(on=False, at_s=asyncio.get_running_loop().time())
        commanding = asyncio.create_task(command(bus), name="commands")
        await asyncio.sleep(2.0)
        resent, timeouts = bus.statistics.resent, bus.statistics.timeouts
        seen = await granted(rig, 10)
        commanding.cancel()
        await asyncio.wait([commanding])

    assert bus.statistics.resent >= resent + 3
    assert bus.statistics.timeouts > timeouts + 25
    assert seen.of("high")[0] >= KEPT
    assert seen.of("normal")[-1] < KEPT
    assert seen.of("low")[-1] < seen.of("normal")[0]


@orders
@pytest.mark.sweep(2)
async def test_a_trace_as_fast_as_possible_takes_nothing_from_high_axes_of_a_full_line(order):
    asked = {"high": Asked(2, 50.0), "normal": Asked(20, 40.0), "low": Asked(1, 40.0)}

    async with running_rig(ranked_config(asked, order=order)) as rig:
        await asyncio.sleep(6.0)
        before = await granted(rig, 2)
        await arm_trace(rig.client, "low23", TakeTrace(channels=("position",), samples=5000))
        await asyncio.sleep(1.0)
        seen = await granted(rig, 2)

    assert seen.of("high")[0] >= KEPT
    assert seen.of("low")[0] == pytest.approx(before.of("low")[0], rel=0.1)
    # two windows of two seconds differ by up to 5 %, depending on the instant at which the line came up
    assert sum(seen.of("normal")) == pytest.approx(sum(before.of("normal")), rel=0.06)


def smartsteps(**priorities: str) -> RigConfig:
    """A rig of SmartSteps on one simulated line, which is asked for more than it can carry."""
    rates = {"velocity": 2.0, "state": 1.0, "position": 0.5}
    axes = [
        {"name": name, "address": unit, "model": "smartstep", "priority": priority, "rates": rates}
        for unit, (name, priority) in enumerate(priorities.items(), 1)
    ]
    bus = {"name": "steps", "port": "sim:steps", "family": "smartstep", "adapter_latency_ms": 0.0, "axis": axes}
    sim = {"name": "steps", "unit": [{"number": unit} for unit in range(1, len(axes) + 1)]}
    return RigConfig.model_validate({"rig": "sim", "bus": [bus], "sim": [sim]})


@pytest.mark.long
async def test_a_high_smartstep_has_every_second_word_if_it_wants_it_and_a_low_one_is_not_forgotten():
    async with running_rig(
        smartsteps(a="high", b="normal", c="normal", d="low", e="normal", f="normal", g="normal")
    ) as rig:

        async def states() -> dict[str, int]:
            return {axis: sample.seq for axis in "abcd" if (sample := await rig.client.state(axis))}

        await asyncio.sleep(20.0)
        before = await states()
        await asyncio.sleep(60.0)
        per_s = {axis: (seq - before[axis]) / 60.0 for axis, seq in (await states()).items()}

    assert per_s["a"] == pytest.approx(1.0, abs=0.05)
    assert per_s["b"] == pytest.approx(per_s["c"], abs=0.05)
    assert 0.25 < per_s["b"] < 0.8
    assert 0.05 < per_s["d"] < 0.5 * per_s["b"]


@pytest.mark.long
async def test_a_reload_changes_priorities():
    asked = {"high": Asked(1, 50.0), "normal": Asked(20, 50.0)}
    config = ranked_config(asked)
    document = config.model_dump()
    for axis in document["bus"][0]["axis"]:
        axis["priority"] = "high" if axis["name"] == "normal2" else "normal"

    async with running_rig(config) as rig:
        changed = RigConfig.model_validate(document)
        rig.daemon.reconfigure(changed, plan_rig(changed))
        await asyncio.sleep(2.0)
        seen = await granted(rig, 3)

    assert seen.shares["normal2"] >= KEPT
    assert seen.shares["high1"] < 0.7


async def test_priorities_are_described_and_planned():
    async with running_rig(ranked_config({"high": Asked(1, 10.0), "normal": Asked(1, 10.0)})) as rig:
        (axis,) = await rig.session.query("ldcn/sim/meta/axes/high1")
        (plan,) = await rig.session.query("ldcn/sim/meta/budget")

    assert decode(AxisInfo, axis.payload, axis.encoding).priority == "high"
    (bus,) = decode(RigBudget, plan.payload, plan.encoding).buses
    assert [poll.priority for poll in bus.polls] == ["high", "normal"]


def test_the_plan_shows_priorities_that_are_not_normal(tmp_path):
    ranked = tmp_path / "ranked.toml"
    ranked.write_text(SIMULATED.read_text().replace('name = "x"', 'name = "x"\npriority = "high"'))

    lines = CliRunner().invoke(cli, ["plan", str(ranked)]).output.splitlines()

    assert {line.split()[0] for line in lines if line.endswith("  high")} == {"x"}
    assert "normal" not in "".join(lines)
