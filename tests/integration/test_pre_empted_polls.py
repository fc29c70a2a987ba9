"""A whole daemon on a slow line whose stops do not wait for the replies to polls, on the jumping clock."""

import asyncio
import random

import pytest
from click.testing import CliRunner
from pydantic import ValidationError

from ldcnd.bus.exchange_queue import Lane
from ldcnd.bus.pre_empting_line import AHEAD
from ldcnd.bus.wire_log import WireEvent
from ldcnd.cli.main import cli
from ldcnd.client.traces import take_trace
from ldcnd.config import RigConfig
from ldcnd.daemon.planning import plan_rig, require_plan
from ldcnd.drivers.ldcn import commands
from ldcnd.drivers.ldcn.commands import Node
from ldcnd.drivers.ldcn.controls import StopControl
from ldcnd.drivers.ldcn.packet import Command, Packet
from ldcnd.drivers.ldcn.profiles import PROFILES
from ldcnd.messaging.codec import decode
from ldcnd.model.axes import AxisState, LinkState, Moving
from ldcnd.model.health import BusHealth
from ldcnd.model.requests import MoveVelocityRequest, PowerRequest, ResetRequest, TraceRequest, Verb
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.captures import FOLDER
from tests.support.rig import RunningRig, running_rig

STOP = commands.stop_motor(Node(1, PROFILES["pic-servo-v4"]), StopControl.MOTOR_OFF)


def document(*, pre_empt_polls: bool = True, model: str = "pic-servo-v4", baud: int = 19_200) -> dict:
    axes = [
        {
            "name": f"a{number}",
            "address": number,
            "model": model,
            "velocity": 10.0,
            "acceleration": 20.0,
            "counts_per_unit": 1000,
            "gains": {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000},
            "rates": {"position": 40.0, "velocity": 40.0, "adc": 40.0, "state": 40.0},
        }
        for number in (1, 2)
    ]
    bus = {
        "name": "line0",
        "port": "sim:line0",
        "baud": baud,
        "adapter_latency_ms": 0.0,
        "stop_probe_hz": 0.0,
        "pre_empt_polls": pre_empt_polls,
        "axis": axes,
    }
    module = "ls182ap" if model == "ls-182ap" else "picservo-v4"
    return {"rig": "sim", "bus": [bus], "sim": [{"name": "line0", "module": [{"model": module}] * 2}]}


def config(**options) -> RigConfig:
    return RigConfig.model_validate(document(**options))


def waits_s(rig: RunningRig, asked_s: list[float]) -> list[float]:
    """Return how long each stop waited for the first bit that a drive heard of it."""
    bus = rig.daemon.rig.buses[0].bus
    sent_s = [record.at_s for record in bus.wire_log.records() if record.data == STOP.request]
    return [next(at_s for at_s in sent_s if at_s >= since_s) - since_s for since_s in asked_s]


async def random_stops(rig: RunningRig, rounds: int) -> list[float]:
    """Stop at random instants, one at a time; return how long each had to wait."""
    dice = random.Random(11)
    bus = rig.daemon.rig.buses[0].bus
    asked_s = []
    for _ in range(rounds):
        await asyncio.sleep(dice.uniform(0.02, 0.1))
        asked_s.append(asyncio.get_running_loop().time())
        await bus.execute(STOP, Lane.STOP)
    return waits_s(rig, asked_s)


async def test_no_stop_among_polls_waits_longer_than_planned_and_each_is_answered_in_time():
    rig_config = config()
    (planned,) = require_plan(rig_config).buses

    async with running_rig(rig_config) as rig:
        statistics = rig.daemon.rig.buses[0].bus.statistics
        lost_before = statistics.timeouts + statistics.corrupt_replies + statistics.stray_bytes
        waited_s = await random_stops(rig, 200)
        (answer,) = await rig.session.query("ldcn/sim/meta/health/line0")
        health = decode(BusHealth, answer.payload, answer.encoding)
        links = {(await rig.client.state(axis)).link for axis in ("a1", "a2")}

    assert 0.6 * planned.stop_ahead_s < max(waited_s) <= planned.stop_ahead_s < planned.stop_wait_s
    assert 0.7 * planned.stop_s < statistics.latency[Lane.STOP].longest_s <= planned.stop_s
    assert statistics.taken_back > 40
    assert health.taken_back > 0
    assert statistics.timeouts + statistics.corrupt_replies + statistics.stray_bytes == lost_before
    assert links == {LinkState.UP}


async def test_without_the_option_stops_among_polls_wait_longer_and_nothing_is_taken_back():
    async with running_rig(config()) as rig:
        hurried_s = await random_stops(rig, 200)
    async with running_rig(config(pre_empt_polls=False)) as rig:
        patient_s = await random_stops(rig, 200)
        assert rig.daemon.rig.buses[0].bus.statistics.taken_back == 0
        assert AHEAD not in {record.note for record in rig.daemon.rig.buses[0].bus.wire_log.records()}

    for name, waits_s in (("ahead", hurried_s), ("in turn", patient_s)):
        print(f"{name}: longest {max(waits_s) * 1e3:.1f} ms, mean {sum(waits_s) / len(waits_s) * 1e3:.1f} ms")
    assert max(hurried_s) < 0.75 * max(patient_s)
    assert sum(hurried_s) < 0.8 * sum(patient_s)


async def test_a_move_is_stopped_by_the_packet_that_went_ahead(monkeypatch):
    chain = build_chain(ChainSpec((ModuleSpec("picservo-v4"),) * 2))
    drive, loop, stopped_s = chain.modules[0], asyncio.get_running_loop(), []

    def execute(packet: Packet) -> None:
        if packet.command == Command.STOP_MOTOR:
            stopped_s.append(loop.time())
        obey(packet)

    obey = drive.execute
    monkeypatch.setattr(drive, "execute", execute)
    async with running_rig(config(), {"line0": chain}) as rig:
        bus = rig.daemon.rig.buses[0].bus
        for axis in ("a1", "a2"):
            await rig.until(axis, lambda state: state.link is LinkState.UP)
            await rig.client.command(axis, Verb.POWER, PowerRequest(on=True))
        await rig.client.command("a2", Verb.MOVE_VELOCITY, MoveVelocityRequest(velocity=5.0))
        dice = random.Random(3)
        for _ in range(20):
            await rig.client.command("a1", Verb.MOVE_VELOCITY, MoveVelocityRequest(velocity=5.0))
            await rig.until("a1", lambda state: state.moving is Moving.YES)
            await asyncio.sleep(dice.uniform(0.1, 0.2))
            reply = await rig.client.stop("a1")
            assert reply.confirmed == ("a1",)
            await rig.until("a1", lambda state: state.moving is Moving.NO)
            await rig.client.command("a1", Verb.RESET, ResetRequest())
        stopped = await rig.client.state("a1")
        running = await rig.client.state("a2")

    sent = [record for record in bus.wire_log.records() if record.event is WireEvent.SENT]
    ahead = [number for number, record in enumerate(sent) if record.note == AHEAD]
    assert len(ahead) == bus.statistics.taken_back > 3
    for number in ahead:
        again_s = next(later.at_s for later in sent[number + 1 :] if later.data == sent[number].data)
        assert any(sent[number].at_s < at_s < again_s for at_s in stopped_s)
    assert stopped.state is AxisState.STANDSTILL
    assert running.moving is Moving.YES


async def test_a_trace_tells_how_many_samples_stops_took_back():
    async with running_rig(config()) as rig, asyncio.TaskGroup() as group:
        await rig.until("a1", lambda state: state.link is LinkState.UP)
        request = TraceRequest(channels=("position",), interval_s=0.02, samples=150)
        taking = group.create_task(take_trace(rig.client, "a1", request, within_s=60), name="trace")
        await random_stops(rig, 60)
        trace = await taking

    assert trace.header.missed > 0


@pytest.mark.parametrize("model", ["ls-182ap", "pic-servo-v3", "pic-servo-sc"])
def test_only_drives_that_are_known_to_take_their_replies_back_may_be_pre_empted(model):
    with pytest.raises(ValidationError, match=rf"nothing says that a {model} \(address 1\) takes"):
        config(model=model)


def test_no_stop_goes_ahead_on_a_port_behind_a_network():
    behind_it = document()
    behind_it["bus"][0]["port"] = "socket://127.0.0.1:9"
    with pytest.raises(ValidationError, match="nobody knows when a packet leaves behind the network"):
        RigConfig.model_validate(behind_it)


def test_the_plan_says_what_the_option_brings():
    (without,) = plan_rig(config(pre_empt_polls=False)).buses
    (with_it,) = plan_rig(config()).buses
    (fast,) = plan_rig(config(baud=115_200)).buses
    (fast_without,) = plan_rig(config(baud=115_200, pre_empt_polls=False)).buses

    assert without.stop_ahead_s is None
    assert with_it.stop_ahead_s < without.stop_wait_s == with_it.stop_wait_s
    assert with_it.stop_s > without.stop_s
    assert fast.stop_ahead_s == max(poll.longest_s for poll in fast.polls)
    assert fast.stop_s == fast_without.stop_s


def test_the_table_of_the_plan_shows_it_where_it_is_switched_on():
    tables = [CliRunner().invoke(cli, ["plan", str(FOLDER / f"{name}.toml")]) for name in ("stop_ahead", "clean_start")]

    assert [table.exit_code for table in tables] == [0, 0]
    assert ["ms to its first bit ahead of the reply to a poll" in table.output for table in tables] == [True, False]
