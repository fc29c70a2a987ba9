"""A family that a folder of the tests adds: configured, planned, run, polled, moved, recorded and shown."""

import asyncio

import msgpack
import pytest

from ldcnd.config.plan import plan_rig
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import MoveAbsolute, Power, SetPosition, Stop, Verb
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.samples import AxisState, Moving
from ldcnd.drives import known
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim import known as simulated
from tests.support.console_rig import console_of, page
from tests.support.recordings import checked_topics, recorded_rig
from tests.toy.family import TOY

RIG = """
rig = "toys"
[[bus]]
name = "shelf"
port = "sim:shelf"
family = "toy"
[[bus.axis]]
name = "train"
address = 3
model = "toy-stage"
velocity = 100
acceleration = 1000
[[sim]]
name = "shelf"
stage = [{ node = 3 }]
"""


@pytest.fixture
def config(tmp_path, monkeypatch):
    monkeypatch.setitem(known.HOMES, TOY.name, "tests.toy.family:TOY")
    monkeypatch.setitem(simulated.HOMES, TOY.name, "tests.toy.simulated:SIMULATED_TOYS")
    file = tmp_path / "toys.toml"
    file.write_text(RIG)
    return load_config(file)


def test_it_is_configured_and_a_wrong_key_is_named(config, tmp_path):
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(RIG.replace("address = 3\n", "address = 3\nadress = 4\n").replace("toy-stage", "ls-182ap"))

    assert config.bus[0].axis[0].model == "toy-stage"
    with pytest.raises(ConfigError, match="toy-stage") as error:
        load_config(wrong)
    assert "did you mean 'address'" in error.value.message


def test_it_is_planned(config):
    plan = plan_rig(config)

    assert plan.holds
    assert (plan.buses[0].family, plan.buses[0].polls[0].rate_hz) == ("toy", 10.0)


async def test_it_is_polled_moved_stopped_recorded_and_shown(config, tmp_path):
    path = tmp_path / "toys.mcap"
    async with recorded_rig(path, config) as recorded:
        rig = recorded.rig
        async with rig.broker.session() as session, console_of(rig, session) as console:
            await rig.until("train", lambda state: state.state is AxisState.DISABLED)
            (info,) = await rig.client.axes()
            await rig.client.command("train", Power(on=True))
            await rig.client.command("train", SetPosition(position=0.0))
            await rig.client.command("train", MoveAbsolute(position=200.0))
            await rig.until("train", lambda state: state.moving is Moving.YES)
            await rig.until("train", lambda state: state.state is AxisState.STANDSTILL)
            there = await rig.client.position("train")
            await rig.client.command("train", MoveAbsolute(position=0.0))
            await asyncio.sleep(0.5)
            await rig.client.command("train", Stop())
            stopped = await rig.client.state("train")
            async with page(console.app, console.browser) as socket:
                _sent_ns, _dropped, entries = msgpack.unpackb(await socket.frame())
            log = rig.daemon.rig.buses[0].bus.wire_log
            words = {TOY.describe({})(record) for record in log.records() if record.event is WireEvent.SENT}

    assert (info.model, Verb.MOVE_ABSOLUTE in info.capabilities) == ("toy-stage", True)
    assert (there.value, stopped.stop_latched) == (200.0, True)
    assert "stage 3: load 200 100" in words
    assert "tele/train/position" in {topic for _rig, topic, _sample in entries}
    assert checked_topics(path) == recorded.published
