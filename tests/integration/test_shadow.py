"""A shadow beside a whole daemon: it learns, says what has changed, learns anew, and sends no command."""

import asyncio
import json
from contextlib import asynccontextmanager
from dataclasses import asdict

import pytest

from ldcnd.bench.kept_gains import KeptGains, forget, gains_in, keep
from ldcnd.bench.tuning import shadow
from ldcnd.bench.tuning.plant import Plant
from ldcnd.bench.tuning.report import Estimate
from ldcnd.bench.tuning.watching import LOOK_S, WatchedAxis, memory_file, watch
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError, NotSupported
from ldcnd.contract.questions import ReportShadow
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.axis_config import RatesConfig
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.plant import MotorPlant, Shaft
from tests.support.command_line import virtual_rig
from tests.support.pages import ROOT, blocks_of
from tests.support.rig import SIMULATED, running_rig
from tests.unit.test_cli_tune import REPORT

PAGE = ROOT / "docs" / "how-to" / "watch-an-axis.md"
MACHINE = MotorPlant(inertia_kg_m2=2e-4, friction_nm=0.02)
TUNED = REPORT.model_copy(
    update={
        "plant": {name: Estimate(value=value, interval=0, unit="") for name, value in asdict(Plant.of(MACHINE)).items()}
    }
)


@pytest.fixture(autouse=True)
def few_motions_teach(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(shadow, "LEARNT_MOTIONS", 8)
    monkeypatch.setattr(shadow, "WINDOWS", (4,))


@asynccontextmanager
async def working_rig(**changes):
    config = load_config(SIMULATED)
    (bus,) = config.bus
    axis = bus.axis[0].model_copy(update={"rates": RatesConfig(position=100)} | changes)
    one = config.model_copy(update={"bus": (bus.model_copy(update={"axis": (axis,), "group": ()}),)})
    chain = build_chain(ChainSpec(modules=(ModuleSpec("ls182ap", MACHINE),)))
    async with running_rig(one, {"line0": chain}) as rig:
        await rig.until("x", lambda state: state.link == "up")
        yield rig, chain.modules[0]


class Observer(RigClient):
    """A client that cannot command; it may have published what it finds."""

    async def _answer(self, axis, command, timeout_s):
        assert isinstance(command, ReportShadow), "the shadow has sent a command"
        return await super()._answer(axis, command, timeout_s)


@asynccontextmanager
async def watched(rig, alarms, said):
    end = asyncio.Event()
    async with rig.broker.session() as session, asyncio.TaskGroup() as group:
        client = Observer(session, rig.client.rig)
        task = group.create_task(watch(client, [TUNED], alarms.append, said.append, end), name="shadow")
        yield
        end.set()
        await task


async def move(axis, motions):
    for motion in range(motions):
        await (await axis.move_absolute(2.0 if motion % 2 == 0 else 0.0)).done()
        await asyncio.sleep(0.3)


def kept():
    return json.loads(memory_file("sim", "x").read_text())


@pytest.mark.long
async def test_a_load_that_doubles_is_said_and_what_was_learnt_outlives_the_observer():
    alarms, said = [], []
    async with working_rig() as (rig, module):
        usual = Rig(rig.client, await rig.client.daemon())
        async with usual.control("x", client="test") as axis:
            await axis.power(on=True)
            async with watched(rig, alarms, said):
                await move(axis, 10)
            learnt = kept()["learnt"]
            heavy = Shaft(
                MACHINE.model_copy(update={"inertia_kg_m2": 2 * MACHINE.inertia_kg_m2}), module.profile.servo_cycle_s
            )
            heavy.position_counts = module.shaft.position_counts
            module.loop.shaft = heavy
            async with watched(rig, alarms, said):
                await move(axis, 6)
                healthy_gains = kept()["gains"]
                await asyncio.sleep(LOOK_S + 1)
                published = await rig.client.last("x", TelemetryItem.SHADOW)
                await axis.set_gains(kp=300)
                await asyncio.sleep(15)

    assert "x: learnt; from now on its motions are compared" in said
    assert learnt["inertia"]["value"] == pytest.approx(1.0, abs=0.2)
    (heavier,) = [alarm for alarm in alarms if alarm.figure == "inertia"]
    assert heavier.latest == pytest.approx(2.0, abs=0.3)
    assert heavier.value > heavier.high
    assert heavier.meaning.startswith("a heavier load")
    assert not any(alarm.over for alarm in alarms)
    (shown,) = [figure for figure in published.figures if figure.figure == "inertia"]
    assert (shown.alarm, shown.meaning) == (True, heavier.meaning)
    assert shown.value > shown.high > shown.usual
    assert not published.learning
    assert ["learnt before" in line for line in said if "with these gains" in line] == [False, True, False]
    assert kept()["learnt"] == {}
    assert kept()["gains"] == {**healthy_gains, "kp": 300}


@pytest.mark.long
async def test_gains_that_are_lent_teach_nothing():
    said = []
    async with working_rig() as (rig, _):
        usual = Rig(rig.client, await rig.client.daemon())
        async with usual.control("x", client="test") as axis:
            await axis.power(on=True)
            async with watched(rig, [], said):
                await move(axis, 10)
                (info,) = await usual.describe()
                own = KeptGains(rig="sim", axis="x", gains=gains_in(info), model=info.model)
                keep(own)
                await axis.set_gains(kp=300)
                await asyncio.sleep(LOOK_S + 1)
                learnt = kept()
                await move(axis, 10)
                await axis.set_gains(kp=own.gains["kp"])
                forget(own)
                await asyncio.sleep(LOOK_S + 1)

    assert learnt["learnt"]
    assert (kept()["learnt"], kept()["gains"]) == (learnt["learnt"], own.gains)
    assert "x: waits until it has its own gains back" in said
    assert ["learnt before" in line for line in said if "with these gains" in line] == [False, True]


async def test_what_cannot_be_watched_is_refused_and_slow_positions_are_said():
    said = []
    async with working_rig(rates=RatesConfig(position=10)) as (rig, _):
        with pytest.raises(ConfigError, match="has no axis 'w'; it has x"):
            await watch(rig.client, [TUNED.model_copy(update={"axis": "w"})], print, said.append, asyncio.Event())
        (info,) = await rig.client.axes()
        with pytest.raises(NotSupported, match="a pic-servo-v4 does not report its position error"):
            WatchedAxis("sim", info.model_copy(update={"model": "pic-servo-v4"}), TUNED, print, said.append)
        async with watched(rig, [], said):
            await asyncio.sleep(3)

    assert said[0] == "x: waits until its loop has been closed once: its gains are not known"
    assert "x: its position comes every 100 ms: motions shorter than 1.2 s are not judged" in said[-1]


@pytest.mark.system  # a whole tuning takes half a minute of processor time
@pytest.mark.timeout(300)
def test_the_blocks_of_the_page_tune_an_axis_and_watch_it(monkeypatch, tmp_path):
    typed = [line for block in blocks_of(PAGE) for line in block.text.splitlines() if line.startswith("ldcnd ")]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "ldcnd.bench.cli.commission.on_end", lambda told: asyncio.get_running_loop().call_later(2 * LOOK_S, told)
    )

    with virtual_rig(monkeypatch) as rig:
        tunes, watches = (line.removeprefix("ldcnd ").partition(" | tee ") for line in typed)
        rig.wait(rig.rig.until("x", lambda state: state.link == "up"))
        tuned = rig.run(tunes[0])
        assert tuned.code == 0, tuned.errors
        (tmp_path / tunes[2]).write_text(tuned.printed.splitlines()[-1])
        watched = rig.run(watches[0])

    assert watched.code == 0, watched.errors
    assert "x: learns from its first" in watched.errors
