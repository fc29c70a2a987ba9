"""An axis of a recording as a picture."""

import asyncio
import math

import pytest
from click.testing import CliRunner

from ldcnd.cli.main import cli
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState
from ldcnd.lab.recording.reading import AxisHistory, Recording, axis_history
from ldcnd.sim.ldcn.chain import build_chain
from tests.support.recordings import recorded_rig
from tests.support.rig import SIMULATED


async def record_a_move_and_an_outage(path):
    chain = build_chain(load_config(SIMULATED).sim[0].spec(starts_at_s=0.0))
    async with recorded_rig(path, chains={"line0": chain}) as recorded:
        rig = recorded.rig
        await rig.until("x", lambda state: state.state is AxisState.DISABLED)
        await rig.client.command("x", Power(on=True))
        await rig.client.command("x", MoveAbsolute(position=5.0))
        await asyncio.sleep(3.0)
        chain.unplug(asyncio.get_running_loop().time(), for_s=1.0)
        await asyncio.sleep(4.0)


@pytest.mark.long
async def test_a_recorded_axis_is_drawn_with_its_commands_and_without_what_nobody_measured(tmp_path):
    path, picture = tmp_path / "run.mcap", tmp_path / "x.png"
    await record_a_move_and_an_outage(path)

    history = axis_history(Recording(path), "x")
    drawn = CliRunner().invoke(cli, ["plot", str(path), "x", "-o", str(picture)])

    quantities = {series.title: series for series in history.series}
    position = quantities["position"]
    assert set(quantities) == {"position", "following error", "velocity", "analog input"}
    assert position.unit == "mm"
    assert max(value for value in position.values if not math.isnan(value)) == pytest.approx(5.0, abs=0.1)
    assert any(map(math.isnan, position.values))
    assert [event.verb for event in history.events if event.status is CommandStatus.DONE] == [
        "power",
        "move_absolute",
        "link_back",
    ]
    assert drawn.exit_code == 0, drawn.output
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_messages_of_another_version_are_left_out_and_counted():
    history = AxisHistory("x")

    history.add("ldcn/sim/tele/x/position", b'{"t": 1, "place": 2.0}')
    history.add("ldcn/sim/tele/x/something_new", b"{}")

    assert (history.series, history.not_understood) == ([], 1)


async def test_an_axis_that_is_not_in_the_recording_is_named_with_those_that_are(tmp_path):
    path = tmp_path / "run.mcap"
    async with recorded_rig(path):
        await asyncio.sleep(2.0)

    refused = CliRunner().invoke(cli, ["plot", str(path), "q", "-o", str(tmp_path / "q.png")])

    assert "no axis 'q'; it has c, x, y, z" in str(refused.exception)
