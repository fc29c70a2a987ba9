"""The plan of a configuration: what it promises, what it refuses, and that the running daemon keeps it."""

import asyncio
import json
import random
import time

import pytest
from click.testing import CliRunner

from ldcnd.cli.main import cli
from ldcnd.config.plan import plan_rig, require_plan
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.codec import decode, decode_error
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.health import BusHealth
from ldcnd.contract.plan import RigBudget
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.line.exchange import Lane
from tests.bench.virtual_time import smartsteps_busy
from tests.support.rig import SIMULATED, running_rig

NODE = Node(1, PROFILES["ls-182ap"])
STOP = commands.stop_motor(NODE, StopControl.MOTOR_OFF)
START = commands.start_motion(NODE)


def config(*, axes: int = 4, baud: int = 115_200, overload: str = "refuse", **rates: float) -> RigConfig:
    """A rig of LS-182AP drives on one simulated line without an adapter."""
    return RigConfig.model_validate(
        {
            "rig": "sim",
            "bus": [
                {
                    "name": "line0",
                    "port": "sim:line0",
                    "baud": baud,
                    "adapter_latency_ms": 0.0,
                    "overload": overload,
                    "axis": [
                        {
                            "name": f"a{number}",
                            "address": number,
                            "model": "ls-182ap",
                            "velocity": 100.0,
                            "acceleration": 100.0,
                            "rates": rates,
                        }
                        for number in range(1, axes + 1)
                    ],
                }
            ],
            "sim": [{"name": "line0", "module": [{"model": "ls182ap"}] * axes}],
        }
    )


def with_one_rate(rig: RigConfig, hz: float) -> RigConfig:
    document = rig.model_dump()
    for axis in document["bus"][0]["axis"]:
        axis["rates"] = {item: min(rate, hz) for item, rate in axis["rates"].items()}
    return RigConfig.model_validate(document)


def test_the_simulated_rig_holds_with_room_for_commands():
    (bus,) = require_plan(load_config(SIMULATED)).buses

    assert bus.holds
    assert bus.load < 0.3
    assert bus.commands_per_s > 100
    assert bus.node_baud == pytest.approx(113_636, abs=1)


@pytest.mark.parametrize("path", sorted(SIMULATED.parent.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_rig_holds(path):
    assert plan_rig(load_config(path)).holds


def test_a_plan_that_cannot_hold_is_refused_with_changes_that_make_it_hold():
    overfull = config(axes=8, baud=19_200, position=30.0, velocity=30.0, adc=2.0, state=5.0)

    with pytest.raises(ConfigError, match="bus line0: at 19200 baud the polls need") as refused:
        require_plan(overfull)

    (bus,) = plan_rig(overfull).buses
    cap, baud, *_ = bus.remedies
    assert "any of these is enough" in refused.value.message
    assert cap.startswith("no rate above ")
    hz = float(cap.removeprefix("no rate above ").removesuffix(" Hz"))
    assert require_plan(with_one_rate(overfull, hz)).holds
    assert not plan_rig(with_one_rate(overfull, hz + 0.2)).holds
    assert baud == "baud = 57600"
    assert require_plan(config(axes=8, baud=57_600, position=30.0, velocity=30.0, adc=2.0, state=5.0)).holds


def test_an_overfull_line_that_may_skip_is_not_refused_but_says_so():
    plan = require_plan(config(axes=8, baud=19_200, overload="skip", position=100.0))

    assert not plan.holds
    assert all(poll.response_s is None for poll in plan.buses[0].polls)


def test_one_fast_axis_does_not_have_to_wait_for_many_slow_ones():
    document = config(axes=31, position=1.0, velocity=1.0, adc=1.0, state=1.0).model_dump()
    document["bus"][0]["axis"][0]["rates"] = {"position": 100.0}

    (bus,) = plan_rig(RigConfig.model_validate(with_probes(document, 0.0))).buses

    assert bus.holds
    assert bus.polls[0].response_s == pytest.approx(2 * bus.polls[0].longest_s)


@pytest.mark.parametrize("axes", [1, 4, 8])
@pytest.mark.sweep(3)
async def test_no_poll_of_the_running_daemon_is_later_than_planned(axes):
    hz = {1: 300.0, 4: 80.0, 8: 40.0}[axes]
    rig_config = config(axes=axes, position=hz, velocity=hz, adc=5.0, state=5.0)
    (planned,) = require_plan(rig_config).buses

    async with running_rig(rig_config) as rig:
        statistics = rig.daemon.rig.buses[0].bus.statistics
        before = statistics.exchanges
        await asyncio.sleep(5.0)

        latency = statistics.latency[Lane.POLL]
        assert 0.0 < latency.longest_s <= max(poll.response_s for poll in planned.polls)
        assert statistics.exchanges - before == pytest.approx(5.0 * hz * axes, rel=0.01)


@pytest.mark.long
async def test_no_stop_of_the_running_daemon_waits_longer_than_planned():
    rig_config = config(axes=4, position=100.0, velocity=100.0, adc=5.0, state=5.0)
    (planned,) = require_plan(rig_config).buses
    dice = random.Random(3)

    async with running_rig(rig_config) as rig:
        bus = rig.daemon.rig.buses[0].bus
        for _ in range(200):
            await asyncio.sleep(dice.uniform(0.003, 0.02))
            async with asyncio.TaskGroup() as group:
                group.create_task(bus.execute(START), name="start")
                await asyncio.sleep(dice.uniform(0.0, 0.003))
                await bus.execute(STOP, Lane.STOP)

        latency = bus.statistics.latency[Lane.STOP]
        assert 0.7 * planned.stop_s < latency.longest_s <= planned.stop_s


@pytest.mark.long
async def test_probes_measure_the_wait_of_a_stop_on_a_busy_line_and_the_bound_holds():
    document = config(axes=4, position=60.0, velocity=60.0, adc=5.0, state=5.0).model_dump()
    rig_config = RigConfig.model_validate(with_probes(document, 19.0))
    (planned,) = require_plan(rig_config).buses
    dice = random.Random(5)

    async with running_rig(rig_config) as rig:
        bus = rig.daemon.rig.buses[0].bus
        for _ in range(400):
            await asyncio.sleep(dice.uniform(0.003, 0.02))
            await bus.execute(START)
        (answer,) = await rig.session.query("ldcn/sim/meta/health/line0")
        waits = decode(BusHealth, answer.payload, answer.encoding).stop_wait

    assert planned.stop_probe_hz == 19.0
    assert waits.probes > 60
    assert waits.bound_s == planned.stop_wait_s
    assert 0.4 * planned.stop_wait_s < waits.longest_s <= planned.stop_wait_s
    assert 0.0 < waits.p99_s <= waits.longest_s


def test_probes_are_part_of_the_plan():
    document = config(axes=4, position=40.0).model_dump()
    (without,) = plan_rig(RigConfig.model_validate(with_probes(document, 0.0))).buses
    (with_them,) = plan_rig(RigConfig.model_validate(with_probes(document, 20.0))).buses

    assert with_them.load - without.load == pytest.approx(20.0 * 0.00155, rel=0.1)
    assert with_them.polls[0].response_s > without.polls[0].response_s
    assert with_them.commands_per_s < without.commands_per_s


def test_probes_are_left_out_where_polls_would_miss_their_turns_for_them():
    (bus,) = require_plan(config(axes=1, position=300.0)).buses

    assert bus.holds
    assert bus.stop_probe_hz == 0.0


def with_probes(document, hz):
    document["bus"][0]["stop_probe_hz"] = hz
    return document


def smartstep(overload: str | None = None, **rates: float) -> RigConfig:
    """A rig of two SmartSteps on one simulated line without an adapter."""
    wanted = {"position": 0.0, "velocity": 0.0, **rates}
    axes = [{"name": f"s{unit}", "address": unit, "model": "smartstep", "rates": wanted} for unit in (1, 2)]
    bus = {"name": "steps", "port": "sim:steps", "family": "smartstep", "adapter_latency_ms": 0.0, "axis": axes}
    sim = {"name": "steps", "unit": [{"number": unit} for unit in (1, 2)]}
    return RigConfig.model_validate({"rig": "sim", "bus": [{**bus, "overload": overload}], "sim": [sim]})


def test_a_smartstep_line_is_planned_word_by_word():
    (bus,) = require_plan(smartstep(velocity=1.0, state=0.5)).buses

    words_s = {poll.items[0].item: poll.longest_s for poll in bus.polls if poll.axis == "s1"}
    assert bus.holds
    assert words_s["velocity"] == pytest.approx(28 * 10 / 9600 + 0.02 + 0.005)
    assert words_s["state"] == pytest.approx(3 * words_s["velocity"])
    assert bus.load == pytest.approx(2 * sum(poll.rate_hz * poll.longest_s for poll in bus.polls) / 2)


def test_a_smartstep_line_that_is_asked_for_too_much_is_never_idle():
    assert smartsteps_busy(10.0) >= 0.999


def test_an_item_of_a_smartstep_does_not_wait_for_all_that_is_asked_of_the_other_one():
    (bus,) = plan_rig(smartstep(velocity=1.0, state=0.5)).buses

    velocity, *_ = (poll for poll in bus.polls if poll.items[0].item == "velocity")
    # a state that has just begun and then its own word; before each of these words one of the other drive
    assert velocity.response_s == pytest.approx(2 * (3 + 1) * velocity.longest_s)


def test_a_smartstep_line_is_let_pass_unless_it_is_told_to_refuse():
    assert not require_plan(smartstep(velocity=10.0, state=5.0)).holds
    with pytest.raises(ConfigError, match="no rate above") as refused:
        require_plan(smartstep("refuse", velocity=10.0, state=5.0))

    hz = float(refused.value.message.split("no rate above ")[1].split(" Hz")[0])
    assert require_plan(smartstep("refuse", velocity=hz, state=hz, position=hz / 10)).holds


@pytest.mark.long
async def test_the_load_on_average_is_what_the_wire_shows():
    document = config(axes=4, position=60.0, velocity=60.0, adc=20.0, state=5.0).model_dump()
    document["bus"][0]["order"] = "deadline"  # drives are waited for half a cycle then
    rig_config = RigConfig.model_validate(document)
    (planned,) = require_plan(rig_config).buses

    async with running_rig(rig_config) as rig:
        bus = rig.daemon.rig.buses[0].bus
        began_s, polls = asyncio.get_running_loop().time(), bus.statistics.exchanges
        busy_s = bus.statistics.wire_busy_s
        await asyncio.sleep(10.0)

        elapsed_s = asyncio.get_running_loop().time() - began_s
        polls = bus.statistics.exchanges - polls
        waits_s = polls * (0.000256 + planned.turnaround_s)
        assert (bus.statistics.wire_busy_s - busy_s + waits_s) / elapsed_s == pytest.approx(planned.mean_load, rel=0.02)


async def test_the_plan_is_served():
    async with running_rig() as rig:
        (former,) = await rig.session.query("ldcn/sim/meta/plan")
        assert "meta/budget" in decode_error(former.payload, former.encoding).message
        (answer,) = await rig.session.query("ldcn/sim/meta/budget")

        assert decode(RigBudget, answer.payload, answer.encoding) == plan_rig(load_config(SIMULATED))


def test_the_command_prints_a_table_and_json_and_exits_with_1_when_overfull(tmp_path):
    overfull = tmp_path / "overfull.toml"
    text = SIMULATED.read_text()
    overfull.write_text(text.replace("position = 20, velocity = 20", "position = 400, velocity = 400"))

    table = CliRunner().invoke(cli, ["plan", str(SIMULATED)])
    plan = CliRunner().invoke(cli, ["plan", str(SIMULATED), "--json"])
    refused = CliRunner().invoke(cli, ["plan", str(overfull)])
    checked = CliRunner().invoke(cli, ["check-config", str(overfull), "--json"])

    assert table.exit_code == 0
    assert "holds" in table.output
    assert RigBudget.model_validate(json.loads(plan.output)).holds
    assert refused.exit_code == 1
    assert "CANNOT HOLD" in refused.output
    assert checked.exit_code == 78
    assert not json.loads(checked.output)["valid"]


@pytest.mark.real_time
def test_the_largest_rig_is_planned_in_no_time():
    document = config(axes=31, overload="skip").model_dump()
    for number, axis in enumerate(document["bus"][0]["axis"], 1):
        axis["rates"] = {"position": 8.0 + 0.37 * number}
    began_s = time.process_time()

    plan_rig(RigConfig.model_validate(document))

    assert time.process_time() - began_s < 5.0
