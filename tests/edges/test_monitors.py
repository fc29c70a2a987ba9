"""The monitors of a SmartStep, which moves by no command of its line, as Bluesky and EPICS have them."""

from pathlib import Path

import bluesky.plans as bp
import pytest
from bluesky.preprocessors import monitor_during_wrapper
from caproto import AlarmSeverity

from ldcnd.client.rig import Rig
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.lab.epics.gateway import gateway
from tests.support.bluesky_engine import laboratory
from tests.support.epics_records import shows
from tests.support.process import ROOT
from tests.support.rig import running_rig

pytestmark = [pytest.mark.edges, pytest.mark.timeout(300)]


def mixed(state_dir: Path) -> RigConfig:
    return load_config(ROOT / "config" / "mixed.toml").model_copy(update={"state_dir": state_dir})


def test_monitors_of_a_drive_are_signals_of_a_plan(tmp_path):
    async def published():
        async with lab.running.client.samples("feed", "monitor/cumulative_load") as samples:
            await anext(samples)

    with laboratory(mixed(tmp_path)) as lab, lab.powered("x") as (x,):
        torque = lab.devices.signal("feed", "monitor/torque_reference")
        load = lab.devices.signal("feed", "monitor/cumulative_load", name="load")
        lab.loop.run(published())
        before = lab.loop.run(torque.read())["feed_torque_reference"]
        lab.engine(monitor_during_wrapper(bp.scan([load], x, 0, 90, 3), [torque]))

    events = lab.documents.of("event")
    times = [event["timestamps"][torque.name] for event in events if torque.name in event["data"]]
    described = [each["data_keys"] for each in lab.documents.of("descriptor")]
    assert lab.documents.exit_status == "success"
    assert len(lab.documents.data("load")) == 3
    assert {abs(value) for value in lab.documents.data(torque.name)} == {before["value"]} == {5.0}
    assert before["timestamp"] <= times[0] < times[-1]
    assert [keys[torque.name]["units"] for keys in described if torque.name in keys] == ["%"]


async def test_monitors_and_inputs_of_a_drive_are_variables_beside_a_record_that_nothing_moves(tmp_path: Path) -> None:
    async with running_rig(mixed(tmp_path)) as running:
        rig = Rig(running.client, await running.client.daemon())
        async with gateway(rig, prefix="T:", axes=("feed",), moves=("feed",)) as made:
            await shows(made, "T:feed:torque_reference", 5)
            await shows(made, "T:feed:inputs", "RUN")
            torque = made.variables["T:feed:torque_reference"]
            monitors = (await rig.describe())[1].monitors

    assert {f"T:feed:{monitor}" for monitor in monitors} <= set(made.variables)
    assert torque.severity == AlarmSeverity.NO_ALARM
    assert 1e9 < torque.timestamp < 1.8e9  # of the rig's clock
    writable = {name.rpartition(".")[2] for name, field in made.variables.items() if field.action}
    assert writable == {"STOP", "SPMG", "T:allstop"}
